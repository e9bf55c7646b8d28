"""A rig as one small GLB to put into a page: whole-number offsets of the moved vertices alone.

`rig/export_gltf.py` writes the full exchange file; this one is a fifth of its size and needs no
library. Offsets are steps of 1/32767 of the rig's largest displacement, so about a micrometre;
what need not be as fine, such as a change of shapes, takes 1/127.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Floats, Ints32, check_shape
from recon.mesh import Mesh
from rig.face_rig import FaceRig

_METRES = 0.001
_FINE, _COARSE = 32767, 127  # steps of a normalised number of 16 and of 8 bits
_SHORT_INDEX = 65535  # the largest index is left free, as glTF asks
_KINDS = {"i1": 5120, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_TYPES = {1: "SCALAR", 3: "VEC3"}
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963


def quads_first(polygons: Ints32) -> Ints32:
    """The polygons (P, 4) with all quads before all triangles, each kind in its old order."""
    return np.ascontiguousarray(polygons[np.argsort(polygons[:, 3] < 0, kind="stable")])


def step_mm(rig: FaceRig, *, coarse: bool = False) -> float:
    """How finely the offsets are written, mm."""
    largest = float(np.abs(rig.deltas).max(initial=0.0))
    return (largest or 1.0) / (_COARSE if coarse else _FINE)


def compact_glb(
    rig: FaceRig, times_s: Floats, *, held: bool = False, coarse: bool = False
) -> bytes:
    """A rig as the bytes of a .glb, with its solved weights as an animation and no head motion.

    The node's scale turns the file's unit, the rig's largest displacement, into metres. Triangles
    come as all quads' first halves, single triangles, all quads' second halves; the number of quads
    is in the mesh's extras, so that a reader can leave the diagonals out. Normals are the
    neutral's.

    Args:
        rig: mm.
        times_s: (F,) when each of the rig's frames is shown.
        held: hold each frame until the next, for frames that are no motion.
        coarse: offsets in 127 steps instead of 32767.

    Returns:
        a binary glTF 2.0 that asks for KHR_mesh_quantization.

    References:
        Khronos, glTF 2.0 Specification, 3.6.2.3 Sparse Accessors, 3.7.2.2 Morph Targets, 3.11
        Animations, 4.4 GLB; extension KHR_mesh_quantization.
    """
    check_shape(weights=(rig.weights, "F B"), times_s=(times_s, "F"))
    steps, kind = (_COARSE, "<i1") if coarse else (_FINE, "<i2")
    unit_mm = step_mm(rig, coarse=coarse) * steps
    polygons = quads_first(rig.polygons)
    mesh = Mesh(rig.neutral, polygons)
    pack = _Pack()
    small = len(rig.neutral) <= _SHORT_INDEX
    index = "u2" if small else "u4"
    attributes = {
        "POSITION": pack.dense((rig.neutral / unit_mm).astype("<f4"), _VERTEX_BUFFER, bounds=True),
        "NORMAL": pack.normals(mesh.normals()),
    }
    corners = pack.dense(mesh.triangles.reshape(-1, 1).astype(f"<{index}"), _INDEX_BUFFER)
    targets = [
        {"POSITION": pack.sparse(np.rint(delta / unit_mm * steps).astype(kind), index)}
        for delta in rig.deltas
    ]
    primitive: dict[str, Any] = {"attributes": attributes, "indices": corners, "material": 0}
    extras: dict[str, Any] = {"quads": int((polygons[:, 3] >= 0).sum())}
    shape: dict[str, Any] = {"name": "head", "primitives": [primitive], "extras": extras}
    if targets:
        primitive["targets"] = targets
        extras["targetNames"] = list(rig.names)
        shape["weights"] = [0.0] * len(targets)
    animations = _animation(pack, rig, times_s, held) if targets and len(rig.weights) else []
    return pack.glb(
        scene=0,
        scenes=[{"nodes": [0]}],
        nodes=[{"name": "head", "mesh": 0, "scale": [unit_mm * _METRES] * 3}],
        meshes=[shape],
        materials=[_SKIN],
        **({"animations": animations} if animations else {}),
    )


_SKIN = {
    "name": "skin",
    "doubleSided": True,
    "pbrMetallicRoughness": {
        "baseColorFactor": [0.72, 0.6, 0.54, 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": 0.7,
    },
}


def _animation(pack: _Pack, rig: FaceRig, times_s: Floats, held: bool) -> list[dict[str, Any]]:
    times = pack.dense(times_s.reshape(-1, 1).astype("<f4"), bounds=True)
    share = np.rint(np.clip(rig.weights, 0.0, 1.0) * 65535).astype("<u2").reshape(-1, 1)
    weights = pack.dense(share, normalized=True)
    sampler = {
        "input": times, "output": weights, "interpolation": "STEP" if held else "LINEAR"
    }  # fmt: skip
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    return [{"name": "solved weights", "channels": [channel], "samplers": [sampler]}]


@dataclass
class _Pack:
    """Accessors, their views and their bytes, filled one by one."""

    bytes_: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def dense(
        self,
        rows: NDArray[Any],
        target: int | None = None,
        *,
        bounds: bool = False,
        normalized: bool = False,
    ) -> int:
        """Add every row; gives the accessor."""
        accessor = self._accessor(rows, bounds)
        accessor["bufferView"] = self._view(rows, target)
        if normalized:
            accessor["normalized"] = True
        return len(self.accessors) - 1

    def normals(self, normals: Floats) -> int:
        """Add unit normals (V, 3) as bytes, each row padded to four."""
        whole = np.isfinite(normals).all(axis=1, keepdims=True)
        rows = np.rint(127 * np.where(whole, normals, [0.0, 0.0, 1.0])).astype("<i1")
        accessor = self._accessor(rows, False)
        padded = np.concatenate([rows, np.zeros((len(rows), 1), "<i1")], axis=1)
        accessor |= {"bufferView": self._view(padded, _VERTEX_BUFFER), "normalized": True}
        self.views[-1]["byteStride"] = 4
        return len(self.accessors) - 1

    def sparse(self, rows: NDArray[Any], index: str) -> int:
        """Add a morph target's rows that are not zero; gives the accessor."""
        accessor = self._accessor(rows, True)
        accessor["normalized"] = True
        moved = np.flatnonzero((rows != 0).any(axis=1))
        if len(moved):
            accessor["sparse"] = {
                "count": len(moved),
                "indices": {
                    "bufferView": self._view(moved.astype(f"<{index}")),
                    "componentType": _KINDS[index],
                },
                "values": {"bufferView": self._view(rows[moved])},
            }
        return len(self.accessors) - 1

    def glb(self, **document: Any) -> bytes:
        """The whole file."""
        whole = {
            "asset": {"version": "2.0", "generator": "likeness"},
            "extensionsUsed": ["KHR_mesh_quantization"],
            "extensionsRequired": ["KHR_mesh_quantization"],
            **document,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.bytes_)}],
        }
        text = json.dumps(whole, separators=(",", ":")).encode("utf-8")
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + len(self.bytes_)
        head = np.array([0x46546C67, 2, size, len(text), 0x4E4F534A], "<u4").tobytes()
        middle = np.array([len(self.bytes_), 0x004E4942], "<u4").tobytes()
        return head + text + middle + bytes(self.bytes_)

    def _accessor(self, rows: NDArray[Any], bounds: bool) -> dict[str, Any]:
        kind = rows.dtype.str[1:]
        accessor: dict[str, Any] = {
            "componentType": _KINDS[kind], "count": len(rows), "type": _TYPES[rows.shape[1]]
        }  # fmt: skip
        if bounds:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return accessor

    def _view(self, rows: NDArray[Any], target: int | None = None) -> int:
        data = np.ascontiguousarray(rows).tobytes()
        view: dict[str, Any] = {
            "buffer": 0, "byteOffset": len(self.bytes_), "byteLength": len(data)
        }  # fmt: skip
        if target is not None:
            view["target"] = target
        self.bytes_ += data + b"\0" * (-len(data) % 4)
        self.views.append(view)
        return len(self.views) - 1
