"""Regularizers, which keep a fitted cage even: most of them are quadratic forms in its control points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import sparse

from ..cage import ControlCage
from ..device_arrays import upload
from ..kernels.linear_maps import SparseMatrix
from ..mesh.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray
from ..surface import LimitSurface

# No quadratic form.
FOLDS = "folds"
# Terms of the displacement from the initial control points.
ABOUT_START = ("anchor",)
# Faces count from this cosine between their normals on, 107 degrees. Where a part is about to grow, those on both sides
# of its end turn by a right angle and more.
LEAST_COSINE = -0.3


def _laplacian(surface: LimitSurface) -> sparse.csr_array:
    """Mean squared distance of control points from the mean of their neighbours."""
    laplacian = surface.cage.laplacian()
    return laplacian.T @ laplacian / surface.cage.vertex_count


def _anchor(surface: LimitSurface) -> sparse.csr_array:
    """Mean squared distance of control points from their initial positions."""
    return sparse.csr_array(sparse.eye_array(surface.cage.vertex_count) / surface.cage.vertex_count)


# By their names: symmetric matrices over control points, for a surface as it begins.
MATRICES: dict[str, Callable[[LimitSurface], sparse.csr_array]] = {
    "laplacian": _laplacian,
    "bending": LimitSurface.bending,
    "anchor": _anchor,
}


@dataclass(frozen=True, eq=False)
class Regularizer:
    """Half of ``(x - x0)^T Q (x - x0)``, added up over the three coordinates of control points x."""

    matrix: sparse.csr_array  # (n, n) CSR array of float64: Q: symmetric and positive semi-definite
    origin: FloatArray  # (n, 3) float64: x0

    @classmethod
    def named(cls, name: str, start: LimitSurface) -> Regularizer:
        """One of `MATRICES`, for a surface that begins here. Raises ValueError if there is none of that name."""
        _require_name(name, (*MATRICES,))
        points = start.cage.positions
        return cls(MATRICES[name](start).tocsr(), points if name in ABOUT_START else np.zeros_like(points))


def regularizer(name: str, start: LimitSurface) -> Callable[[dr.ArrayBase], mi.Float]:
    """Term that keeps a cage even, as a loss of control points on the device, for optimisations of one's own.

    Parameters
    ----------
    name : "laplacian" | "bending" | "anchor" | "folds"
        As in `CageFit`.
    start : LimitSurface
        Where the optimisation begins: "anchor" measures distances from its control points, "bending" derivatives in its
        metric, see `LimitSurface.bending`.

    Returns
    -------
    callable
        Maps control points, a flat ``mi.Float`` of x, y, z of each such as the shape's parameter ``control_points``, to
        a ``mi.Float`` of one number, differentiable by them. "laplacian", "bending" and "anchor" are half a sum of
        squares, for a mean over control points or an integral over the surface.

    Raises
    ------
    ValueError
        If there is none of that name.
    """
    _require_name(name, (*MATRICES, FOLDS))
    return folds(start.cage) if name == FOLDS else device_form(Regularizer.named(name, start))


def _require_name(name: str, names: tuple[str, ...]) -> None:
    if name not in names:
        raise ValueError(f'regularizer "{name}"; expected one of {", ".join(names)}')


def device_form(regularizer: Regularizer) -> Callable[[dr.ArrayBase], mi.Float]:
    """A regularizer as a function of control points, flat x, y, z, on the device; differentiable by them."""
    matrix = SparseMatrix(regularizer.matrix, mi.Float, is_relative=False)
    origin = upload(mi.Float, regularizer.origin)

    def energy(points: dr.ArrayBase) -> mi.Float:
        away = points - origin
        # The derivative of the form is the product, which need not be differentiated.
        product = matrix.product(dr.detach(away))
        return dr.dot(away, product) - dr.dot(dr.detach(away), product) / 2

    return energy


def folds(cage: ControlCage) -> Callable[[dr.ArrayBase], mi.Float]:
    """Penalty of folds between neighbouring faces: a function of control points, flat x, y, z, differentiable by them.

    The mean over edges between two faces of ``max(0, -0.3 - cos a)^2``, where a is the angle between normals: between
    those of the two quadrilaterals, or triangles, that the edge makes with the next vertices around each face.
    """
    t = cage.topology
    half_edges = np.flatnonzero(t.twin > np.arange(t.half_edge_count))
    sides = [_quadrilaterals(t, each) for each in (half_edges, t.twin[half_edges])]

    def energy(points: dr.ArrayBase) -> mi.Float:
        if not len(half_edges):
            return mi.Float(0)
        cosine: Any = dr.dot(*(_normals(points, side) for side in sides))
        return dr.sum(dr.square(dr.maximum(LEAST_COSINE - cosine, 0))) / len(half_edges)

    return energy


def _quadrilaterals(t: Topology, half_edges: IntArray) -> list[mi.UInt32]:
    """Vertices of a face around its edge: one before it, the ends, and one after it, which may be the first one."""
    corners = t.prev[half_edges], half_edges, t.next[half_edges], t.next[t.next[half_edges]]
    return [upload(mi.UInt32, t.face_vertices[each]) for each in corners]


def _normals(points: dr.ArrayBase, corners: list[mi.UInt32]) -> mi.Normal3f:
    before, start, end, after = (dr.gather(mi.Point3f, points, each) for each in corners)
    normal = dr.cross(end - before, after - start)
    return normal * dr.rsqrt(dr.maximum(dr.squared_norm(normal), dr.smallest(mi.Float)))
