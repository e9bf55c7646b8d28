"""Why a device found no board, in words: wrong board file, mirrored, dark, blurred, out of view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from capture.arrays import Image
from capture.errors import TakeError, raise_all
from recon.board.april_grid import AprilGrid
from recon.board.body import BoardBody, FlatBoard
from recon.board.charuco import Board
from recon.board.corners import BLURRED, LOST, SPARE, STILL, USED, BoardTake
from recon.board.marker_census import MarkerKind, MarkerSet, marker_census
from recon.board.marker_layout import Layout, fitting, likely_layouts
from recon.board.marker_search import levels
from recon.board.observations import BoardObservations
from recon.board.sightings import BoardSightings
from recon.images import mono, white

_LOOKS = 4  # images of a device that are looked at
_FIRST = 3  # devices looked at first when none found the board
_FEW = 0.25  # of the share of frames of the better devices: a device below it is blind
_LARGEST_PX = 1600  # images are looked at no larger than this
_BLACK, _WHITE, _EMPTY = 0.04, 0.9, 0.03  # of white: brightest, darkest, and their difference
_STEADY = 0.8  # of a device's views: when more are blurred it is the focus
_WHOLE = 0.9  # of the markers read: when so many lie as the file says, the file is right
_MORE = 1.2  # another board must explain so many times the markers that the file explains
_BENT = 0.25  # of the corners' distance: further off than this from a flat board is wrong
_FLAT_SHARE = 0.7  # of the corners of a view must be right
_VIEWS = 8  # of a device, that are tried for flatness
_SELDOM, _HALF = 4, 0.5  # views, and share of frames, below which a device hardly sees the board
_AS_FILED = "as filed"

_Found = Mapping[MarkerKind, MarkerSet]


def explain_blind(take: BoardTake, body: BoardBody, sightings: BoardSightings) -> dict[str, str]:
    """Why devices found the board in far fewer frames than others, or in none.

    A few images of each are looked at: with every marker dictionary, mirrored, and with boards of
    other numbers of squares. When no device found anything and the first three agree on what is
    wrong with the board file, the others are taken to agree.

    Args:
        take: the board take.
        body: what was searched for.
        sightings: what was found.

    Returns:
        By device, words that do not name it.

    Raises:
        TakeError: when every device found corners all the same, and all agree on what is wrong
            with the board file: an array solved with it would be wrong without a sign.
    """
    blind = [name for name in take.device_names if _is_blind(name, body, sightings)]
    examiner = _Examiner(take, body, sightings)
    if len(blind) == len(take.device_names) > _FIRST:
        places = np.linspace(0, len(blind) - 1, _FIRST).round().astype(int).tolist()
        first = {_of_file(examiner.look(blind[place])) for place in places}
        if len(first) == 1 and "" not in first:
            return _unless_found(examiner.named(dict.fromkeys(blind, first.pop())), sightings)
    return _unless_found(examiner.named({name: examiner.look(name) for name in blind}), sightings)


def _unless_found(words: dict[str, str], sightings: BoardSightings) -> dict[str, str]:
    """The words; refused when corners were found of a board that is not the file's."""
    agree = len(words) == len(sightings.tally) and len(set(words.values())) == 1
    if agree and all(map(_of_file, words.values())) and all(map(_found, sightings.tally.values())):
        lines = merged_words(words, len(words))
        raise_all("the board is not as its file says", lines, TakeError)
    return words


def merged_words(words: Mapping[str, str], devices: int) -> list[str]:
    """One line for all devices of which the same is said.

    Args:
        words: by device, what is said of it.
        devices: how many devices the array has.
    """
    groups: dict[str, list[str]] = {}
    for name, what in words.items():
        groups.setdefault(what, []).append(name)
    return [
        f"all {devices} devices: {what}"
        if len(names) == devices > 1
        else f"{', '.join(names)}: {what}"
        for what, names in groups.items()
    ]


def _is_blind(name: str, body: BoardBody, sightings: BoardSightings) -> bool:
    """Whether a device found the board in none of its frames, in few, or not as a flat board."""
    shares = {}
    for device, counts in sightings.tally.items():
        frames = sum(counts.values()) - counts.get(LOST, 0)
        shares[device] = _found(counts) / max(frames, 1)
    usual = float(np.quantile(list(shares.values()), 0.75))
    few = shares[name] == 0.0 or shares[name] < _FEW * usual
    few = few or (_found(sightings.tally[name]) < _SELDOM and shares[name] < _HALF)
    return few or _is_scattered(name, body, sightings.every)


