"""What each device saw on calibration day, kept to be compared with what it sees today.

One `.npz`: a small mono picture a device, how sharp and how bright it was, which lens it had.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture.archive import read_archive, write_archive
from capture.arrays import Floats, Image
from capture.calibration_link.sharpness import face_region, full_scale, sharpness
from capture.calibration_link.static_scene import (
    Motion,
    binning,
    measure_motion,
    small_picture,
)
from capture.errors import InputError, ShapeError, raise_all
from capture.judgement import Colour
from capture.take import Take

MOVED_PX = 0.25  # a third of a millimetre at 0.15 mm/px would be 2 px: this is well before harm
RED_PX = 1.0
_SIGMAS = 5.0
_FRAMES = 4
_LARGEST_BYTES = 1 << 26
_KEYS = (
    "device_names", "lens_names", "sharpness", "brightness", "factor", "width_px", "height_px",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class DeviceReference:
    """One device on calibration day.

    Attributes:
        device: its name.
        picture: (H, W) small mono picture, 0 to 1.
        factor: full-size pixels in one of the picture's, along a side.
        size_px: (width, height) of its frames.
        sharpness: of the face region; NaN when it showed nothing.
        brightness: mean of the face region, 0 to 1.
        lens: serial number of its lens; empty when it was not told.
    """

    device: str
    picture: Floats
    factor: int
    size_px: tuple[int, int]
    sharpness: float
    brightness: float
    lens: str = ""


@dataclass(frozen=True)
class SceneFinding:
    """What the static scene says of one device.

    Attributes:
        device: its name.
        colour: green, amber or red.
        sentence: for the operator.
        remedy: what to do; empty when green.
        motion: as measured; None when it could not be compared.
    """

    device: str
    colour: Colour
    sentence: str
    remedy: str
    motion: Motion | None


def make_reference(
    images: Mapping[str, Sequence[Image]], out: Path, *, lenses: Mapping[str, str] | None = None
) -> dict[str, DeviceReference]:
    """Keep what the devices see now as the reference of calibration day.

    Args:
        images: by device name, one or more images in a row; with several, noise averages out.
        out: the `.npz` to write.
        lenses: by device name, the serial number of its lens.

    Raises:
        ShapeError: naming a device without an image, or with images of several sizes.
    """
    problems = [f"{name}: no image" for name, seen in images.items() if not seen]
    raise_all("reference", problems, ShapeError)
    made = {
        name: _of(name, list(seen), (lenses or {}).get(name, "")) for name, seen in images.items()
    }
    values = list(made.values())
    arrays = {
        "device_names": np.array([one.device for one in values]),
        "lens_names": np.array([one.lens for one in values]),
        "sharpness": np.array([one.sharpness for one in values]),
        "brightness": np.array([one.brightness for one in values]),
        "factor": np.array([one.factor for one in values]),
        "width_px": np.array([one.size_px[0] for one in values]),
        "height_px": np.array([one.size_px[1] for one in values]),
    }
    for place, one in enumerate(values):
        arrays[f"picture_{place}"] = np.round(one.picture * 65535).astype(np.uint16)
    write_archive(out, arrays)
    return made


def reference_of_take(
    take: Take, out: Path, *, lenses: Mapping[str, str] | None = None
) -> dict[str, DeviceReference]:
    """Keep what the devices saw in the first frames of a take as the reference of calibration day.

    Args:
        take: of somebody, or a head, sitting still; recorded on the day of the calibration.
        out: the `.npz` to write.
        lenses: by device name, the serial number of its lens.

    Raises:
        ShapeError: naming a device without a frame.
    """
    images: dict[str, list[Image]] = {}
    for device in take.device_names:
        present = [frame for frame in take.frames if take.present(device, frame)]
        images[device] = [take.image(device, frame) for frame in present[:_FRAMES]]
    return make_reference(images, out, lenses=lenses)


def read_reference(path: Path) -> dict[str, DeviceReference]:
    """Read what `make_reference` wrote, by device name.

    Raises:
        InputError: naming the file and what is missing or damaged.
    """
    table = read_archive(path, _KEYS, gaps=("sharpness",), largest_bytes=_LARGEST_BYTES)
    count = len(table["device_names"])
    if any(table[key].shape != (count,) for key in _KEYS) or not count:
        raise ShapeError(f"{path}: expected one value a device in each list")
    names = [f"picture_{place}" for place in range(count)]
    pictures = read_archive(path, names, largest_bytes=_LARGEST_BYTES)
    made = {}
    for place, name in enumerate(table["device_names"].tolist()):
        picture = pictures[f"picture_{place}"]
        if picture.ndim != 2:
            raise ShapeError(
                f"{path}: picture_{place}: expected shape (H W), found {picture.shape}"
            )
        made[name] = DeviceReference(
            device=name,
            picture=picture / 65535.0,
            factor=int(table["factor"][place]),
            size_px=(int(table["width_px"][place]), int(table["height_px"][place])),
            sharpness=float(table["sharpness"][place]),
            brightness=float(table["brightness"][place]),
            lens=str(table["lens_names"][place]),
        )
    return made


def check_static_scene(
    reference: Mapping[str, DeviceReference], images: Mapping[str, Image]
) -> tuple[SceneFinding, ...]:
    """Compare what each device sees now with calibration day; one finding a device of either.

    A device counts as moved when the static scene is displaced by more than 0.25 px and by more
    than five standard deviations of the measurement.

    Args:
        reference: of calibration day.
        images: by device name, a fresh image.
    """
    names = list(dict.fromkeys([*reference, *images]))
    return tuple(_judged(name, reference.get(name), images.get(name)) for name in names)


def _of(name: str, images: list[Image], lens: str) -> DeviceReference:
    try:
        sharp = sharpness(images)
    except InputError as error:
        raise ShapeError(f"{name}: {error}") from error
    first = images[0]
    scale = full_scale(first)
    return DeviceReference(
        device=name,
        picture=np.mean([small_picture(image) for image in images], axis=0),
        factor=binning(first),
        size_px=(int(first.shape[1]), int(first.shape[0])),
        sharpness=sharp,
        brightness=float(np.mean([face_region(image).mean() for image in images])) / scale,
        lens=lens,
    )


def _judged(name: str, then: DeviceReference | None, now: Image | None) -> SceneFinding:
    if then is None or now is None:
        what = "has no picture of calibration day" if then is None else "gave no image"
        remedy = (
            "Make the reference again after the next calibration."
            if then is None
            else f"See why {name} sends nothing, then run this check again."
        )
        return SceneFinding(name, Colour.AMBER, f"{name} {what}: not compared.", remedy, None)
    size = (int(now.shape[1]), int(now.shape[0]))
    if size != then.size_px:
        return SceneFinding(
            name, Colour.RED,
            f"{name} sends {size[0]} x {size[1]} px; it was calibrated with "
            f"{then.size_px[0]} x {then.size_px[1]} px.",
            "Apply the preset of calibration day, or calibrate again.", None,
        )  # fmt: skip
    motion = measure_motion(then.picture, small_picture(now), factor=then.factor)
    if not motion.known:
        return SceneFinding(
            name, Colour.AMBER,
            f"{name}: too little of its surroundings is the same as on calibration day "
            f"({motion.tiles} of {motion.tried} parts): whether it moved is not known.",
            "Light the room as on calibration day and clear what was put in view; else check with "
            "the board: likeness drift.", motion,
        )  # fmt: skip
    limit = max(MOVED_PX, _SIGMAS * motion.sigma_px)
    # A turn or a zoom may leave the middle where it is: the edge of the image tells.
    half = 0.5 * float(np.hypot(*then.size_px))
    edge = half * float(np.hypot(motion.turn_mdeg * np.pi / 180_000.0, motion.growth_ppm * 1e-6))
    if max(motion.size_px, 0.5 * edge) <= limit:
        words = f"{name} stands still: {motion.size_px:.2f} px from calibration day."
        return SceneFinding(name, Colour.GREEN, words, "", motion)
    worst = max(motion.size_px, edge)
    return SceneFinding(
        name, Colour.RED if worst > RED_PX else Colour.AMBER, _moved(name, motion, edge),
        "Do not touch it again. Check the array with the board: likeness drift; "
        "calibrate anew if it says so. If only the picture changed, make the reference again.",
        motion,
    )  # fmt: skip


def _moved(name: str, motion: Motion, edge_px: float) -> str:
    x, y = motion.shift_px
    side = f"{abs(x):.1f} {'right' if x > 0 else 'left'}, {abs(y):.1f} {'down' if y > 0 else 'up'}"
    words = f"{name} moved by {motion.size_px:.1f} px: its surroundings lie {side}"
    if edge_px > motion.size_px:
        words += (
            f"; turned by {motion.turn_mdeg / 1000:.2f} degrees, "
            f"enlarged by {motion.growth_ppm / 10_000:+.2f} %"
        )
    return f"{words} ({motion.tiles} of {motion.tried} parts agree, +-{motion.sigma_px:.2f} px)."
