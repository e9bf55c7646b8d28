"""Sculpting the neutral head: contours lofted from crown to neck, then smooth analytic features.

All numbers are millimetres in the head's own space: +Y up, the face along +Z, the origin inside the
head below the level of the eyes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import Akima1DInterpolator, PchipInterpolator

from capture.arrays import Floats, Ints
from tools.actor.identity import Identity
from tools.actor.lattice import COLUMNS, EYE_ROW, ROWS, Lattice, Slit
from tools.actor.lumps import lumps

EYE_LEVEL = 8.0
BALL_RADIUS = 12.6
LID_RADIUS = 14.0  # the skin of the lids, from the centre of the ball
_STOMION = -58.0
_EYE_HALF = 14.0

# row, front y, front z, half breadth, z of the broadest point, back z, front exponent, side y,
# back y, half breadth of the rear
_CONTOURS = (
    (20, 43.0, 93.5, 75.0, -8.0, -101.0, 2.25, 40.0, 36.0, 75.0),
    (28, 26.0, 94.0, 74.5, -9.0, -101.0, 2.35, 22.0, 14.0, 74.5),
    (36, 8.0, 89.0, 73.0, -10.0, -99.0, 2.40, 5.0, -6.0, 73.0),
    (45, -12.0, 86.5, 71.0, -10.0, -95.0, 2.35, -14.0, -24.0, 70.0),
    (57, -35.0, 91.0, 67.0, -12.0, -88.0, 2.20, -35.0, -42.0, 64.0),
    (70, -58.0, 91.0, 62.0, -14.0, -80.0, 2.05, -52.0, -58.0, 56.0),
    (78, -74.0, 87.5, 58.5, -16.0, -76.0, 2.05, -63.0, -70.0, 50.5),
    (84, -89.0, 89.0, 55.0, -18.0, -74.0, 2.10, -74.0, -82.0, 48.0),
    (89, -103.0, 81.0, 48.0, -18.0, -72.0, 2.10, -86.0, -92.0, 46.5),
    (93, -108.0, 60.0, 45.5, -18.0, -70.0, 2.05, -97.0, -104.0, 45.0),
    (97, -119.0, 34.0, 46.5, -16.0, -70.0, 2.00, -114.0, -118.0, 47.0),
    (100, -148.0, 28.0, 49.0, -18.0, -76.0, 2.00, -146.0, -144.0, 52.0),
    (103, -205.0, 42.0, 96.0, -24.0, -98.0, 2.20, -196.0, -190.0, 94.0),
)
_CROWN_ROWS = ((0, 90.0), (4, 69.0), (8, 47.0), (13, 24.0))  # row, latitude in degrees


@dataclass(frozen=True, eq=False)
class Sculpture:
    """A sculpted neutral and the places that other modules need.

    Attributes:
        vertices: (V, 3) head space, mm.
        balls: (2, 3) centres of the right and the left eyeball, mm.
        stomion: (3,) where the lips meet on the midline, mm.
    """

    vertices: Floats
    balls: Floats
    stomion: Floats


def bump(*terms: Floats) -> Floats:
    """A Gaussian of already scaled offsets: exp(-(a^2 + b^2 + ...))."""
    total: Floats = np.exp(-sum(term * term for term in terms))
    return total


def smooth_step(low: float, high: float, value: Floats) -> Floats:
    """0 below `low`, 1 above `high`, a cubic between; `low` may be the larger."""
    part = np.clip((value - low) / (high - low), 0.0, 1.0)
    blended: Floats = part * part * (3.0 - 2.0 * part)
    return blended


def sculpt(lattice: Lattice, who: Identity) -> Sculpture:
    """Sculpt the neutral of one identity, lips closed and touching, eyes open.

    Args:
        lattice: the topology.
        who: the proportions.
    """
    points = _loft()[lattice.row, lattice.column % COLUMNS]
    points = _proportions(points, who)
    points = points + lumps(points, who.lumps, who.seed)
    points = _features(points, who)
    points = _ears(points)
    balls = []
    for slit in lattice.eyes:
        points, ball = _eye(points, lattice, slit, who)
        balls.append(ball)
    points = _mouth(points, lattice, who)
    stomion = 0.5 * (points[lattice.mouth.upper] + points[lattice.mouth.lower])
    middle = stomion[len(stomion) // 2]
    return Sculpture(points, np.array(balls), middle)


def _angles() -> Floats:
    """Azimuth (COLUMNS,) of every column, dense over the face, radians."""
    half = COLUMNS // 2
    knots = PchipInterpolator([0, 25, 34, 46, half], np.radians([0.0, 41.0, 70.0, 113.0, 180.0]))
    column = np.arange(COLUMNS)
    signed_column = np.where(column <= half, column, column - COLUMNS)
    angle: Floats = np.sign(signed_column) * knots(np.abs(signed_column))
    return angle


def _loft() -> Floats:
    """(ROWS, COLUMNS, 3): key contours joined along columns by splines that do not overshoot."""
    angle = _angles()
    sine, cosine = np.sin(angle), np.cos(angle)
    rows, contours = [], []
    for row, latitude in _CROWN_ROWS:
        ring = np.cos(np.radians(latitude))
        x = ring * sine
        z = (ring + 0.42 * (1.0 - ring)) * cosine
        y = np.maximum(1.0 - np.hypot(x, z) ** 2.3, 0.0) ** (1.0 / 2.3)
        rows.append(row)
        contours.append(np.stack([75.0 * x, 26.0 + 94.0 * y, -4.0 + 98.0 * z], axis=1))
    for row, front_y, front_z, broad, middle_z, back_z, power, side_y, back_y, rear in _CONTOURS:
        exponent = np.where(cosine > 0, power, 2.0)
        radius = (np.abs(sine) ** exponent + np.abs(cosine) ** exponent) ** (-1.0 / exponent)
        depth = np.where(cosine > 0, front_z - middle_z, middle_z - back_z)
        aside = sine * sine
        y = np.where(cosine > 0, front_y, back_y) * (1.0 - aside) + side_y * aside
        breadth = broad + (rear - broad) * np.minimum(cosine, 0.0) ** 2
        x, z = breadth * radius * sine, middle_z + depth * radius * cosine
        rows.append(row)
        contours.append(np.stack([x, y, z], axis=1))
    lofted: Floats = Akima1DInterpolator(rows, np.stack(contours), axis=0, method="makima")(
        np.arange(ROWS)
    )
    lofted[0, :, 0] = 0.0
    return lofted


def _proportions(points: Floats, who: Identity) -> Floats:
    x, y, z = points.T
    wide = np.abs(x)
    below = smooth_step(EYE_LEVEL + 10.0, EYE_LEVEL - 30.0, y)
    out = points.copy()
    out[:, 0] *= who.head_width
    out[:, 1] = y + (who.face_length - 1.0) * (y - EYE_LEVEL) * below
    side = np.tanh(x / 20.0)
    out[:, 0] += side * who.cheek_width * bump((wide - 62) / 28, (y + 12) / 26, (z - 25) / 40)
    out[:, 0] += side * who.jaw_width * bump((wide - 52) / 26, (y + 78) / 24, (z - 12) / 45)
    out[:, 0] += (
        side * who.eye_spacing * bump((wide - 31) / 22, (y - EYE_LEVEL) / 18, (z - 75) / 40)
    )
    out[:, 2] += who.chin_forward * bump(x / 28, (y + 94) / 18, (z - 85) / 40)
    return out


def _features(points: Floats, who: Identity) -> Floats:
    """Push the face along +Z, a little along Y, into brows, sockets, nose, cheeks, lips, chin."""
    x, y, z = points.T
    wide = np.abs(x)
    front = smooth_step(-20.0, 30.0, z)
    push = who.brow_ridge * bump((wide - 24) / 22, (y - 25) / 9)
    push -= 1.5 * bump(x / 9, (y - 24) / 8)
    push -= 9.5 * bump((wide - 20.5) / 10.5, (y - 5) / 11)
    push -= 5.0 * bump((wide - 36) / 14, (y - 9) / 11)
    push += 3.5 * bump((wide - 42) / 17, (y + 20) / 15)
    push -= 2.0 * bump((wide - 60) / 12, (y - 20) / 20)
    push -= 2.5 * bump((wide - 42) / 13, (y + 52) / 17)
    push += _nose(x, y, who)
    push += _lips(x, y, who)
    push -= 1.6 * bump(x / 20, (y + 73) / 5.0)
    push += 3.6 * bump(x / 15, (y + 90) / 9)
    fold = 17.0 + 14.0 * np.clip((-30.0 - y) / 28.0, 0.0, 1.3)
    push -= 1.3 * bump((wide - fold) / 3.2, (y + 44) / 13)
    out = points.copy()
    out[:, 2] += front * push
    nostril = bump((wide - 6.2) / 3.2, (y + 33.0) / 2.4)
    out[:, 2] -= 4.0 * nostril
    out[:, 1] += 2.2 * nostril - who.nose_length * bump(x / 12, (y + 27) / 10) * front
    return out


def _nose(x: Floats, y: Floats, who: Identity) -> Floats:
    """Height of the nose above the face, mm."""
    top, wide = who.nose_height, np.abs(x)
    ridge = PchipInterpolator(
        [-60, -38, -35.5, -32.5, -29.5, -26, -19, -8, 4, 13, 24, 60],
        [0, 0, 0.16 * top, 0.6 * top, 0.93 * top, top, 0.87 * top, who.nose_bridge,
         0.5 * who.nose_bridge, 2.0, 0, 0],
    )  # fmt: skip
    breadth = PchipInterpolator([-60, -27, -12, 4, 20, 60], [9.5, 9.5, 7.6, 7.0, 8.5, 8.5])
    level = np.clip(y, -59, 59)
    height = ridge(level) * np.exp(-((wide / breadth(level)) ** 2.3))
    height = height + 5.5 * bump(x / 15, (y + 16) / 14)
    wing = 9.5 * bump((wide - who.nose_width + 3.4) / 4.6, (y + 29.0) / 5.2)
    groove = 1.4 * bump((wide - who.nose_width - 2.2) / 2.0, (y + 29.0) / 6.0)
    crease = 1.2 * bump((wide - 9.0) / 2.0, (y + 24.5) / 4.0)
    total: Floats = height + wing - groove - crease
    return total


def _lips(x: Floats, y: Floats, who: Identity) -> Floats:
    """Height of the lips above the face, mm."""
    half = who.mouth_half_width
    level = y - stomion_level(who)
    upper, lower = lip_heights(x, who)
    share = np.where(level > 0, level / upper, -level / lower)
    across = np.clip(1.0 - (x / (half + 2.0)) ** 2, 0.0, 1.0) ** 0.7
    swell = np.where(level > 0, 0.40 * upper, 0.40 * lower) * across
    full = np.sqrt(np.clip(1.0 - ((share - 0.45) / 1.15) ** 2, 0.0, 1.0)) * smooth_step(
        1.6, 0.9, share
    )
    push = 2.6 * bump(x / 30, (level - 2) / 17)
    push = push + swell * full
    push += 0.6 * bump(x / 4, (level - 3.4) / 3.0)
    push -= 1.2 * bump(level / 1.5) * smooth_step(half + 4.0, half - 2.0, np.abs(x))
    push -= 2.2 * bump((np.abs(x) - half - 1.5) / 4.5, level / 5.0)
    push -= 0.9 * bump(x / 2.6, (level - 15) / 6.0)
    push += 0.5 * bump((np.abs(x) - 5.2) / 2.2, (level - 14) / 6.0)
    return push


def stomion_level(who: Identity) -> float:
    """The height of the closed mouth, mm."""
    return EYE_LEVEL + who.face_length * (_STOMION - EYE_LEVEL)


def lip_heights(x: Floats, who: Identity) -> tuple[Floats, Floats]:
    """Heights of the red of the upper and lower lip at x, mm; a bow above, an arc below."""
    place = np.clip(np.abs(x) / who.mouth_half_width, 0.0, 1.0)
    taper = np.sqrt(np.clip(1.0 - place * place, 0.02, 1.0))
    upper = (
        who.lip_fullness * taper * (6.4 + 2.2 * bump((np.abs(x) - 6.0) / 5.5) - 0.8 * bump(x / 3.0))
    )
    lower = who.lip_fullness * taper**1.15 * 8.8
    return upper + 0.3, lower + 0.3


def _ears(points: Floats) -> Floats:
    """A hint of ears: a flange that leans back, hollow in the middle."""
    x, y, z = points.T
    along, across = (y + 8.0) / 31.0, (z + 18.0 - 0.12 * (y + 8.0)) / 17.0
    reach = np.hypot(along, across)
    mask = smooth_step(1.22, 0.88, reach)
    rear = smooth_step(0.75, -0.5, across)
    lobe = smooth_step(-1.0, -0.3, along) * 0.4 + 0.6
    rim = 10.0 * smooth_step(0.3, 0.85, reach) * lobe + 2.5 * bump((reach - 0.92) / 0.14)
    fold = 3.0 * bump((reach - 0.55) / 0.12) * smooth_step(-0.6, 0.2, along)
    shell = 4.0 * bump(along / 0.32, (across + 0.12) / 0.36)
    height = mask * (2.0 + rear * (rim + fold) - shell)
    out = points.copy()
    out[:, 0] += np.sign(x) * height * smooth_step(30.0, 55.0, np.abs(x))
    out[:, 2] -= 0.5 * height * rear * smooth_step(30.0, 55.0, np.abs(x))
    return out


def _eye(points: Floats, lattice: Lattice, slit: Slit, who: Identity) -> tuple[Floats, Floats]:
    """Open one eye to an almond over its ball, and roll its lids inwards."""
    out = points.copy()
    first, second = out[slit.corners]
    side = np.sign(first[0] + second[0])
    half = _EYE_HALF
    centre_x = side * (31.3 * who.head_width + who.eye_spacing)
    offset = (lattice.row - EYE_ROW).astype(float)
    near = (out[:, 2] > 0) & (np.sign(out[:, 0]) == side)
    slope = 2.0 * half / abs(second[0] - first[0])
    wanted = centre_x + (out[:, 0] - 0.5 * (first[0] + second[0])) * slope
    span = 0.5 * (slit.columns[-1] - slit.columns[0])
    rough = np.abs(lattice.column - slit.columns.mean()) / span
    warp = smooth_step(2.1, 1.1, rough) * bump(offset / 9.0)
    out[:, 0] += np.where(near, (wanted - out[:, 0]) * warp, 0.0)
    place = (out[:, 0] - centre_x) / half
    lower = (offset > 0) | ((offset == 0) & (lattice.side < 0))
    almond = np.clip(1.0 - np.abs(place) ** 2.1, 0.0, None) ** 0.75
    skew = 1.0 - 0.18 * place * side  # the highest point lies nearer the nose
    rise = np.where(lower, -0.36, 0.64 * skew) * who.eye_opening * almond
    rise = rise * np.exp(-((np.abs(offset) / 4.5) ** 1.5))
    tilt = who.eye_tilt * np.clip(place * side, -1.0, 1.6) * bump(place / 1.6, offset / 7.0)
    out[:, 1] += np.where(near, rise + tilt, 0.0)
    ball = np.array([centre_x, EYE_LEVEL + 1.9, 64.8])
    x, y, z = out.T
    apart = np.hypot(x - ball[0], (y - ball[1]))
    cap = np.sqrt(np.maximum(LID_RADIUS**2 - apart**2, 0.0))
    rim = np.where(place * side < 0, 7.0, 4.5) - 0.25 * np.maximum(apart - 12.0, 0.0)
    cap = ball[2] + 0.5 * (cap + rim + np.sqrt((cap - rim) ** 2 + 1.2))
    share = np.exp(-((place / 1.22) ** 4) - ((y - ball[1] + 0.5) / np.where(lower, 9.5, 9.0)) ** 4)
    out[:, 2] = np.where(near, z + share * (cap - z), z)
    crease = bump((out[:, 1] - _crease_level(place, who)) / 1.2) * bump(place / 1.05)
    out[:, 2] -= np.where(near & ~lower, 1.2 * crease, 0.0)
    return _roll_lids(out, slit, ball), ball


def _crease_level(place: Floats, who: Identity) -> Floats:
    level: Floats = EYE_LEVEL + 0.64 * who.eye_opening * (1.0 - 0.75 * place * place) + 4.6
    return level


def _roll_lids(points: Floats, slit: Slit, ball: Floats) -> Floats:
    """Rings inwards from the edge of the lids: their thickness, then along the ball, unseen."""
    out = points.copy()
    edge = out[slit.rings[0]] - ball
    middle = edge.mean(axis=0)
    radius = np.linalg.norm(edge, axis=1, keepdims=True)
    level = np.maximum(radius, LID_RADIUS)  # no lid edge may cut into the ball
    edge = edge * (level / radius)
    out[slit.rings[0]] = ball + edge
    away = edge - middle
    for ring, reach, depth in (
        (1, 0.0, BALL_RADIUS + 0.3),
        (2, 0.25, BALL_RADIUS + 0.2),
        (3, 0.6, BALL_RADIUS - 0.8),
    ):
        direction = edge + reach * away
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        out[slit.rings[ring]] = ball + depth * direction
    return out


def _mouth(points: Floats, lattice: Lattice, who: Identity) -> Floats:
    """Set the corners of the mouth, and roll the lips into a bag."""
    out = points.copy()
    slit = lattice.mouth
    out[:, 1] = _dense_lips(out, who)
    reach = 0.5 * (out[slit.corners[1], 0] - out[slit.corners[0], 0])
    x, y, z = out.T
    level = out[slit.corners].mean(axis=0)[1]
    around = bump((np.abs(x) - reach) / 16, (y - level) / 14) * smooth_step(30.0, 50.0, z)
    out[:, 0] += np.sign(x) * (who.mouth_half_width - reach) * around
    edge = out[slit.rings[0]]
    count = len(slit.upper)
    sign = np.concatenate([[0.0], np.ones(count), [0.0], -np.ones(count)])
    depths = (1.6, 4.0, 8.0, 14.0, 24.0, 38.0, 50.0)
    opens = (0.0, 0.0, 1.2, 7.0, 12.0, 13.0, 12.0)
    narrow = (1.0, 0.99, 0.98, 0.98, 0.94, 0.84, 0.7)
    for ring, (depth, opened, scale) in enumerate(zip(depths, opens, narrow, strict=True), start=1):
        across = np.sqrt(np.clip(1.0 - (edge[:, 0] / (who.mouth_half_width + 1.0)) ** 2, 0.0, 1.0))
        moved = edge * [scale, 1.0, 1.0]
        moved[:, 1] += sign * opened * across
        moved[:, 2] = (
            np.maximum(edge[:, 2] - depth, 34.0 - ring) if ring > 4 else edge[:, 2] - depth
        )
        out[slit.rings[ring]] = moved
    return out


def _dense_lips(points: Floats, who: Identity) -> Floats:
    """Heights (V,) with the rows drawn together about the line of the mouth, mm."""
    x, y, z = points.T
    level = y - stomion_level(who)
    pull = (
        0.45 * bump(level / 3.2) * smooth_step(42.0, 26.0, np.abs(x)) * smooth_step(30.0, 50.0, z)
    )
    dense: Floats = y - level * pull
    return dense


def mirror_ids(lattice: Lattice) -> Ints:
    """(V,) the id of each vertex's mirror image across the sagittal plane."""
    keys = np.stack([lattice.row, lattice.column, lattice.side, lattice.ring], axis=1)
    known = {tuple(key): index for index, key in enumerate(keys.tolist())}
    half = COLUMNS // 2
    mirrored = []
    for row, column, side, ring in keys.tolist():
        other = half if column == half else -column
        found = known.get((row, other, side, ring))
        mirrored.append(known[(row, column, side, ring)] if found is None else found)
    return np.array(mirrored, np.int64)