def _is_scattered(name: str, body: BoardBody, every: BoardObservations) -> bool:
    """Whether the corners in most views of a device lie as on no flat board."""
    shape = body.shape()
    index = every.device_names.index(name)
    views = [rows for device, _, rows in every.views() if device == index]
    tried = wrong = 0
    for rows in views[:: 1 + len(views) // _VIEWS]:
        face = shape.face[every.corner[rows]]
        widest = face == np.bincount(face).argmax()
        flat, pixels = shape.flat[every.corner[rows][widest]], every.pixels[rows][widest]
        pitch_mm = body.faces[int(face[widest][0])].board.pitch_mm
        back, inside = cv2.findHomography(pixels, flat, cv2.RANSAC, _BENT * pitch_mm, maxIters=200)
        tried += 1
        wrong += int(back is None or float(inside.mean()) < _FLAT_SHARE)
    return 2 * wrong > tried


def _found(counts: Mapping[str, int]) -> int:
    return sum(counts.get(reason, 0) for reason in (USED, STILL, SPARE))


class _Examiner:
    """Looks at images of a take, and remembers which markers it has seen.

    Words name a dictionary by `_seen`, because only all images together tell how large it is.
    """

    def __init__(self, take: BoardTake, body: BoardBody, sightings: BoardSightings) -> None:
        self._take, self._body, self._sightings = take, body, sightings
        self._highest: dict[MarkerKind, int] = {}

    def named(self, words: Mapping[str, str]) -> dict[str, str]:
        """The words with the dictionaries seen named: the smallest that hold all ids seen."""
        names = {_seen(kind): kind.dictionary(highest) for kind, highest in self._highest.items()}
        out = dict(words)
        for token, dictionary in names.items():
            out = {name: what.replace(token, dictionary) for name, what in out.items()}
        return out

    def look(self, name: str) -> str:
        """What is wrong with a device's images."""
        counts = self._sightings.tally[name]
        frames = sum(counts.values())
        if counts.get(LOST, 0) == frames:
            return f"all its {frames} frames were lost: see the take's ledger"
        if counts.get(BLURRED, 0) > _found(counts):
            return _blurred(counts, self._sightings.blur_px[name])
        images = [
            self._take.image(name, frame) for frame in _frames(self._take, name, self._sightings)
        ]
        votes = Counter(words for image in images if (words := _exposure(image)))
        if votes and votes.total() > len(images) // 2:
            return (
                f"{votes.most_common(1)[0][0]} in {votes.total()} of {len(images)} images looked at"
            )
        whys = Counter(why for image in images if (why := self._misfit(image)))
        few = ", ".join(f"{n} {reason}" for reason, n in counts.items() if n and reason != LOST)
        if not whys and _found(counts) and _is_scattered(name, self._body, self._sightings.every):
            return (
                "finds corners, but not where the board file has them: compare its kind and all "
                "its sizes (squares and markers, tags and gaps) with the board"
            )
        if not whys:
            return (
                f"no board in {len(images)} images looked at, plain or mirrored, of any marker "
                f"dictionary ({few}): out of its view, turned away, too small, or out of focus"
            )
        why, times = whys.most_common(1)[0]
        if why == _AS_FILED:
            return (
                f"the board is as its file says in {times} of {len(images)} images looked at, but "
                f"seldom seen whole enough ({few}): show this device more of it"
            )
        return why

    def _misfit(self, image: Image) -> str:
        """What about the board in an image is not as the board file says; "" when there is none."""
        _, in_bytes = levels(image)
        scale = _LARGEST_PX / max(in_bytes.shape)
        if scale < 1.0:
            in_bytes = cv2.resize(in_bytes, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        boards = [face.board for face in self._body.faces]
        plain = marker_census(in_bytes)
        share, count = max(_fits(plain, board) for board in boards)
        if share >= _WHOLE:
            return _AS_FILED
        words, others = self._other_board(plain, boards)
        if others > _MORE * count:
            return words
        if count:
            return _AS_FILED
        mirrored = marker_census(np.ascontiguousarray(in_bytes[:, ::-1]))
        if any(_fits(mirrored, board)[1] for board in boards):
            return (
                "its images are mirrored (the board is found after flipping left to right): switch "
                "off the mirror in its driver"
            )
        words, _ = self._other_board(mirrored, boards)
        return (
            words and f"its images are mirrored (switch off the mirror in its driver), and {words}"
        )

    def _other_board(self, found: _Found, boards: Sequence[FlatBoard]) -> tuple[str, int]:
        """What board the markers lie on, and what the file says instead; how many agree."""
        best: tuple[int, MarkerKind, list[Layout]] | None = None
        for kind, markers in found.items():
            own = any(MarkerKind.of(board) == kind for board in boards)
            top, layouts = _best_layouts(markers, kind, boards, all_of_them=own)
            if top and (best is None or top > best[0]):
                best = top, kind, layouts
        if best is None:
            return "", 0
        count, kind, layouts = best
        same = [board for board in boards if MarkerKind.of(board) == kind]
        if not same:
            self._highest[kind] = max(self._highest.get(kind, 0), int(found[kind].ids.max()))
            return _other_kind(kind, boards), count
        return _other_layout(layouts, same[0]), count


def _of_file(words: str) -> str:
    """The words, when they are about the board file alone; "" when they are about the device."""
    return words if "board file" in words and "mirror" not in words else ""


def _frames(take: BoardTake, name: str, sightings: BoardSightings) -> list[int]:
    """Frames of a device to look at, spread over those in which any saw the board."""
    present = [frame for frame in take.frames if take.present(name, frame)]
    every = sightings.every
    seen = Counter(every.frames[pose] for _, pose, _ in every.views())
    good = [frame for frame in present if seen[frame]] or present
    places = np.linspace(0, len(good) - 1, min(_LOOKS, len(good))).round().astype(int)
    return [good[place] for place in places.tolist()]


def _blurred(counts: Mapping[str, int], blur_px: float) -> str:
    blurred, found = counts[BLURRED], _found(counts)
    steady = blurred > _STEADY * (blurred + found)
    cause = (
        "its images are soft as a whole: focus, aperture or a dirty lens"
        if steady
        else "motion, or a board out of its depth of field: hold it still at each place"
    )
    return (
        f"sees the board, blurred in {blurred} of {blurred + found} frames "
        f"(edges {blur_px:.1f} px wide at the middle frame, above max_blur_px): {cause}"
    )


def _exposure(image: Image) -> str:
    """Whether an image is black, white or empty."""
    top = white(image)
    full = float(np.iinfo(image.dtype).max) if image.dtype.kind == "u" else 1.0
    grey = mono(image)[::3, ::3] * (full / top)
    dark, bright = np.percentile(grey, [1, 99.5])
    if bright < _BLACK:
        return "its image is black (lens cap, exposure, light or trigger)"
    if dark > _WHITE:
        return "its image is white (exposure or gain far too high)"
    if bright - dark < _EMPTY:
        return "its image is empty (one even grey: lens cap, fog or a test pattern)"
    return ""


def _fits(found: _Found, board: FlatBoard) -> tuple[float, int]:
    """Share and number of the markers of a board's look that lie as its file says."""
    markers = found.get(MarkerKind.of(board))
    if markers is None:
        return 0.0, 0
    return fitting(markers, Layout.of(board))


def _best_layouts(
    markers: MarkerSet, kind: MarkerKind, boards: Sequence[FlatBoard], *, all_of_them: bool
) -> tuple[int, list[Layout]]:
    """How many markers the best layout explains, and all layouts that explain as many.

    Args:
        markers: of one look.
        kind: that look.
        boards: as their file says.
        all_of_them: False stops at the first layout that explains nearly all markers.
    """
    tags = "APRILTAG" in kind.family or any(isinstance(board, AprilGrid) for board in boards)
    top = 0
    best: list[Layout] = []
    for layout in likely_layouts(boards, tags=tags):
        share, count = fitting(markers, layout)
        if count and count >= top:
            best = [*(best if count == top else []), layout]
            top = count
            if share >= _WHOLE and not all_of_them:
                break
    return top, best


def _other_kind(kind: MarkerKind, boards: Sequence[FlatBoard]) -> str:
    """What is said of markers that no board of the file has."""
    same = [
        board.border_bits
        for board in boards
        if isinstance(board, AprilGrid) and MarkerKind.of(board).family == kind.family
    ]
    if same:
        return (
            f"sees markers of {_seen(kind)} with border_bits = {kind.border_bits}; "
            f"the board file says border_bits = {same[0]}"
        )
    said = ", ".join(dict.fromkeys(board.dictionary for board in boards))
    return f"sees markers of {_seen(kind)}; the board file says {said}"


def _other_layout(layouts: Sequence[Layout], board: FlatBoard) -> str:
    """What a layout that fits says against the file, when only one does, or all agree."""
    own = Layout.of(board)
    layout = layouts[0]
    sure = len(layouts) == 1
    same_rows = layout.kind == own.kind and layout.columns == own.columns
    if not sure and not same_rows:
        return (
            f"sees markers of {board.dictionary} that do not lie as on the board of the board "
            f"file: compare its numbers of squares, and legacy, with the board"
        )
    if layout.kind != own.kind:
        names = {"charuco": "a ChArUco board", "aprilgrid": "an AprilGrid"}
        return f'the markers lie as on {names[layout.kind]}; the board file says "{own.kind}"'
    if layout.columns != own.columns:
        unit, key = ("squares", "squares_x") if isinstance(board, Board) else ("tags", "tags_x")
        return (
            f"the markers lie as on a board with {layout.columns} {unit} a row; "
            f"the board file says {key} = {own.columns}"
        )
    if layout.first_id != own.first_id:
        return (
            f"the markers count from {layout.first_id}; "
            f"the board file says first_id = {own.first_id}"
        )
    if isinstance(board, AprilGrid):
        return f'the tags lie as in the other layout; the board file says "{board.layout}"'
    return _other_rows(board, layout)


def _other_rows(board: Board, layout: Layout) -> str:
    """The first marker stands in the other column: `legacy`, or an even or odd number of rows."""
    if board.squares_y % 2 == 0:
        said, fits = ("true", "false") if board.legacy else ("false", "true")
        return f"legacy = {fits} fits; the board file says legacy = {said}"
    assumed = "an even number of squares a column and legacy = true"
    return (
        f"the markers lie as on a board with {assumed}; the board file says "
        f"squares_y = {board.squares_y}"
    )


def _seen(kind: MarkerKind) -> str:
    return f"<{kind.family} {kind.border_bits}>"
