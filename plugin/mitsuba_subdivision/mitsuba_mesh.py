"""Triangles and curves as Mitsuba shapes, as scene entries and as files."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .cage.contents import Attribute
from .device_arrays import upload
from .files.ply import write_polygons
from .mesh.connectivity import IntArray
from .variants import SceneNode
from .whole_file import write_text

# Built-in buffers of a mesh, and their columns in a PLY file.
_BUFFERS = {"vertex_positions": "xyz", "vertex_normals": ("nx", "ny", "nz"), "vertex_texcoords": "uv"}


def mitsuba_mesh(
    name: str,
    triangles: NDArray[np.integer],  # (m, 3)
    # (n, k) each: `vertex_positions`, optional `vertex_normals` and `vertex_texcoords`, `vertex_NAME` and `face_NAME`
    buffers: Mapping[str, NDArray],
    # Whether vertex normals are averages of their triangles'. Without normals, triangles are flat.
    averages_normals: bool = False,
    **parts: mi.Object | None,  # `bsdf`, `emitter` and `interior`
) -> mi.Mesh:
    """Make a mesh of the current variant."""
    properties = mi.Properties()
    for key, part in parts.items():
        if part is not None:
            properties[key] = part
    has_normals, has_uv = averages_normals or "vertex_normals" in buffers, "vertex_texcoords" in buffers
    given: dict[str, Any] = {"props": properties, "has_vertex_normals": has_normals, "has_vertex_texcoords": has_uv}
    mesh = mi.Mesh(name, len(buffers["vertex_positions"]), len(triangles), **given)
    for key, values in buffers.items():
        if key not in _BUFFERS:
            mesh.add_attribute(key, values.shape[1], [0.0] * values.size)
    parameters = mi.traverse(mesh)
    for key, values in {"faces": triangles, **buffers}.items():
        stored = values
        if mi.is_spectral and key not in _BUFFERS and values.shape[1] == 3 and "color" in key.lower():
            # Mitsuba's meshes store spectra in place of colours.
            colors, row = np.unique(values, axis=0, return_inverse=True)
            stored = np.array([mi.srgb_model_fetch(color) for color in colors.tolist()])[row.ravel()]
        parameters[key] = upload(type(parameters[key]), stored)
    parameters.update()
    if averages_normals:
        mesh.recompute_vertex_normals()
    return mesh


@dataclass(frozen=True, eq=False)
class PolygonMesh:
    """Triangles in world space, with vertex normals or flat."""

    name: str
    triangles: IntArray  # (n_t, 3)
    vertices: dict[str, NDArray]  # (n_v, k) each: buffers of `mitsuba_mesh`

    suffix: ClassVar = ".ply"

    def entry(self, bsdf: SceneNode, emitter: SceneNode | None) -> SceneNode:
        """Scene entry of the mesh, for `with_meshes` and `save_scene`."""
        # Otherwise Mitsuba would compute normals.
        facets = {} if "vertex_normals" in self.vertices else {"face_normals": True}
        shining = {} if emitter is None else {"emitter": emitter}
        return {"type": "ply", "mesh": self, **facets, "bsdf": bsdf, **shining}

    def loaded(self, bsdf: mi.BSDF | None, emitter: mi.Emitter | None, interior: mi.Medium | None = None) -> mi.Mesh:
        return mitsuba_mesh(self.name, self.triangles, self.vertices, bsdf=bsdf, emitter=emitter, interior=interior)

    def save(self, path: Path) -> None:
        """Write the mesh to a PLY file, so that Mitsuba's shape ``ply`` has the same buffers."""
        columns: dict[str, NDArray] = {}
        for name, values in self.vertices.items():
            stem = name.removeprefix("vertex_")
            columns.update(zip(_BUFFERS.get(name, [f"{stem}_{letter}" for letter in "xyz"]), values.T, strict=False))
        properties = {name: values.astype(np.float32) for name, values in columns.items()}
        write_polygons(path, properties, np.full(len(self.triangles), 3), self.triangles.ravel())


