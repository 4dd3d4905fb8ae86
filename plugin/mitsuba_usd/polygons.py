"""Polygon meshes of USD: normals at face corners, and the shapes that USD has without meshes."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from mitsuba_subdivision.cage import CageContents, CageSource, require_range
from mitsuba_subdivision.files import MeshReader, reversed_order, value_at
from mitsuba_subdivision.mesh import IntArray
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pxr import Usd

# Segments of a circle around the axis, and of half a circle along it.
AROUND, ALONG = 64, 24
# Even permutations of the coordinates that take z to an axis.
_TURNS = {"X": (2, 0, 1), "Y": (1, 2, 0), "Z": (0, 1, 2)}


def read_normals(reader: MeshReader, cage: CageContents) -> NDArray[np.float64] | None:
    """Authored normals of a polygon mesh at its face corners, ``(n_h, 3)``, after skinning; None without any.

    They are in the mesh's own space, as the cage. Those that do not fit the mesh are left out, with a message.
    """
    from pxr import UsdGeom

    mesh = reader.mesh
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    is_primvar = primvar and primvar.HasAuthoredValue()
    attribute = primvar.GetAttr() if is_primvar else mesh.GetNormalsAttr()
    interpolation = str(primvar.GetInterpolation() if is_primvar else mesh.GetNormalsInterpolation())
    sizes, corners = cage.face_sizes, len(cage.face_vertices)
    order = reversed_order(sizes) if reader.is_left_handed() else np.arange(corners)
    # The element of each face corner, and how many there are.
    elements: dict[str, tuple[IntArray, int]] = {
        "vertex": (cage.face_vertices, len(cage.positions)),
        "varying": (cage.face_vertices, len(cage.positions)),
        "faceVarying": (order, corners),
        "uniform": (np.repeat(np.arange(len(sizes)), sizes), len(sizes)),
        "constant": (np.zeros(corners, np.int64), 1),
    }

    def read() -> NDArray[np.float64] | None:
        normals = reader.array(attribute, np.float64, width=3)
        if not len(normals):
            return None
        if interpolation not in elements:
            raise reader.error(f'normals have the interpolation "{interpolation}"', f"one of {', '.join(elements)}")
        element, expected = elements[interpolation]
        indices = np.arange(len(normals))
        if is_primvar and primvar.IsIndexed():
            indices = reader.array(primvar.GetIndicesAttr(), np.int64)
        if len(indices) != expected:
            raise reader.error(f"there are {len(indices)} {interpolation} normals or indices", str(expected))
        require_range(indices, len(normals), f"{reader.location}: normals have")
        if not np.isfinite(normals).all():
            raise reader.error("there are normals that are not finite", "finite numbers")
        return normals[indices[element]]

    normals = reader.fitting(attribute, "the normals are left out", read, None)
    if normals is None:
        return None
    return reader.skinning.normals(mesh, cage.positions, cage.face_vertices, normals)


def read_gprim(prim: Usd.Prim, time: Usd.TimeCode) -> tuple[CageContents, NDArray[np.float64] | None]:
    """A Cube, Plane, Sphere, Cylinder, Cone or Capsule as polygons, maybe with normals at face corners."""

    def number(name: str, usual: float) -> float:
        value = value_at(prim.GetAttribute(name), time)
        size = usual if value is None else float(value)
        if not 0 <= size < np.inf:
            raise ValueError(f"{name} is {size}; expected a finite number, 0 or more")
        return size

    axis = str(value_at(prim.GetAttribute("axis"), time)) if prim.HasAttribute("axis") else "Z"
    if axis not in _TURNS:
        raise ValueError(f'axis is "{axis}"; expected X, Y or Z')
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
    lower, upper = (radius, -half), (radius, half)
    return _revolved([_line((0, -half), lower), _line(lower, upper), _line(upper, (0, half))])


def _cone(number: Number) -> Polygons:
    radius, half = number("radius", 1.0), number("height", 2.0) / 2
    return _revolved([_line((0, -half), (radius, -half)), _line((radius, -half), (0, half))])


def _capsule(number: Number) -> Polygons:
    radius, half = number("radius", 0.5), number("height", 1.0) / 2
    return _revolved([_arc(radius, -90, 0, -half), _line((radius, -half), (radius, half)), _arc(radius, 0, 90, half)])


GPRIMS: dict[str, Callable[[Number], Polygons]] = {
    "Cube": _cube, "Plane": _plane, "Sphere": _sphere, "Cylinder": _cylinder, "Cone": _cone, "Capsule": _capsule,
}  # fmt: skip


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
