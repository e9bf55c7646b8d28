"""Cameras in Agisoft Metashape's XML: what File > Export > Export Cameras writes.

A point (X, Y, Z) of camera space, OpenCV's axes, is seen at

::

    x = X / Z, y = Y / Z, r2 = x^2 + y^2
    x' = x (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) + p1 (r2 + 2 x^2) + 2 p2 x y
    y' = y (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) + p2 (r2 + 2 y^2) + 2 p1 x y
    u = 0.5 w + cx + x' f + x' b1 + y' b2,   v = 0.5 h + cy + y' f

so that p1 and p2 are OpenCV's p2 and p1, cx and cy are offsets from the image's centre, and fx is
f + b1. u and v count from the image's corner: the centre of the first pixel is at 0.5, half a pixel
beyond ours; Agisoft's own scripts address pixel centres as i + 0.5 and copy 0.5 w + cx into COLMAP,
which has that convention. k4, b2 (skew), p3 and p4 have no place in our camera.

`<transform>` of a camera is chunk_from_camera; the component's (in old files the chunk's) rotation,
translation and scale give the world. Lengths are in the unit of the coordinate system: metres.

References:
    Agisoft Metashape User Manual, Appendix "Camera models", frame cameras; agisoft-llc/
    metashape-scripts, src/export_for_gaussian_splatting.py.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from capture.errors import CameraError
from capture.product import replacing
from recon.camera_parts import Lens, check_unit, gather, number, read_bytes, rigid, whole
from recon.exchange.xml_tree import parse_xml

_LIMIT = 1 << 25
_HALF_PIXEL = 0.5
_TERMS = {"k1": "k1", "k2": "k2", "k3": "k3", "p1": "p2", "p2": "p1"}  # Metashape's: ours
_OVER = ("k4", "k5", "p3", "p4", "b2")
_KNOWN = {"resolution", "f", "cx", "cy", "b1", *_TERMS, *_OVER}
_METRES = (
    'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],'
    'UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'
)
_FALSE = ("0", "false", "no")


def read_metashape(path: Path, unit_mm: float = 1000.0) -> CameraArray:
    """Read the enabled cameras of an XML export of one chunk.

    Args:
        path: the .xml file.
        unit_mm: millimetres of the chunk's unit.

    Raises:
        CameraError: naming the file and every camera that does not fit.
    """
    check_unit(unit_mm)
    where = str(path)
    root = parse_xml(read_bytes(path, _LIMIT), where)
    if root.tag != "document":
        raise CameraError(f"{where}: expected Metashape's <document>, found <{root.tag[:60]}>")
    chunks = root.findall("chunk")
    if len(chunks) != 1:
        raise CameraError(f"{where}: expected one <chunk>, found {len(chunks)}; export one")
    chunk = chunks[0]
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors//sensor")}
    found = [
        camera
        for camera in chunk.iterfind("cameras//camera")
        if camera.get("enabled", "1").lower() not in _FALSE
    ]
    components = {
        camera.get("component_id") for camera in found if camera.find("transform") is not None
    }
    if len(components) > 1:
        raise CameraError(
            f"{where}: the cameras are in {len(components)} components, which do not stand in one "
            "space; align them together, or export one"
        )
    placed = _world_from_chunk(chunk, components.pop() if components else None, where)
    return gather(
        where,
        [
            (camera.get("label", ""), partial(_read_camera, camera, sensors, placed, unit_mm))
            for camera in found
        ],
    )


def write_metashape(path: Path, cameras: CameraArray, unit_mm: float = 1000.0) -> None:
    """Write the array as one chunk: a sensor and a camera each, in the world's space.

    Args:
        path: the .xml file, replaced whole or not at all.
        cameras: the array.
        unit_mm: millimetres of the chunk's unit; only metres are named as the coordinate system.
    """
    check_unit(unit_mm)
    document = Element("document", version="2.0.0")
    chunk = SubElement(document, "chunk", label="Chunk 1", enabled="true")
    sensors = SubElement(chunk, "sensors", next_id=str(len(cameras)))
    components = SubElement(chunk, "components", next_id="1", active_id="0")
    component = SubElement(components, "component", id="0", label="Component 1")
    placed = SubElement(component, "transform")
    SubElement(placed, "rotation").text = _text(np.eye(3))
    SubElement(placed, "translation").text = _text(np.zeros(3))
    SubElement(placed, "scale").text = "1"
    listed = SubElement(chunk, "cameras", next_id=str(len(cameras)), next_group_id="0")
    for at, camera in enumerate(cameras):
        _write_sensor(sensors, at, camera)
        entry = SubElement(
            listed, "camera", id=str(at), sensor_id=str(at), component_id="0",
            label=camera.name, enabled="true",
        )  # fmt: skip
        pose = camera.camera_from_world.inverse().matrix()
        pose[:3, 3] /= unit_mm
        SubElement(entry, "transform").text = _text(pose)
        SubElement(entry, "orientation").text = "1"
    if unit_mm == 1000.0:
        SubElement(chunk, "reference").text = _METRES
    indent(document)
    text = tostring(document, encoding="unicode")
    with replacing(Path(path)) as partial_path:
        partial_path.write_text(
            f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n', encoding="utf-8"
        )


def _write_sensor(sensors: Element, at: int, camera: Camera) -> None:
    size = {"width": str(camera.width), "height": str(camera.height)}
    sensor = SubElement(sensors, "sensor", id=str(at), label=camera.name, type="frame")
    SubElement(sensor, "resolution", size)
    lens = SubElement(sensor, "calibration", {"type": "frame", "class": "adjusted"})
    SubElement(lens, "resolution", size)
    k1, k2, p1, p2, k3 = camera.distortion.tolist()
    values = {
        "f": camera.fy,
        "cx": camera.cx + _HALF_PIXEL - 0.5 * camera.width,
        "cy": camera.cy + _HALF_PIXEL - 0.5 * camera.height,
        "b1": camera.fx - camera.fy,
        "k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1,
    }  # fmt: skip
    for name, value in values.items():
        if value != 0 or name == "f":
            SubElement(lens, name).text = repr(float(value))


def _read_camera(
    camera: Element,
    sensors: dict[str | None, Element],
    placed: tuple[Floats, Floats, float],
    unit_mm: float,
) -> Camera:
    name = camera.get("label", "")
    sensor = sensors.get(camera.get("sensor_id"))
    if sensor is None:
        raise CameraError(f"no <sensor> has the id {camera.get('sensor_id')!r} that it names")
    if camera.get("master_id") is not None or sensor.get("master_id") is not None:
        raise CameraError(
            "is a slave of a multi-camera system; ungroup the sensors in Metashape and export again"
        )
    if camera.find("rolling_shutter") is not None:
        raise CameraError("has a rolling-shutter motion; a camera of ours stands still")
    transform = camera.find("transform")
    if transform is None:
        raise CameraError("is not aligned; align it, disable it, or remove it from the chunk")
    rotation, translation, scale = placed
    chunk_from_camera = _array(transform, (4, 4), "transform")
    pose = np.eye(4)
    with np.errstate(over="ignore", invalid="ignore"):  # told apart by `rigid`
        pose[:3, :3] = rotation @ chunk_from_camera[:3, :3]
        pose[:3, 3] = scale * rotation @ chunk_from_camera[:3, 3] + translation
    pose[3] = chunk_from_camera[3]
    return _read_lens(sensor).camera(name, rigid(pose, unit_mm, "transform").inverse())


def _read_lens(sensor: Element) -> Lens:
    found = {lens.get("class"): lens for lens in sensor.findall("calibration")}
    lens = found.get("adjusted", found.get("initial", found.get(None)))
    if lens is None:
        raise CameraError("its sensor has no <calibration>; align the chunk first")
    kind = lens.get("type", "frame")
    if kind != "frame" or sensor.get("type", "frame") != "frame":
        raise CameraError(f"a lens of type {kind}; only frame is Brown-Conrady")
    strange = sorted({part.tag for part in lens} - _KNOWN)
    if strange:
        raise CameraError(
            f"calibration with {', '.join(strange[:8])}, as PhotoScan before 1.2 wrote or unknown; "
            "open it in Metashape and export again"
        )
    if lens.find("f") is None:
        raise CameraError("calibration without f")
    values = {
        part.tag: number((part.text or "").strip(), part.tag)
        for part in lens
        if part.tag != "resolution"
    }
    size = lens.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise CameraError("its sensor has no <resolution>")
    width = whole(size.get("width"), "width")
    height = whole(size.get("height"), "height")
    focal = values["f"]
    centre = (
        0.5 * width + values.get("cx", 0.0) - _HALF_PIXEL,
        0.5 * height + values.get("cy", 0.0) - _HALF_PIXEL,
    )
    terms = {ours: values.get(theirs, 0.0) for theirs, ours in _TERMS.items()}
    over = {term: values.get(term, 0.0) for term in _OVER}
    return Lens(
        width=width, height=height, focal_px=(focal + values.get("b1", 0.0), focal),
        centre_px=centre, distortion=terms | over,
    )  # fmt: skip


def _world_from_chunk(
    chunk: Element, component: str | None, where: str
) -> tuple[Floats, Floats, float]:
    """Rotation (3, 3), translation (3,) and scale that take the chunk's space to the world."""
    parts = chunk.findall("components/component")
    lone = component is None and len(parts) == 1
    places = [part.find("transform") for part in parts if lone or part.get("id") == component]
    places.append(chunk.find("transform"))
    placed = next((place for place in places if place is not None), None)
    if placed is None:
        return np.eye(3), np.zeros(3), 1.0
    try:
        rotation = _child(placed, "rotation", np.eye(3))
        translation = _child(placed, "translation", np.zeros(3))
        scale = float(_child(placed, "scale", np.ones(1))[0])
        rigid(np.column_stack([rotation, translation]), 1.0, "rotation")
        if scale <= 0:
            raise CameraError(f"scale must be above 0, found {scale}")
    except CameraError as error:
        raise CameraError(f"{where}: <transform> of the chunk: {error}") from error
    return rotation, translation, scale


def _child(parent: Element, name: str, absent: Floats) -> Floats:
    child = parent.find(name)
    return absent if child is None else _array(child, absent.shape, name)


def _array(element: Element, shape: tuple[int, ...], what: str) -> Floats:
    words = (element.text or "").split()
    count = int(np.prod(shape))
    if len(words) != count:
        raise CameraError(f"{what} must hold {count} numbers, found {len(words)}")
    return np.array([number(word, what) for word in words]).reshape(shape)


def _text(values: Floats) -> str:
    return " ".join(repr(float(value)) for value in values.ravel())
