"""Large steps: coordinates in which a gradient step moves a whole surface, not single control points.

A gradient of pictures moves the few points that pictures see. In the coordinates u = (I + λ L) x, with the Laplacian L
of a mesh [Nicolet et al. 2021], the same step also moves their surroundings: in x it is the step times
the inverse of the matrix. Here L may be that of the cage's edges, or the stiffness matrix of the limit surface.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from ..device_arrays import upload
from ..schemes.domain import FloatArray


class LargeSteps:
    """Differentiable change between control points and large-step coordinates.

    It stands in for ``mitsuba.ad.LargeSteps``, which requires a mesh of triangles.

    Parameters
    ----------
    laplacian : (n, n) sparse array
        Symmetric and positive semi-definite, with constants in its null space: `ControlCage.laplacian` or
        `LimitSurface.stiffness`.
    lambda_ : float
        How far steps reach: more than 0. Where it is large, all of the surface moves together.

    Raises
    ------
    ValueError
        If ``lambda_`` is not positive.
    """

    def __init__(self, laplacian: sparse.csr_array, lambda_: float) -> None:
        if not lambda_ > 0:
            raise ValueError(f"lambda_ is {lambda_}; expected a positive number")
        self.matrix = sparse.csr_array(sparse.eye_array(laplacian.shape[0]) + lambda_ * laplacian)
        # Pivots of a positive definite matrix are on its diagonal: the factors are those of Cholesky, but for a scale.
        options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
        self._factors = splu(self.matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options=options)

    def to_differential(self, points: dr.ArrayBase | NDArray) -> mi.Float:
        """Large-step coordinates of control points, flat x, y, z; not differentiable, as they are computed once.

        Parameters
        ----------
        points : (n, 3) array, or flat Dr.Jit array

        Returns
        -------
        mi.Float
        """
        return upload(mi.Float, self.matrix @ rows(points))

    def from_differential(self, u: dr.ArrayBase) -> mi.Float:
        """Control points, flat x, y, z, of large-step coordinates; differentiable in forward and reverse mode."""
        return dr.custom(_Solve, self._factors, u)


class _Solve(dr.CustomOp):
    """Solves the system. As its matrix is symmetric, gradients pass through the same solution."""

    def eval(self, factors, u):
        self.factors = factors
        return self._solved(u)

    def forward(self):
        self.set_grad_out(self._solved(self.grad_in("u")))

    def backward(self):
        self.set_grad_in("u", self._solved(self.grad_out()))

    def name(self):
        return "LargeSteps"

    def _solved(self, flat: dr.ArrayBase) -> mi.Float:
        return upload(mi.Float, self.factors.solve(rows(flat)))


def rows(points: dr.ArrayBase | NDArray) -> FloatArray:
    """Points ``(n, 3)``, given as such or flat."""
    return np.array(points, dtype=np.float64).reshape(-1, 3)
