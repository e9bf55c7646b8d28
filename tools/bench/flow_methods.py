"""Ways to measure flow between a reference and a view guided into it, behind one protocol."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.arrays import Bools, Floats, Floats32
from track.beyond import search_beyond
from track.flow import ALIGNED, FlowMatches, better, refine_flow, search_flow
from track.guide import GuidedView
from track.reference import ReferenceLevel
from track.schedule import Step

_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
_LK_LEVELS = 2

Picture = NDArray[np.uint8]
DenseFlow = Callable[[Picture, Picture], Floats32]


class FlowMethod(Protocol):
    """What measures the displacement of a view's samples in one round."""

    def match(
        self,
        level: ReferenceLevel,
        view: GuidedView,
        image: Floats32,
        chosen: Bools,
        step: Step,
    ) -> FlowMatches:
        """Displacements, correlation and information of the M samples, as `track.flow` has them.

        Args:
            level: the reference of the view.
            view: the frame's image, guided into it.
            image: the frame's own image at the level.
            chosen: (M,) which samples to match.
            step: the round.
        """
        ...


class Ours:
    """Whole-pixel search, then Gauss-Newton, both on normalised correlation (`track.flow`)."""

    def match(
        self, level: ReferenceLevel, view: GuidedView, image: Floats32, chosen: Bools, step: Step
    ) -> FlowMatches:
        """As the tracker does it, the search beyond edges included."""
        found = search_flow(level, view, chosen, step.search_px)
        matches = refine_flow(level, view, found.displacement, step.iterations)
        lost = chosen & level.at_edge & (matches.correlation < ALIGNED)
        reach = (step.search_px, step.iterations)
        return better(matches, search_beyond(level, view, image, lost, reach))


class Dense:
    """A flow field of the whole picture, read at the samples.

    Correlation and information, which the rounds weigh matches by, are then measured at what the
    field says, by the same windows as ours; the displacement stays the field's.
    """

    def __init__(self, flow: DenseFlow) -> None:
        """Take a function of two 8-bit pictures to a field (H, W, 2)."""
        self._flow = flow

    def match(
        self, level: ReferenceLevel, view: GuidedView, image: Floats32, chosen: Bools, step: Step
    ) -> FlowMatches:
        """The field at the samples' pixels."""
        field = self._flow(picture(level.image), picture(view.image))
        last = np.array([field.shape[1] - 1, field.shape[0] - 1])
        columns, rows = np.clip(level.centres, 0, last).T
        found = np.where(chosen[:, None], field[rows, columns].astype(np.float64), np.nan)
        return refine_flow(level, view, found, 0)


class Sparse:
    """Pyramidal Lucas-Kanade at the samples, windows as large as ours."""

    def match(
        self, level: ReferenceLevel, view: GuidedView, image: Floats32, chosen: Bools, step: Step
    ) -> FlowMatches:
        """LK from the samples' pixels."""
        side = level.windows.shape[1]
        start = level.centres.astype(np.float32)
        found, good, _ = cv2.calcOpticalFlowPyrLK(
            picture(level.image), picture(view.image), start, start.copy(),
            winSize=(side, side), maxLevel=_LK_LEVELS, criteria=_STOP,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        moved: Floats = np.asarray(found, np.float64) - start
        used = chosen & (np.asarray(good).ravel() == 1)
        return refine_flow(level, view, np.where(used[:, None], moved, np.nan), 0)


def methods() -> dict[str, FlowMethod]:
    """Ours and OpenCV's, by name."""
    return {
        "ours": Ours(),
        "DIS medium": Dense(_dis),
        "Farneback": Dense(_farneback),
        "DeepFlow": Dense(_deep),
        "LK": Sparse(),
    }


def picture(image: Floats32) -> Picture:
    """An image of 0..1 in 8 bits."""
    grey: Picture = np.clip(np.rint(255.0 * image), 0, 255).astype(np.uint8)
    return grey


def _dis(one: Picture, other: Picture) -> Floats32:
    solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return _field(solver.calc(one, other, _blank(one)))


def _farneback(one: Picture, other: Picture) -> Floats32:
    return _field(cv2.calcOpticalFlowFarneback(one, other, _blank(one), 0.5, 4, 15, 3, 7, 1.5, 0))


def _deep(one: Picture, other: Picture) -> Floats32:
    return _field(cv2.optflow.createOptFlow_DeepFlow().calc(one, other, _blank(one)))


def _blank(one: Picture) -> Floats32:
    return np.zeros((*one.shape, 2), np.float32)


def _field(found: Any) -> Floats32:
    return np.asarray(found, np.float32)
