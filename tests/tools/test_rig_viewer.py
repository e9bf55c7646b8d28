"""The 3D view: its GLB gives the rig back, its sliders are the shapes, its script does as numpy."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from capture.arrays import Floats
from tests.tools.test_rig_page import make_case
from tools.report import write_rig_page
from tools.report.rig_glb import compact_glb, quads_first, step_mm
from tools.report.rig_inputs import RigInputs, read_rig_inputs
from tools.report.rig_viewer import rig_viewer, slider_groups, slider_rows

_NUMBERS = {5120: "<i1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_LARGEST = {5120: 127.0, 5122: 32767.0, 5123: 65535.0, 5126: 1.0}
_BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
    "--virtual-time-budget=5000", "--window-size=1300,2200",
)  # fmt: skip


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> RigInputs:
    folder = tmp_path_factory.mktemp("view")
    template, performance = make_case(folder)
    return read_rig_inputs(folder, template=template, performances=[performance])


def opened(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the bytes of a GLB, checked as its specification says."""
    words = np.frombuffer(data[:20], "<u4").tolist()
    assert words[:2] == [0x46546C67, 2]
    assert words[2] == len(data)
    text = data[20 : 20 + words[3]]
    size, kind = np.frombuffer(data[20 + words[3] : 28 + words[3]], "<u4").tolist()
    assert kind == 0x004E4942
    body = data[28 + words[3] :]
    assert len(body) == size
    return json.loads(text), body


def values(document: dict[str, Any], body: bytes, index: int) -> Floats:
    """An accessor's rows as numbers, sparse or not."""
    accessor = document["accessors"][index]
    width = {"SCALAR": 1, "VEC3": 3}[accessor["type"]]

    def rows(view: int, kind: int, count: int, columns: int) -> np.ndarray:
        part = document["bufferViews"][view]
        dtype = np.dtype(_NUMBERS[kind])
        stride = part.get("byteStride", columns * dtype.itemsize)
        assert part["byteOffset"] % 4 == 0
        assert part["byteLength"] >= count * stride
        raw = np.frombuffer(body, np.uint8, count * stride, part["byteOffset"])
        used = raw.reshape(count, stride)[:, : columns * dtype.itemsize]
        return np.ascontiguousarray(used).view(dtype).reshape(count, columns)

    kind = accessor["componentType"]
    out = np.zeros((accessor["count"], width))
    if "bufferView" in accessor:
        out[:] = rows(accessor["bufferView"], kind, accessor["count"], width)
    if "sparse" in accessor:
        told = accessor["sparse"]
        places = rows(
            told["indices"]["bufferView"], told["indices"]["componentType"], told["count"], 1
        )[:, 0]
        assert (np.diff(places.astype(int)) > 0).all()
        out[places] = rows(told["values"]["bufferView"], kind, told["count"], width)
    if "min" in accessor:
        assert np.allclose(out.min(axis=0), accessor["min"])
        assert np.allclose(out.max(axis=0), accessor["max"])
    return out / _LARGEST[kind] if accessor.get("normalized") else out


@pytest.mark.parametrize("coarse", [False, True])
def test_glb_gives_the_rig_back(inputs: RigInputs, coarse: bool) -> None:
    rig = inputs.rig
    document, body = opened(compact_glb(rig, inputs.times_s, coarse=coarse))
    mesh = document["meshes"][0]
    primitive = mesh["primitives"][0]
    scale_mm = 1000.0 * np.array(document["nodes"][0]["scale"])
    neutral = values(document, body, primitive["attributes"]["POSITION"]) * scale_mm
    assert np.abs(neutral - rig.neutral).max() < 1e-4
    assert mesh["extras"]["targetNames"] == list(rig.names)
    step = step_mm(rig, coarse=coarse)
    assert step == pytest.approx(np.abs(rig.deltas).max() / (127 if coarse else 32767))
    for target, delta in zip(primitive["targets"], rig.deltas, strict=True):
        found = values(document, body, target["POSITION"]) * scale_mm
        assert np.abs(found - delta).max() <= 0.5001 * step
    sampler = document["animations"][0]["samplers"][0]
    weights = values(document, body, sampler["output"]).reshape(rig.weights.shape)
    assert np.abs(weights - rig.weights).max() < 1e-5
    assert sampler["interpolation"] == "LINEAR"


