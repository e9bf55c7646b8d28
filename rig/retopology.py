"""A whole template carried onto a mesh of other topology."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from capture.arrays import Bools, Floats, Ints
from capture.errors import InputError, SettingsError
from capture.progress import Progress, silent
from recon.mesh import Mesh
from rig.carried_pairs import carry_pairs
from rig.correspondence import Correspondence, correspond
from rig.correspondence_fit import FitSettings
from rig.gradient import components
from rig.slits import annotate_pairs, edge_lengths
from rig.template import Template, check_head_size
from rig.transfer import factorised, transfer_shapes
from rig.transfer_rbf import transfer_shapes_rbf

_FADE_MM = 30.0  # along the mesh from what is bound: further away nothing moves
_METHODS = ("gradient", "rbf")


@dataclass(frozen=True, kw_only=True)
class RetopologySettings(FitSettings):
    """How a template is carried onto another mesh.

    Attributes:
        transfer: how shapes follow the face's form: by deformation gradients, or by a warp of space
            (rbf).
    """

    transfer: Literal["gradient", "rbf"] = "gradient"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.transfer not in _METHODS:
            raise SettingsError(
                f'template.transfer = "{self.transfer}": expected {" or ".join(_METHODS)}'
            )


def retopologise(
    template: Template,
    mesh: Mesh,
    settings: RetopologySettings | None = None,
    *,
    landmarks: Ints | None = None,
    progress: Progress = silent,
) -> Template:
    """Carry a template onto a mesh: the mesh's topology and form, the template's shapes and names.

    Args:
        template: the artist's rig.
        mesh: a neutral face of any topology, mm, e.g. a tracked production mesh.
        settings: of the registration and the transfer.
        landmarks: (N, 2) vertices of the template and of the mesh that belong together.
        progress: told after each step.

    Raises:
        InputError: when the mesh is no face in millimetres.
        SolveError: when the template cannot be placed on the mesh.
    """
    chosen = settings or RetopologySettings()
    check_face(mesh)
    found = correspond(template.mesh, mesh, chosen, landmarks=landmarks, progress=progress)
    return carry_template(template, mesh, found, chosen)


def carry_template(
    template: Template,
    mesh: Mesh,
    correspondence: Correspondence,
    settings: RetopologySettings | None = None,
) -> Template:
    """Carry a template through a correspondence that is known.

    The template's neutral and shapes are sampled at the mesh's vertices; from that form to the
    mesh's own the shapes are then transferred as between faces of one topology. Vertices without a
    place follow their bound neighbours, harmonically, and are still 30 mm away from them.
    """
    chosen = settings or RetopologySettings()
    sampled = sample_template(template, mesh, correspondence)
    transfer = transfer_shapes if chosen.transfer == "gradient" else transfer_shapes_rbf
    return Template(
        neutral=mesh.vertices,
        deltas=transfer(sampled, mesh.vertices),
        names=template.names,
        polygons=mesh.polygons,
        rigid_vertices=sampled.rigid_vertices,
        lid_pairs=sampled.lid_pairs,
        lip_pairs=sampled.lip_pairs,
    )


def sample_template(template: Template, mesh: Mesh, correspondence: Correspondence) -> Template:
    """The template's own form and shapes in a mesh's topology, place, axes and size.

    Pairs of lids and lips are carried where the template has them; where it has none, they are
    those of the mesh's own eyes and mouth, if these are holes.
    """
    rows = correspondence.rows()
    motion = correspondence.mesh_from_template
    placed = motion.apply(template.neutral)
    turned = motion.scale * template.deltas @ motion.rotation.T
    values = np.concatenate([placed[:, None], turned.transpose(1, 0, 2)], axis=1)
    count = len(mesh.vertices)
    carried = (rows @ values.reshape(len(placed), -1)).reshape(count, -1, 3)
    carried[:, 0] = np.where(correspondence.bound[:, None], carried[:, 0] - mesh.vertices, 0.0)
    spread = _spread(mesh, correspondence.bound, carried.reshape(count, -1)).reshape(count, -1, 3)
    rigid = np.zeros(len(placed))
    rigid[template.rigid_vertices] = 1.0
    lids, lips = _pairs(template, mesh, correspondence)
    return Template(
        neutral=mesh.vertices + spread[:, 0],
        deltas=np.ascontiguousarray(spread[:, 1:].transpose(1, 0, 2)),
        names=template.names,
        polygons=mesh.polygons,
        rigid_vertices=np.flatnonzero(rows @ rigid > 0.5),
        lid_pairs=lids,
        lip_pairs=lips,
    )


def retopology_report(
    template: Template, mesh: Mesh, correspondence: Correspondence, carried: Template
) -> dict[str, Any]:
    """What a reader wants to know of a template carried onto a mesh, fit for JSON."""
    distance = correspondence.distance_mm[correspondence.bound]
    own = components(mesh.triangles, len(mesh.vertices))
    used = np.unique(mesh.triangles)
    bound_labels = np.unique(own[correspondence.bound])
    lost = np.flatnonzero(template.moves() & ~carried.moves())
    theirs = components(template.mesh.triangles, len(template.neutral))
    return {
        "vertices": len(mesh.vertices),
        "bound": int(correspondence.bound.sum()),
        "unbound": int((~correspondence.bound).sum()),
        "distance_mean_mm": round(float(distance.mean()), 4) if len(distance) else None,
        "distance_p95_mm": round(float(np.quantile(distance, 0.95)), 4) if len(distance) else None,
        "torn_edges": correspondence.torn,
        "torn_edges_before_repair": correspondence.torn_before,
        "scale": round(correspondence.mesh_from_template.scale, 5),
        "mesh_components_without_motion": len(np.setdiff1d(own[used], bound_labels)),
        "template_components_skipped": len(np.unique(theirs[correspondence.missing])),
        "shapes": len(template.names),
        "shapes_skipped": [template.names[k] for k in lost],
        "shapes_without_effect": [
            name for name, moves in zip(template.names, template.moves(), strict=True) if not moves
        ],
        "lid_pairs": len(carried.lid_pairs),
        "lip_pairs": len(carried.lip_pairs),
        "rigid_vertices": len(carried.rigid_vertices),
    }


def check_face(mesh: Mesh) -> None:
    """Refuse a mesh that is no face in millimetres.

    Raises:
        InputError: saying what was found and which factor would bring it to mm.
    """
    if len(mesh.polygons) == 0:
        raise InputError("mesh: expected a face, found no polygons")
    used = mesh.vertices[np.unique(mesh.triangles)]
    check_head_size(used, "mesh: expected a face", "its vertices")


def _pairs(template: Template, mesh: Mesh, correspondence: Correspondence) -> tuple[Ints, Ints]:
    if len(template.lid_pairs) or len(template.lip_pairs):
        lids, lips = (
            carry_pairs(template, pairs, mesh, correspondence)
            for pairs in (template.lid_pairs, template.lip_pairs)
        )
        return lids, lips
    turn = correspondence.mesh_from_template.rotation
    upright = mesh.vertices @ turn  # back into the template's axes
    return annotate_pairs(upright, mesh.triangles)


def _spread(mesh: Mesh, bound: Bools, values: Floats) -> Floats:
    """Values (U, K) of bound vertices continued to the others, fading to 0 over 30 mm.

    Each vertex in between takes the mean of its neighbours, the nearer the more: no value is beyond
    those around, and where all around are 0, exactly 0 stays.
    """
    graph = edge_lengths(mesh.vertices, mesh.triangles)
    out: Floats = np.where(bound[:, None], values, 0.0)
    if bound.all() or not bound.any():
        return out
    away = csgraph.dijkstra(graph, indices=np.flatnonzero(bound), min_only=True, limit=_FADE_MM)
    free = np.flatnonzero(~bound & np.isfinite(away))
    if len(free) == 0:
        return out
    near = sparse.csr_array(
        (1.0 / np.maximum(graph.data, 1e-3), graph.indices, graph.indptr), shape=graph.shape
    )
    total = np.asarray(near.sum(axis=1)).ravel()[free]
    system = sparse.diags_array(total) - near[free][:, free]
    out[free] = factorised(system).solve(near[free] @ out)
    return out
