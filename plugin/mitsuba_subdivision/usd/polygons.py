"""Polygon meshes of USD: normals at face corners, and the shapes that USD has without meshes."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import CageContents
from ..cage.source import CageSource
from ..files.usd_reader import MeshReader, reversed_order
from ..mesh.connectivity import IntArray
from .stage_warnings import StageWarnings

if TYPE_CHECKING:
    from pxr import Usd

# Segments of a circle around the axis, and of half a circle along it.
AROUND, ALONG = 64, 24
# Even permutations of the coordinates that take z to an axis.
_TURNS = {"X": (2, 0, 1), "Y": (1, 2, 0), "Z": (0, 1, 2)}


def read_normals(reader: MeshReader, cage: CageContents, notes: StageWarnings) -> NDArray[np.float64] | None:
    """Authored normals of a polygon mesh at its face corners, ``(n_h, 3)``, after skinning; None without any.

    Parameters
    ----------
    reader : MeshReader
    cage : CageContents
        Contents of the mesh, in its own space.
    notes : StageWarnings
    """
    from pxr import UsdGeom

    mesh = reader.mesh
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasAuthoredValue():
        attribute, interpolation = primvar.GetAttr(), primvar.GetInterpolation()
        indices = reader.array(primvar.GetIndicesAttr(), np.int64) if primvar.IsIndexed() else None
    else:
        attribute, interpolation, indices = mesh.GetNormalsAttr(), mesh.GetNormalsInterpolation(), None
    normals = reader.array(attribute, np.float64, width=3)
    if not len(normals):
        return None
    sizes, corners = cage.face_sizes, len(cage.face_vertices)
    order = reversed_order(sizes) if reader.is_left_handed() else np.arange(corners)
    element = {
        "vertex": cage.face_vertices,
        "varying": cage.face_vertices,
        "faceVarying": order,
        "uniform": np.repeat(np.arange(len(sizes)), sizes),
        "constant": np.zeros(corners, np.int64),
    }.get(str(interpolation))
    rows = len(normals) if indices is None else len(indices)
    if element is None or element.max(initial=-1) >= rows:
        notes.add("normals whose number does not match the mesh are ignored", mesh.GetPath())
        return None
    if indices is not None:
        element = indices[element]
        if element.min(initial=0) < 0 or element.max(initial=-1) >= len(normals):
            notes.add("normals with indices out of range are ignored", mesh.GetPath())
            return None
    return reader.skinning.normals(mesh, cage.positions, cage.face_vertices, normals[element])


def read_gprim(prim: Usd.Prim, time: Usd.TimeCode) -> tuple[CageContents, NDArray[np.float64] | None]:
    """A Cube, Plane, Sphere, Cylinder, Cone or Capsule as polygons, maybe with normals at face corners."""

    def number(name: str, usual: float) -> float:
        attribute = prim.GetAttribute(name)
        value = attribute.Get(time) if attribute else None
        return usual if value is None else float(value)

    axis = str(prim.GetAttribute("axis").Get(time)) if prim.HasAttribute("axis") else "Z"
    points, normals, sizes, vertices = GPRIMS[str(prim.GetTypeName())](number)
    turn = list(_TURNS[axis])
    if prim.GetTypeName() == "Plane" and axis != "Z":
        # The width is along x or z, never along y.
        points, vertices = points[:, [1, 0, 2]], vertices[::-1]
    cage = CageContents(points[:, turn], sizes, vertices, source=CageSource(str(prim.GetPath())))
    return cage, None if normals is None else normals[:, turn]


Number = Callable[[str, float], float]
Polygons = tuple[NDArray[np.float64], "NDArray[np.float64] | None", IntArray, IntArray]


def _cube(number: Number) -> Polygons:
    half = number("size", 2.0) / 2
    points = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    vertices = np.array([0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3])
    return points, None, np.full(6, 4), vertices


def _plane(number: Number) -> Polygons:
    half = np.array([number("width", 2.0), number("length", 2.0), 0.0]) / 2
    points = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
    return points, None, np.array([4]), np.arange(4)


def _sphere(number: Number) -> Polygons:
    return _revolved([_arc(number("radius", 1.0), -90, 90, 0.0)])


def _cylinder(number: Number) -> Polygons:
    radius, half = number("radius", 1.0), number("height", 2.0) / 2
    return _revolved(
        [_line((0, -half), (radius, -half)), _line((radius, -half), (radius, half)), _line((radius, half), (0, half))]
    )


def _cone(number: Number) -> Polygons:
    radius, half = number("radius", 1.0), number("height", 2.0) / 2
    return _revolved([_line((0, -half), (radius, -half)), _line((radius, -half), (0, half))])


def _capsule(number: Number) -> Polygons:
    radius, half = number("radius", 0.5), number("height", 1.0) / 2
    return _revolved(
        [
            _arc(radius, -90, 0, -half),
            _line((radius, -half), (radius, half)),
            _arc(radius, 0, 90, half),
        ]
    )


GPRIMS: dict[str, Callable[[Number], Polygons]] = {
    "Cube": _cube,
    "Plane": _plane,
    "Sphere": _sphere,
    "Cylinder": _cylinder,
    "Cone": _cone,
    "Capsule": _capsule,
}


def _arc(radius: float, start: float, end: float, height: float) -> tuple[NDArray, NDArray]:
    angle = np.radians(np.linspace(start, end, ALONG + 1))
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = radius * normals + [0, height]
    # On the axis, exactly.
    points[np.abs(normals[:, 0]) < 1e-12, 0] = 0
    return points, normals


def _line(start: tuple[float, float], end: tuple[float, float]) -> tuple[NDArray, NDArray]:
    points = np.array([start, end], dtype=np.float64)
    along = points[1] - points[0]
    normal = np.array([along[1], -along[0]]) / (np.linalg.norm(along) or 1)
    return points, np.array([normal, normal])


def _revolved(parts: list[tuple[NDArray, NDArray]]) -> Polygons:
    """Turn lines of points and normals, ``(distance, z)`` from below to above, around the z axis."""
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def turned(rows: NDArray) -> NDArray:
        """Concatenated rings."""
        return np.concatenate([np.column_stack([r * circle, np.full(AROUND, z)]) for r, z in rows])

    points = np.concatenate([turned(points) for points, _ in parts])
    normals = np.concatenate([turned(normals) for _, normals in parts])
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    rings = np.concatenate([np.arange(start, end - 1) for start, end in pairwise(starts)])
    here = (rings[:, None] * AROUND + np.arange(AROUND)).ravel()
    beside = here - here % AROUND + (here + 1) % AROUND
    quads = np.stack([here, beside, beside + AROUND, here + AROUND], axis=1)
    return points, normals[quads.ravel()], np.full(len(quads), 4), quads.ravel()
