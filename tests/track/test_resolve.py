"""Corrections in a tracked take: how far they reach, what is solved again, and what stays."""

import numpy as np
import pytest

from capture.arrays import Floats
from capture.take import Take
from recon.mesh import Mesh
from recon.visiting import import_take
from tests.track.corrections.patch_subject import SUBJECT
from tests.track.moving_patch import write_patch_visit
from track.corrections.checks import Subject
from track.corrections.edits import add, lock, undo
from track.corrections.entries import Anchor, Correction, FrameExclusion, Pin, ViewExclusion
from track.corrections.replay import Corrections
from track.corrections.sidecar import LockedFrame
from track.performance import Performance
from track.resolve import ResolveSettings, runs_of
from track.stage import TrackSettings, track

FRAMES = tuple(range(10))
REACH = ResolveSettings(reach_frames=2, ease_frames=1)
SETTINGS = TrackSettings(passes=1, correction_reach=2, correction_ease=1)
VERTEX = 180  # the middle of the patch


def _pin(frame: int) -> Pin:
    return Pin(frame=frame, corners=(VERTEX,), barycentric=(1.0,), pixels={"cam01": (40.0, 50.0)})


def _runs(*what: Correction, chosen: tuple[int, int] | None = None) -> dict[int, int]:
    return runs_of(FRAMES, Corrections(SUBJECT, what), REACH, chosen)


def test_a_pin_carries_the_frames_around_it() -> None:
    assert _runs(_pin(4)) == {2: 4, 3: 4, 4: 4, 5: 4, 6: 4}
    assert _runs(_pin(0)) == {0: 0, 1: 0, 2: 0}


def test_two_pins_share_the_frames_between_them_by_distance() -> None:
    assert _runs(_pin(3), _pin(6)) == {1: 3, 2: 3, 3: 3, 4: 3, 5: 6, 6: 6, 7: 6, 8: 6}


def test_an_anchor_carries_all_frames_and_a_view_left_out_only_its_own() -> None:
    assert set(_runs(Anchor(frame=5)).values()) == {5}
    assert len(_runs(Anchor(frame=5))) == len(FRAMES)
    assert _runs(ViewExclusion(camera="cam00", first=7, last=8)) == {7: 7, 8: 8}


def test_a_chosen_range_is_carried_whole_and_nothing_else() -> None:
    assert _runs(_pin(4), _pin(9), chosen=(1, 7)) == dict.fromkeys(range(1, 8), 4)


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Take, Mesh, Floats, Performance]:
    folder = tmp_path_factory.mktemp("corrected")
    amounts = np.sin(np.linspace(0.0, np.pi, 8)).tolist()
    mesh, truth = write_patch_visit(folder / "visit", amounts)
    take = import_take(folder / "visit", folder / "take")
    return take, mesh, truth, track(take, mesh, SETTINGS)


def _true_pin(take: Take, truth: Floats, frame: int, away_px: float) -> Pin:
    cameras = {camera.name: camera for camera in take.cameras()}
    pixels = {
        name: cameras[name].project(truth[frame][[VERTEX]])[0] + away_px
        for name in ("cam01", "cam02")
    }
    told = {name: (float(x), float(y)) for name, (x, y) in pixels.items()}
    return Pin(frame=frame, corners=(VERTEX,), barycentric=(1.0,), pixels=told)


def _solved(take: Take) -> dict[str, int]:
    folder = take.products / "track" / "corrected"
    return {path.name: path.stat().st_mtime_ns for path in sorted(folder.glob("*.npz"))}


def test_corrections_change_what_they_reach_and_undoing_them_gives_it_back(
    tracked: tuple[Take, Mesh, Floats, Performance],
) -> None:
    take, mesh, truth, base = tracked
    subject = Subject.of(take, mesh)
    add(take.folder, subject, [_true_pin(take, truth, 2, 3.0)])
    pinned = track(take, mesh, SETTINGS)
    moved = np.linalg.norm(pinned.vertices - base.vertices, axis=2).max(axis=1)
    assert moved[2] > 0.5  # mm
    assert (moved[5:] == 0.0).all()
    before = _solved(take)
    add(take.folder, subject, [ViewExclusion(camera="cam00", first=3, last=6)])
    track(take, mesh, SETTINGS)
    after = _solved(take)
    with np.load(take.products / "track" / "corrected" / "frame_0003.npz") as held:
        assert held["view_seen"][0] == 0  # carried by the pin, and the view is left out there too
        assert (held["view_seen"][1:] > 0).all()
    # A frame without a run of its own is solved for itself; the pin's run is told more now.
    assert {"frame_0005.npz", "frame_0006.npz"} <= set(after) - set(before)
    lone = {name: after[name] for name in ("frame_0005.npz", "frame_0006.npz")}
    undo(take.folder, subject)
    undo(take.folder, subject)
    assert (track(take, mesh, SETTINGS).vertices == base.vertices).all()
    add(take.folder, subject, [ViewExclusion(camera="cam00", first=5, last=6)])
    track(take, mesh, SETTINGS)
    assert {name: _solved(take)[name] for name in lone} == lone  # told the same: not solved again
    undo(take.folder, subject)


def test_locked_frames_stay_and_excluded_ones_are_filled(
    tracked: tuple[Take, Mesh, Floats, Performance],
) -> None:
    take, mesh, truth, base = tracked
    subject = Subject.of(take, mesh)
    kept = base.vertices[3] + np.float32(0.5)
    lock(take.folder, subject, {3: LockedFrame(vertices=kept, confidence=base.confidence[3])})
    add(take.folder, subject, [FrameExclusion(first=6, last=6)])
    found = track(take, mesh, SETTINGS)
    np.testing.assert_array_equal(found.vertices[3], kept)
    assert 0.0 < np.abs(found.vertices[4] - base.vertices[4]).max() < 0.9  # drawn along
    assert (found.confidence[6] == 0.0).all()
    inner = np.abs(mesh.vertices[:, :2]).max(axis=1) < 36.0
    away = np.linalg.norm(found.vertices[6] - truth[6], axis=1)[inner]
    assert np.sqrt((away**2).mean()) < 0.3  # mm: between two tracked neighbours
    undo(take.folder, subject)
    undo(take.folder, subject)
    assert (track(take, mesh, SETTINGS).vertices == base.vertices).all()
