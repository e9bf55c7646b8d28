"""What tracking is told of each frame, and by what hash it knows that nothing changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.track.corrections.patch_subject import EVERY, MESH, SUBJECT, TRIANGLE, locked
from track.corrections.curves import CurveSightings
from track.corrections.entries import (
    Anchor,
    Correction,
    Curve,
    FrameExclusion,
    Lock,
    Pin,
    ViewExclusion,
)
from track.corrections.replay import CURVE_WEIGHT, PIN_WEIGHT, Corrections

LOCK = Lock(frame=7, sha256="ab" * 32)
ALL = (*EVERY, LOCK)
HELD = {7: locked(7)}
CAMERAS = {camera.name: camera for camera in SUBJECT.cameras}


def corrections(*every: Correction) -> Corrections:
    return Corrections(SUBJECT, every, HELD)


def test_frames_are_told_what_concerns_them() -> None:
    told = corrections(*ALL)
    assert len(told) == 7
    assert (told.anchors, told.locked, told.excluded) == ((8,), (7,), (5,))
    frames = {frame: told.for_frame(frame) for frame in SUBJECT.frames}
    assert [f for f in frames if frames[f].excluded_views] == [4, 5, 6]
    assert frames[4].excluded_views == {"cam00"}
    assert [f for f in frames if frames[f].excluded] == [5]
    assert [f for f in frames if frames[f].anchor] == [8]
    assert [f for f in frames if frames[f].locked is not None] == [7]
    assert frames[7].locked is HELD[7]
    assert [frames[f].kinds for f in (1, 2, 5)] == [(), ("pin",), ("exclude_frame", "exclude_view")]
    assert [len(frames[f].sightings) for f in frames] == [0, 0, 2, 1, 0, 0, 0, 0, 0, 0]
    assert isinstance(frames[3].sightings[0], CurveSightings)
    assert frames[3].sightings[0].weight == CURVE_WEIGHT


def test_a_take_without_corrections_is_told_nothing() -> None:
    nothing = Corrections(SUBJECT)
    told = nothing.for_frame(3)
    assert (told.sightings, told.excluded_views, told.locked) == ((), frozenset(), None)
    assert not told.excluded
    assert not told.anchor
    assert nothing.key(3) == "none"
    assert len(nothing) == 0


def test_a_locked_frame_is_not_interpolated() -> None:
    told = corrections(LOCK, FrameExclusion(first=6, last=8))
    assert told.excluded == (6, 8)
    assert not told.for_frame(7).excluded
    assert told.for_frame(7).locked is not None


def test_pins_lift_their_points_to_where_they_are_seen() -> None:
    truth = MESH.vertices + np.random.default_rng(5).normal(0, 0.3, (1, 3)) + [0.4, -0.6, 0.2]
    places = [((100,), (1.0,)), (TRIANGLE, (0.2, 0.5, 0.3)), ((361 - 1,), (1.0,))]
    pins = []
    for corners, shares in places:
        point = np.array(shares) @ truth[list(corners)]
        pixels = {name: camera.project(point[None])[0] for name, camera in CAMERAS.items()}
        pins.append(
            Pin(
                frame=1,
                corners=corners,
                barycentric=shares,
                pixels={name: (float(x), float(y)) for name, (x, y) in pixels.items()},
            )
        )
    (sightings,) = corrections(*pins).for_frame(1).sightings
    lifted = sightings.lifted(MESH.vertices, CAMERAS)
    expected = sightings.surface.points(truth) - sightings.surface.points(MESH.vertices)
    assert np.abs(lifted.motion - expected).max() < 0.02  # mm: what linear projection leaves
    assert (lifted.views == 4).all()
    assert sightings.weight == PIN_WEIGHT
    assert sightings.accuracy_px == 0.0
    np.testing.assert_array_equal(
        sightings.surface.corners, SUBJECT.triangles[sightings.surface.triangle]
    )
    np.testing.assert_allclose(sightings.surface.barycentric.sum(axis=1), 1.0)


def test_a_pin_is_no_outlier_however_far_it_is() -> None:
    point = MESH.vertices[100] + [0.0, 25.0, 0.0]
    pixels = {name: camera.project(point[None])[0] for name, camera in CAMERAS.items()}
    pin = Pin(
        frame=1,
        corners=(100,),
        barycentric=(1.0,),
        pixels={name: (float(x), float(y)) for name, (x, y) in pixels.items()},
    )
    (sightings,) = corrections(pin).for_frame(1).sightings
    lifted = sightings.lifted(MESH.vertices, CAMERAS)
    assert lifted.views[0] == 4
    assert np.abs(lifted.motion[0] - [0.0, 25.0, 0.0]).max() < 1.0  # mm: one linear step of 25


def test_pinned_vertices_are_vouched_for() -> None:
    told = corrections(*EVERY)
    pinned = told.for_frame(2).assured(len(MESH.vertices))
    assert pinned[100] == 0.5  # by one view
    assert sorted(pinned[list(TRIANGLE)]) == [0.25, 0.25, 0.5]  # two views, shared out
    assert (pinned > 0).sum() == 4
    drawn = told.for_frame(3).assured(len(MESH.vertices))
    assert np.flatnonzero(drawn).tolist() == [40, 41, 42, 43]
    assert not told.for_frame(9).assured(len(MESH.vertices)).any()


def test_pins_of_one_weight_go_together() -> None:
    told = corrections(*EVERY).for_frame(2).sightings
    assert [one.weight for one in told] == [0.5 * PIN_WEIGHT, PIN_WEIGHT]
    assert told[0].cameras == ("cam00", "cam03")
    assert told[0].pixel.tolist() == [[61.0, 72.0], [60.0, 70.0]]


@given(order=st.permutations(ALL))
def test_the_order_of_entries_says_nothing(order: list[Correction]) -> None:
    one, other = corrections(*ALL), corrections(*order)
    for frame in SUBJECT.frames:
        assert one.key(frame) == other.key(frame)
        pairs = zip(one.for_frame(frame).sightings, other.for_frame(frame).sightings, strict=True)
        for a, b in pairs:
            assert a.pixel.tobytes() == b.pixel.tobytes()
            assert a.surface.barycentric.tobytes() == b.surface.barycentric.tobytes()


CHANGES: list[tuple[int, Correction, set[int]]] = [
    (0, replace(EVERY[0], pixels={"cam01": (40.25, 50.75)}), {2}),
    (1, replace(EVERY[1], weight=0.75), {2}),
    (2, replace(EVERY[2], frame=4), {3, 4}),
    (3, ViewExclusion(camera="cam00", first=4, last=7), {7}),
    (3, ViewExclusion(camera="cam01", first=4, last=6), {4, 5, 6}),
    (4, FrameExclusion(first=4, last=5), {4}),
    (5, Anchor(frame=9), {8, 9}),
    (6, Lock(frame=7, sha256="cd" * 32), {7}),
]


@pytest.mark.parametrize(("index", "change", "affected"), CHANGES)
def test_the_key_changes_where_the_correction_does_and_nowhere_else(
    index: int, change: Correction, affected: set[int]
) -> None:
    before = corrections(*ALL)
    after = corrections(*[*ALL[:index], change, *ALL[index + 1 :]])
    changed = {frame for frame in SUBJECT.frames if before.key(frame) != after.key(frame)}
    assert changed == affected


def test_overlapping_ranges_are_as_one() -> None:
    one = corrections(FrameExclusion(first=2, last=5))
    two = corrections(FrameExclusion(first=2, last=4), FrameExclusion(first=3, last=5))
    assert one.excluded == two.excluded
    assert [one.key(f) for f in SUBJECT.frames] == [two.key(f) for f in SUBJECT.frames]


def test_a_closed_chain_has_each_vertex_once() -> None:
    curve = EVERY[2]
    assert isinstance(curve, Curve)
    closed = replace(curve, vertices=(40, 41, 60, 59, 40))
    (sightings,) = corrections(closed).for_frame(3).sightings
    assert len(sightings.surface) == 4