@dataclass(frozen=True, eq=False)
class CurveSet:
    """Tubes around curves, which Mitsuba reads from files only."""

    type: str  # "linearcurve" or "bsplinecurve"
    points: NDArray[np.float64]  # (m, 4): control points and radii
    counts: IntArray  # (n,): points of each curve
    textures: SceneNode = field(default_factory=dict)  # Attributes as parameters of the shape
    suffix: ClassVar = ".txt"

    def placed(self, matrices: NDArray[np.float64]) -> CurveSet:
        """Copies with these transforms ``(n, 4, 4)``, with round tubes."""
        radii = np.cbrt(np.abs(np.linalg.det(matrices[:, :3, :3])))[:, None, None] * self.points[:, 3:]
        points = np.concatenate([points_at(self.points[:, :3], matrices), radii], axis=2).reshape(-1, 4)
        return replace(self, points=points, counts=np.tile(self.counts, len(matrices)))

    def entry(self, attributes: Mapping[str, Attribute], bsdf: SceneNode) -> SceneNode:
        """Scene entry of the shape, with attributes along its segments, for `with_meshes` and `save_scene`."""
        bitmap = {"type": "bitmap", "filter_type": "nearest", "wrap_mode": "clamp", "accel": False}
        textures: SceneNode = {}
        for name, attribute in attributes.items():
            pixels = mi.Bitmap(attribute.values[:, None].astype(np.float32))
            textures[f"vertex_{name}"] = {**bitmap, "raw": attribute.values.shape[1] == 1, "bitmap": pixels}
        return {"type": self.type, "mesh": replace(self, textures=textures), **textures, "bsdf": bsdf}

    def loaded(self, bsdf: mi.BSDF, *_: object) -> mi.Object:
        """The shape as a Mitsuba object, without emitter and interior."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"curves{self.suffix}"
            self.save(path)
            return mi.load_dict({"type": self.type, "filename": str(path), **self.textures, "bsdf": bsdf})

    def save(self, path: Path) -> None:
        """Write Mitsuba's file: a line for each point, and an empty line between curves."""
        lines = "\n".join("%.9g %.9g %.9g %.9g\n" * count for count in self.counts.tolist())
        write_text(path, lines % tuple(self.points.ravel().tolist()))


def with_meshes(scene: SceneNode) -> SceneNode:
    """Load the polygon meshes of a scene for ``mi.load_dict``; meshes of one material share its BSDF."""
    bsdfs: dict[str, mi.Object] = {}
    used = set()

    def loaded(entry: Any) -> Any:
        if not isinstance(entry, dict):
            return entry
        given = entry.get("bsdf", {})
        shared = given["id"] if isinstance(given, dict) and given.get("type") == "ref" else None
        if "mesh" not in entry:
            used.add(shared)
            return {name: loaded(part) if entry["type"] == "shapegroup" else part for name, part in entry.items()}
        if shared is None:
            bsdf = mi.load_dict(given)
        else:
            bsdf = bsdfs[shared] = bsdfs.get(shared) or mi.load_dict(scene[shared])
        parts = (mi.load_dict(entry[name]) if name in entry else None for name in ("emitter", "interior"))
        return entry["mesh"].loaded(bsdf, *parts)

    entries = {name: loaded(entry) for name, entry in scene.items()}
    return {name: entry for name, entry in entries.items() if name not in bsdfs or name in used}


def points_at(points: NDArray, matrix: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points ``(n, 3)`` transformed by a matrix ``(4, 4)``, or by several ``(m, 4, 4)``: ``(m, n, 3)``."""
    return points @ matrix[..., :3, :3].swapaxes(-2, -1) + matrix[..., None, :3, 3]


def box_corners(box: NDArray[np.float64]) -> NDArray[np.float64]:
    """The eight corners ``(8, 3)`` of a box with least and greatest coordinates ``(2, 3)``."""
    return np.array(np.meshgrid(*box.T)).reshape(3, -1).T
