"""Metashape's XML: its documented projection, computed here by itself, against our cameras."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.arrays import Floats
from capture.camera import CameraArray
from capture.errors import CameraError
from recon.exchange.metashape import read_metashape, write_metashape
from tests.capture.refusals import refusal
from tests.recon.exchange.camera_cases import CLOUD, METASHAPE, random_array

LEFT = {
    "w": 1000, "h": 800, "f": 1500.5, "cx": 7.25, "cy": -3.5, "b1": 2.5, "b2": 0.0,
    "k1": -0.08, "k2": 0.03, "k3": -0.004, "k4": 0.0, "p1": 0.0007, "p2": -0.0011,
}  # fmt: skip
RIGHT = dict.fromkeys(LEFT, 0.0) | {"w": 600, "h": 900, "f": 1200.0, "k1": 0.05}


def seen_by_metashape(lens: dict[str, float], local: Floats) -> Floats:
    """Pixels (N, 2), first pixel's centre at 0.5, by the formula of the manual's appendix."""
    pixels = []
    for big_x, big_y, big_z in local:
        x, y = big_x / big_z, big_y / big_z
        r = np.sqrt(x * x + y * y)
        radial = 1 + lens["k1"] * r**2 + lens["k2"] * r**4 + lens["k3"] * r**6 + lens["k4"] * r**8
        x_bent = x * radial + (lens["p1"] * (r**2 + 2 * x**2) + 2 * lens["p2"] * x * y)
        y_bent = y * radial + (lens["p2"] * (r**2 + 2 * y**2) + 2 * lens["p1"] * x * y)
        u = lens["w"] * 0.5 + lens["cx"] + x_bent * lens["f"] + x_bent * lens["b1"]
        u += y_bent * lens["b2"]
        v = lens["h"] * 0.5 + lens["cy"] + y_bent * lens["f"]
        pixels.append((u, v))
    return np.array(pixels)


def written(tmp_path: Path, text: str = METASHAPE) -> Path:
    (tmp_path / "cameras.xml").write_text(text)
    return tmp_path / "cameras.xml"


def test_a_literal_export_is_read_by_its_documented_projection(tmp_path: Path) -> None:
    array = read_metashape(written(tmp_path))
    assert array.names == ("left", "right.JPG")
    assert (array[0].fx, array[0].fy, array[0].cx, array[0].cy) == (1503.0, 1500.5, 506.75, 396.0)
    np.testing.assert_array_equal(array[0].distortion, [-0.08, 0.03, -0.0011, 0.0007, -0.004])
    chunk_from_camera = [
        np.array([[1, 0, 0, 0.25], [0, -1, 0, 0.5], [0, 0, -1, 3], [0, 0, 0, 1.0]]),
        np.array([[0.8, 0, -0.6, 1.5], [0, -1, 0, 0.1], [-0.6, 0, -0.8, 2.5], [0, 0, 0, 1]]),
    ]
    turn, move, scale = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), [0.2, 0.1, -0.3], 0.5
    rng = np.random.default_rng(3)
    for camera, place, lens in zip(array, chunk_from_camera, (LEFT, RIGHT), strict=True):
        local = np.column_stack([rng.uniform(-0.6, 0.6, (40, 2)), rng.uniform(2, 4, 40)])
        in_chunk = local @ place[:3, :3].T + place[:3, 3]
        world_mm = 1000.0 * (scale * in_chunk @ turn.T + move)
        np.testing.assert_allclose(
            camera.project(world_mm) + 0.5, seen_by_metashape(lens, local), rtol=0, atol=1e-8
        )


def test_what_is_written_projects_by_the_documented_formula(tmp_path: Path) -> None:
    array = random_array(21)
    write_metashape(tmp_path / "a.xml", array)
    root = ElementTree.parse(tmp_path / "a.xml").getroot()
    lenses = root.findall("chunk/sensors/sensor/calibration")
    entries = root.findall("chunk/cameras/camera")
    assert [entry.get("label") for entry in entries] == list(array.names)
    for camera, lens, entry in zip(array, lenses, entries, strict=True):
        values = dict.fromkeys(LEFT, 0.0) | {
            "w": float(lens.find("resolution").get("width")),  # type: ignore[union-attr,arg-type]
            "h": float(lens.find("resolution").get("height")),  # type: ignore[union-attr,arg-type]
        }
        values |= {part.tag: float(part.text or "nan") for part in lens if part.tag in LEFT}
        place = np.array((entry.findtext("transform") or "").split(), dtype=float).reshape(4, 4)
        local = (CLOUD / 1000.0 - place[:3, 3]) @ place[:3, :3]
        np.testing.assert_allclose(
            seen_by_metashape(values, local), camera.project(CLOUD) + 0.5, rtol=0, atol=1e-6
        )


def test_an_old_file_has_its_place_in_the_chunk(tmp_path: Path) -> None:
    new = read_metashape(written(tmp_path))
    start, end = METASHAPE.index("    <components"), METASHAPE.index("    <cameras")
    transform = METASHAPE[METASHAPE.index("        <transform>") : METASHAPE.index("      </comp")]
    old = METASHAPE[:start] + transform + METASHAPE[end:]
    old = old.replace(' component_id="0"', "")
    again = read_metashape(written(tmp_path, old))
    np.testing.assert_array_equal(again.project(CLOUD), new.project(CLOUD))
    lone = METASHAPE.replace(' component_id="0"', "")
    np.testing.assert_array_equal(
        read_metashape(written(tmp_path, lone)).project(CLOUD), new.project(CLOUD)
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<k3>-0.004</k3>", "<k3>0</k3><k4>0.02</k4>", "left: the lens has k4 = 0.02; likeness"),
        ("<b1>2.5</b1>", "<b2>1.5</b2>", "left: the lens has b2 = 1.5"),
        ("<b1>2.5</b1>", "<p3>1</p3><p4>2</p4>", "left: the lens has p3 = 1, p4 = 2"),
        ("<f>1500.5</f>", "<fx>1</fx><fy>1</fy>", "left: calibration with fx, fy, as PhotoScan"),
        ("<f>1500.5</f>", "", "left: calibration without f"),
        ("<f>1500.5</f>", "<f>nan</f>", "left: f must be finite"),
        ("<f>1500.5</f>", "<f>long</f>", "left: f must be a number, found 'long'"),
        ('type="frame" class="adj', 'type="fisheye" class="adj', "left: a lens of type fisheye"),
        ('label="wide" type="frame"', 'label="wide" type="spherical"', "left: a lens of type"),
        (
            "<transform>1 0 0 0.25",
            "<transform>2 0 0 0.25",
            "left: transform: rotation: expected orthonormal",
        ),
        ("<transform>1 0 0 0.25", "<transform>1e200 0 0 0.25", "left: transform: expected a rot"),
        ("<transform>1 0 0 0.25", "<transform>1 0 0 1e200", "left: transform: a place beyond"),
        ("0.5</scale>", "1e308</scale>", "left: transform: a place beyond 1e12 mm"),
        ("<transform>1 0 0 0.25", "<transform>1 0 0", "left: transform must hold 16 numbers"),
        ('label="left"', 'label="/data/left.JPG"', "'/data/left.JPG': a camera's name must be"),
        ('label="left"', 'label="right.JPG"', "unique, found twice: right.JPG"),
        ('sensor_id="0"', 'sensor_id="5"', "left: no <sensor> has the id '5'"),
        ('id="0" label="wide"', 'id="0" master_id="7" label="wide"', "left: is a slave of a multi"),
        ("<orientation>1</o", "<rolling_shutter/><orientation>1</o", "left: has a rolling-shutter"),
        ('component_id="0" label="left"', 'component_id="1" label="left"', "in 2 components"),
        ("0.5</scale>", "-1</scale>", "<transform> of the chunk: scale must be above 0"),
        ("0 -1 0 1 0 0 0 0 1</rot", "0 -1 0 1 0 0 0 0 2</rot", "of the chunk: rotation"),
        ('"spare" enabled="false"', '"spare"', "spare: is not aligned; align it, disable it"),
        ("</chunk>", "</chunk><chunk/>", "expected one <chunk>, found 2"),
        (
            'width="1000" height="800"/>\n          <f>',
            'width="0" height="8"/><f>',
            "width must be",
        ),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in METASHAPE
    with pytest.raises(CameraError) as caught:
        read_metashape(written(tmp_path, METASHAPE.replace(old, new, 1)))
    assert words in str(caught.value)


def test_all_cameras_that_do_not_fit_come_in_one_message(tmp_path: Path) -> None:
    text = METASHAPE.replace("<k1>", "<k4>1e-3</k4><k1>")
    with pytest.raises(CameraError, match=r"2 problems\n.*left: .*k4 = 0.001.*\n.*right.JPG: .*k4"):
        read_metashape(written(tmp_path, text))


def test_terms_of_zero_are_held_exactly(tmp_path: Path) -> None:
    zeros = "<k4>0</k4><b2>0.0</b2><p3>0</p3><p4>-0.0</p4><k1>"
    again = read_metashape(written(tmp_path, METASHAPE.replace("<k1>", zeros)))
    assert isinstance(again, CameraArray)
    np.testing.assert_array_equal(
        again.project(CLOUD), read_metashape(written(tmp_path)).project(CLOUD)
    )


@settings(max_examples=120, deadline=None)
@given(
    at=st.integers(0, len(METASHAPE) - 1),
    length=st.integers(0, 60),
    put=st.text(alphabet='<>/"= 019e.-nafi&;', max_size=12),
)
def test_damage_is_read_or_refused_but_never_crashes(
    tmp_path_factory: pytest.TempPathFactory, at: int, length: int, put: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.xml"
    path.write_text(METASHAPE[:at] + put + METASHAPE[at + length :])
    said = refusal(lambda: read_metashape(path))
    assert not said or said.startswith(str(path))
