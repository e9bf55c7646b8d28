"""White places of a board, and what is read there of rendered images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from capture.arrays import Floats, Image
from capture.errors import SettingsError
from capture.pose import Pose
from recon.board.april_grid import AprilGrid
from recon.board.body import BoardBody, BoardFace
from recon.board.charuco import Board
from recon.photometry.board_spots import BoardSpots, ink_spots, white_spots
from recon.photometry.white_samples import SampleLimits, WhiteReadings, sample_whites
from tests.synthetic_light import BIG_BOARD
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state, render_board

BODY = BoardBody.of(BIG_BOARD)


def drawn(board: Board) -> Image:
    size = (round(8 * board.size_mm[0]), round(8 * board.size_mm[1]))
    return np.asarray(board.pattern().generateImage(size, marginSize=0))


def inside(image: Image, spots: BoardSpots, share: float) -> Floats:
    """Values (S, K) of a drawing, 8 px a mm, on circles of that share of each spot's radius."""
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = share * np.column_stack([np.cos(angle), np.sin(angle)])
    at = spots.places[:, None, :2] + spots.radius_mm[:, None, None] * ring
    pixel = np.clip((8 * at).astype(int), 0, [[image.shape[1] - 1, image.shape[0] - 1]])
    values: Floats = image[pixel[:, :, 1], pixel[:, :, 0]].astype(float)
    return values


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("board", [A4_BOARD, BIG_BOARD])
def test_white_places_are_white_and_black_ones_black(board: Board, legacy: bool) -> None:
    board = Board(**{**vars(board), "legacy": legacy, "squares_y": 6})
    body, image = BoardBody.of(board), drawn(board)
    white, ink = white_spots(body), ink_spots(body)
    assert (inside(image, white, 0.95) == 255).all()
    assert (inside(image, ink, 0.95) == 0).all()
    assert len(ink) == board.squares_x * board.squares_y // 2
    squares = {tuple(k) for k in (white.places[:, :2] // board.square_mm).astype(int).tolist()}
    assert len(squares) == board.squares_x * board.squares_y // 2  # every white square has one
    assert white.radius_mm.min() > 0.9 * 0.5 * (board.square_mm - board.marker_mm) / 2


def test_the_white_of_an_april_grid_lies_between_its_tags() -> None:
    grid = AprilGrid(tags_x=3, tags_y=2, tag_mm=24.0, gap_mm=8.0)
    white, ink = (spots(BoardBody.of(grid)) for spots in (white_spots, ink_spots))
    _, tags = grid.markers()
    low, high = tags[:, :, :2].min(axis=1), tags[:, :, :2].max(axis=1)
    for place, radius in zip(white.places, white.radius_mm, strict=True):
        beside = np.maximum(low - place[:2], place[:2] - high).clip(min=0)
        assert np.linalg.norm(beside, axis=1).min() >= radius - 1e-9
        away = np.abs(place[:2] - ink.places[:, :2]).max(axis=1)  # from the black squares
        assert away.min() >= 2 * radius - 1e-9
    assert len(white) == 3 * (2 * 2 + 3)  # three discs in each of seven strips
    assert len(ink) == 12


def test_faces_of_a_body_carry_their_spots_with_them() -> None:
    place = Pose.from_rotation_vector(np.array([0.0, 0.5, 0.0]), np.array([300.0, 0, 0]))
    faces = (
        BoardFace("front", BIG_BOARD, Pose.identity()),
        BoardFace("side", Board(**{**vars(BIG_BOARD), "first_id": 50}), place),
    )
    both, one = white_spots(BoardBody(faces)), white_spots(BODY)
    side = both.places[len(both) // 2 :]
    assert side.shape[0] > 0
    normal = np.cross(both.across, both.down)[-1]
    np.testing.assert_allclose(normal, place.rotation[:, 2], atol=1e-12)
    np.testing.assert_allclose(both.places[: len(one)], one.places)
    loose = BoardBody((faces[0], BoardFace("side", faces[1].board, None)))
    with pytest.raises(SettingsError, match="board 'side': its place on the body is not known"):
        white_spots(loose)


class OneView:
    """A take of one device and one frame."""

    device_names = ("cam00",)
    frames = (0,)

    def __init__(self, image: Image) -> None:
        self.picture = image

    def size(self, device: str) -> tuple[int, int]:
        return self.picture.shape[1], self.picture.shape[0]

    def present(self, device: str, frame: int) -> bool:
        return True

    def image(self, device: str, frame: int) -> Image:
        return self.picture


SCENE = BoardScene(size_px=480, focal_px=1000.0, radius_mm=620.0, devices=1, span_deg=0.0, poses=3)
TRUTH = make_state(SCENE, BIG_BOARD)
POSE = TRUTH.array_from_board[1]


@pytest.fixture(scope="module")
def picture() -> Image:
    return render_board(TRUTH.cameras[0], POSE, BIG_BOARD)


def read(image: Image, **limits: float) -> WhiteReadings:
    views = [(0, POSE, ("cam00",))]
    wanted = SampleLimits(**limits)
    return sample_whites(OneView(image), BODY, TRUTH.cameras, views, limits=wanted)


def test_white_is_read_without_a_trace_of_ink(picture: Image) -> None:
    found = read(picture)
    level = (0.75 * 255 + 20) / 255  # of `render_board`
    assert len(found.samples) > 40
    assert abs(np.median(found.samples.value) / level - 1) < 0.001
    assert np.abs(found.samples.value / level - 1).max() < 0.012  # noise of 2 DN
    assert found.ink_ratio[0] == pytest.approx(20 / 211.25, abs=0.005)
    assert found.darkest[0] < 0.09


def test_blur_is_kept_away_by_the_edge(picture: Image) -> None:
    soft = cv2.GaussianBlur(picture, (0, 0), 1.5)
    level = (0.75 * 255 + 20) / 255
    near = read(soft, edge_px=0.5).samples.value / level - 1
    far = read(soft, edge_px=3.3).samples.value / level - 1
    assert near.min() < -0.02
    assert len(far) > 10
    assert far.min() > -0.02
    assert abs(far.mean()) < 0.006


def test_clipped_uneven_and_dark_places_are_left_out_and_counted(picture: Image) -> None:
    bright = np.clip(picture.astype(float) * 1.3, 0, 255).astype(np.uint8)
    found = read(bright)
    assert len(found.samples) == 0
    assert found.left_out["clipped"][0] > 40
    dark = read((picture // 60).astype(np.uint8))
    assert len(dark.samples) == 0
    assert dark.left_out["dark"][0] > 40
    spotted = picture.copy()
    spotted[::3, ::3] = 60
    assert read(spotted).left_out["uneven"][0] > 40


def test_gamma_shows_in_the_ink(picture: Image) -> None:
    encoded = np.round(255 * (picture / 255.0) ** (1 / 2.2)).astype(np.uint8)
    assert read(encoded).ink_ratio[0] > 0.3
