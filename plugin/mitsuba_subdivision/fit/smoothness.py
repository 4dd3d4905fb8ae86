"""Large steps, which move neighbours together, and regularizers keep a fitted cage even.

A gradient of pictures moves only points that affect pictures. In the coordinates u = (I + λ L) x, with the Laplacian L
of a mesh [Nicolet et al. 2021], a step also moves their neighbourhood: in x it is multiplied by the inverse of the
matrix. L is the Laplacian of the cage's edges, or the stiffness matrix of the limit surface.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from ..cage import ControlCage
from ..device_arrays import upload
from ..kernels.linear_maps import SparseMatrix, attached
from ..schemes.domain import FloatArray
from ..surface import LimitSurface

# Regularizers of the form ``(x - x0)^T Q (x - x0) / 2``, summed over the coordinates of control points x, and others.
QUADRATIC, FOLDS = ("laplacian", "bending", "anchor"), "folds"
# Cosine of the least penalised angle, 107 degrees: at tips of growing parts, faces turn by a right angle and more.
LEAST_COSINE = -0.3


class LargeSteps:
    """Differentiable change between control points and large-step coordinates.

    It replaces ``mitsuba.ad.LargeSteps``, which requires a mesh of triangles.

    Parameters
    ----------
    laplacian : (n, n) sparse array
        Symmetric and positive semi-definite, with constants in its null space: `ControlCage.laplacian` or
        `LimitSurface.stiffness`.
    lambda_ : float
        Smoothing of steps, above 0. With a large value, all of the surface moves together.

    Raises
    ------
    ValueError
        If ``lambda_`` is not positive.
    """

    def __init__(self, laplacian: sparse.csr_array, lambda_: float) -> None:
        if not lambda_ > 0:
            raise ValueError(f"lambda_ is {lambda_}; expected a positive number")
        self.matrix = sparse.csr_array(sparse.eye_array(laplacian.shape[0]) + lambda_ * laplacian)
        # For a positive definite matrix, pivots on the diagonal suffice: the factors are Cholesky's up to a scale.
        options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
        self._factors = splu(self.matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options=options)

    def to_differential(self, points: dr.ArrayBase | NDArray) -> mi.Float:
        """Large-step coordinates of control points, flat x, y, z; not differentiable.

        Parameters
        ----------
        points : (n, 3) array, or flat Dr.Jit array

        Returns
        -------
        mi.Float
        """
        return upload(mi.Float, self.matrix @ rows(points))

    def from_differential(self, u: dr.ArrayBase) -> mi.Float:
        """Control points, flat x, y, z, from large-step coordinates; differentiable in forward and reverse mode."""
        # The matrix is symmetric, so derivatives in both directions use the same solver.
        return attached(self._solved(dr.detach(u)), u, self._solved, self._solved)

    def _solved(self, flat: dr.ArrayBase) -> mi.Float:
        return upload(mi.Float, self._factors.solve(rows(flat)))


def rows(points: dr.ArrayBase | NDArray) -> FloatArray:
    """Points ``(n, 3)`` from an array of this shape or a flat one."""
    return np.array(points, dtype=np.float64).reshape(-1, 3)


def quadratic_form(name: str, start: LimitSurface) -> tuple[sparse.csr_array, FloatArray]:
    """Return Q and x0 of a quadratic regularizer, ``(n, n)`` and ``(n, 3)``, for the initial surface of a fit.

    "laplacian" is the mean squared distance of control points from the mean of their neighbours, "anchor" from their
    initial positions. Raises ValueError for other names.
    """
    _require_name(name, QUADRATIC)
    points, count = start.cage.positions, start.cage.vertex_count
    if name == "anchor":
        return sparse.csr_array(sparse.eye_array(count) / count), points
    laplacian = start.cage.laplacian()
    form = start.bending() if name == "bending" else laplacian.T @ laplacian / count
    return form.tocsr(), np.zeros_like(points)


def regularizer(name: str, start: LimitSurface) -> Callable[[dr.ArrayBase], mi.Float]:
    """Term that keeps a cage even, as a differentiable loss of control points, for other optimisations.

    Parameters
    ----------
    name : "laplacian" | "bending" | "anchor" | "folds"
        As in `CageFit`.
    start : LimitSurface
        Initial surface, with the control points of "anchor" and the metric of "bending" (`LimitSurface.bending`).

    Returns
    -------
    callable
        Maps control points, a flat ``mi.Float`` such as the shape's parameter ``control_points``, to a ``mi.Float`` of
        one number. "laplacian", "bending" and "anchor" are half a sum of squares, as a mean over control points or an
        integral over the surface.

    Raises
    ------
    ValueError
        For an unknown name.
    """
    _require_name(name, (*QUADRATIC, FOLDS))
    if name == FOLDS:
        return folds(start.cage)
    form, x0 = quadratic_form(name, start)
    matrix, origin = SparseMatrix(form, mi.Float, is_relative=False), upload(mi.Float, x0)

    def energy(points: dr.ArrayBase) -> mi.Float:
        away = points - origin
        product = matrix.product(dr.detach(away))  # The product is the derivative of the form
        return dr.dot(away, product) - dr.dot(dr.detach(away), product) / 2

    return energy


def _require_name(name: str, names: tuple[str, ...]) -> None:
    if name not in names:
        raise ValueError(f'regularizer "{name}"; expected one of {", ".join(names)}')


def folds(cage: ControlCage) -> Callable[[dr.ArrayBase], mi.Float]:
    """Penalty of folds between neighbouring faces, as a differentiable function of flat control points.

    The mean over inner edges of ``max(0, -0.3 - cos a)^2``, where a is the angle between the normals of the two
    quadrilaterals or triangles of the edge and its next vertices in each face.
    """
    t = cage.topology
    half_edges = np.flatnonzero(t.twin > np.arange(t.half_edge_count))
    # For both faces of each edge: the vertex before it, its ends, and the vertex after it, which may be the first one.
    sides = [
        [upload(mi.UInt32, t.face_vertices[corners]) for corners in (t.prev[h], h, t.next[h], t.next[t.next[h]])]
        for h in (half_edges, t.twin[half_edges])
    ]

    def energy(points: dr.ArrayBase) -> mi.Float:
        if not len(half_edges):
            return mi.Float(0)
        cosine: Any = dr.dot(*(_normals(points, side) for side in sides))
        return dr.sum(dr.square(dr.maximum(LEAST_COSINE - cosine, 0))) / len(half_edges)

    return energy


def _normals(points: dr.ArrayBase, corners: list[mi.UInt32]) -> mi.Normal3f:
    before, start, end, after = (dr.gather(mi.Point3f, points, corner) for corner in corners)
    normal = dr.cross(end - before, after - start)
    return normal * dr.rsqrt(dr.maximum(dr.squared_norm(normal), dr.smallest(mi.Float)))