def test_other_readers_open_the_glb(inputs: RigInputs) -> None:
    lib = pytest.importorskip("pygltflib")
    loaded = lib.GLTF2.load_from_bytes(compact_glb(inputs.rig, inputs.times_s, held=True))
    assert loaded.extensionsRequired == ["KHR_mesh_quantization"]
    assert loaded.animations[0].samplers[0].interpolation == "STEP"
    assert len(loaded.meshes[0].primitives[0].targets) == len(inputs.rig.names)


def test_quads_keep_their_halves_together(inputs: RigInputs) -> None:
    polygons = np.array([[0, 1, 2, -1], [3, 4, 5, 6], [7, 8, 9, -1], [10, 11, 12, 13]], np.int32)
    assert quads_first(polygons)[:, 0].tolist() == [3, 10, 0, 7]
    document, body = opened(compact_glb(inputs.rig, inputs.times_s))
    mesh = document["meshes"][0]
    corners = values(document, body, mesh["primitives"][0]["indices"]).reshape(-1, 3)
    quads = mesh["extras"]["quads"]
    assert (corners[:quads, [0, 2]] == corners[-quads:, [0, 1]]).all(), "one diagonal"


def test_rig_without_frames_or_shapes(inputs: RigInputs) -> None:
    rig = inputs.rig
    still = replace(rig, weights=np.zeros((0, 6)), head_from_rig=np.zeros((0, 4, 4)))
    assert "animations" not in opened(compact_glb(still, np.zeros(0)))[0]
    bare = replace(still, names=(), deltas=rig.deltas[:0], weights=np.zeros((0, 0)))
    assert "targets" not in opened(compact_glb(bare, np.zeros(0)))[0]["meshes"][0]["primitives"][0]


def test_sliders_are_the_shapes_right_beside_left() -> None:
    names = ["mouthSmileLeft", "jawOpen", "mouthSmileRight", "eyeBlink_R", "eyeBlink_L", "x<y"]
    rows = slider_rows(names)
    assert [(row.region, row.shapes) for row in rows] == [
        ("eye", (3, 4)),
        ("jaw", (1,)),
        ("mouth", (2, 0)),
        ("other", (5,)),
    ]
    text = slider_groups(names)
    assert sorted(re.findall(r'data-shape="(\d)"', text)) == list("012345")
    assert 'title="x&lt;y"' in text


def test_view_carries_its_rig_and_the_change(inputs: RigInputs) -> None:
    text = rig_viewer(inputs)
    found = re.search(r'download="rig.glb" href="data:model/gltf-binary;base64,([^"]+)"', text)
    assert found is not None
    data = base64.b64decode(found.group(1))
    assert data == compact_glb(inputs.rig, inputs.times_s, held=not inputs.is_motion)
    change = re.search(r'data-change="on">([^<]+)<', text)
    assert change is not None
    document, body = opened(base64.b64decode(change.group(1)))
    target = document["meshes"][0]["primitives"][0]["targets"][0]["POSITION"]
    scale_mm = 1000.0 * document["nodes"][0]["scale"][0]
    restored = inputs.rig.deltas[0] + scale_mm * values(document, body, target)
    assert inputs.before is not None
    assert np.abs(restored - inputs.before.deltas[0]).max() < 0.1
    assert "change" not in re.findall(r'value="(\w+)"', rig_viewer(replace(inputs, before=None)))


def test_script_is_short_and_names_no_address() -> None:
    script = Path(__file__).parents[2] / "tools" / "report" / "rig_viewer.js"
    text = script.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 400
    assert not re.search(r"https?:|import |fetch\(|XMLHttp|eval|</script", text)


Driven = Callable[[str, str], tuple[dict[str, Any], Path]]


@pytest.fixture(scope="module")
def drive(inputs: RigInputs, tmp_path_factory: pytest.TempPathFactory) -> Driven:
    """Opens the page in a browser with a script after its own; gives what that tells."""
    if _BROWSER is None:
        pytest.skip("no chromium on this machine: the script of the 3D view is not run")
    folder = tmp_path_factory.mktemp("browser")
    page = folder / "report.html"
    write_rig_page(inputs.folder, inputs.template, page, performances=inputs.performances)

    def opened_page(script: str, first: str) -> tuple[dict[str, Any], Path]:
        text = page.read_text(encoding="utf-8")
        told = f"<script>{script};document.title = JSON.stringify(told())</script></body>"
        changed = folder / "driven.html"
        text = text.replace("<head>", f"<head><script>{first}</script>")
        changed.write_text(text.replace("</body>", told), encoding="utf-8")
        shot = folder / "shot.png"
        profile = f"--user-data-dir={folder / 'profile'}"
        done = subprocess.run(
            [str(_BROWSER), *_FLAGS, profile, f"--screenshot={shot}", "--dump-dom",
             changed.as_uri()],
            capture_output=True, text=True, check=False, timeout=120,
        )  # fmt: skip
        title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
        assert title is not None, done.stderr[-2000:]
        return json.loads(title.group(1)), shot

    return opened_page


_TOLD = """
const root = document.querySelector('.rigview');
const told = () => ({ state: root.dataset.state, sorry: root.querySelector('.sorry').textContent,
  ...(root.rigview ? (root.rigview.draw(), { points: Array.from(root.rigview.points),
    levels: Array.from(root.rigview.levels), canvas: canvasBox() }) : {}) });
const canvasBox = () => { const b = root.querySelector('canvas').getBoundingClientRect();
  return [b.left, b.top, b.width, b.height].map(Math.round); };
const pull = (name, value) => { const s = document.querySelector(`[aria-label="${name}"]`);
  s.value = value; s.dispatchEvent(new Event('input')); };
"""


def test_browser_poses_as_numpy_does(drive: Driven, inputs: RigInputs) -> None:
    told, shot = drive(f"{_TOLD} pull('jawOpen', 0.75); pull('mouthSmile_L', 0.5)", "")
    assert told["state"] == "ready"
    weights = np.zeros(6)
    weights[:2] = 0.75, 0.5
    points = np.array(told["points"]).reshape(-1, 3)
    assert np.abs(points - inputs.rig.shape(weights)).max() < 1e-3
    left, top, width, height = told["canvas"]
    picture = cv2.imread(str(shot))
    assert picture is not None
    canvas = picture[top : top + height, left : left + width]
    middle = canvas[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4]
    assert middle.std() > 5, "a face is drawn"


def test_browser_shows_the_shapes_before_and_the_change(drive: Driven, inputs: RigInputs) -> None:
    assert inputs.before is not None
    frame = 3
    script = f"""{_TOLD} pull('frame', {frame});
      root.querySelector('[data-which]').value = 'before';
      root.querySelector('[data-colour]').value = 'change';
      root.querySelector('[data-wires]').click();"""
    told, _ = drive(script, "")
    weights = inputs.rig.weights[frame]
    before = inputs.before.neutral + np.tensordot(weights, inputs.before.deltas, axes=1)
    points = np.array(told["points"]).reshape(-1, 3)
    assert np.abs(points - before).max() < 0.1, "to the steps of the change"
    change = np.linalg.norm(before - inputs.rig.shape(weights), axis=1)
    levels = np.array(told["levels"])
    scale = change.max() / levels.max()
    assert np.abs(levels * scale - change).max() < 0.1


def test_browser_without_webgl_says_so(drive: Driven) -> None:
    off = "HTMLCanvasElement.prototype.getContext = () => null;"
    told, _ = drive(_TOLD, off)
    assert told["state"] == "failed"
    assert told["sorry"].startswith("No 3D view: this browser has no WebGL 2.")
