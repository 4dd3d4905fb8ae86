"""Quadratic energies of a surface as sparse matrices over control points: Dirichlet energy and bending energy.

A function on the surface that is subdivided like the points is a sum of basis functions, one for each control point. An
energy that is quadratic in such functions is a symmetric matrix. It is summed class by class: the derivatives of the
basis functions, at the nodes of a Gauss rule on every polynomial piece, are the same for all patches of a class; only
the metric differs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..evaluation.eigenbasis import CLUSTER_WIDTH
from ..evaluation.irregular_patch import IrregularPatch, level_rows
from ..evaluation.patch_tree import patch_trees
from ..evaluation.polynomials import polynomial_basis
from ..mesh.signature import Signature
from ..messages import counted
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .patch_table import PatchTable

if TYPE_CHECKING:
    from scipy import sparse

# Fraction of the energy around an extraordinary point that may be left out beyond the last level, by the ratio from
# level to level that the eigenvalues give; and most levels.
TAIL, MOST_LEVELS = 2.0**-20, 64
# Numbers per run of patches, which bounds temporary memory.
CHUNK = 1 << 21

# Maps derivatives by u, v, uu, uv and vv of the basis functions (5, S, K) and of points (5, P, S, 3) to (P, S, m, K): m
# derivatives of the basis functions along the surface, times the square root of the area element.
Density = Callable[[FloatArray, FloatArray], FloatArray]


def energy_matrix(
    patches: PatchTable,
    control_points: FloatArray,  # (n, 3) float64
    density: Density,
    order: int,  # Gauss nodes along each parameter of a piece
) -> sparse.csr_array:
    """Integrate an energy over a surface. Returns a symmetric (n, n) CSR array of float64."""
    from scipy import sparse

    controls, stencils = patches.control_rows()
    table, refinement = patches.evaluated, None if stencils is None else stencils.matrix
    points = control_points if refinement is None else refinement @ control_points
    total = sparse.csr_array((len(points), len(points)))
    for patch_class in counted(table.classes, "Energies of patch classes"):
        class_controls = table.controls_of(patch_class, controls).astype(np.int32)
        basis, weights = _basis_derivatives(table.scheme, patch_class.signature, density, order)
        run_length = max(1, CHUNK // (3 * basis[0].size))
        for entries in np.split(class_controls, range(run_length, len(class_controls), run_length)):
            relative = points[entries] - points[entries[:, :1]]
            factors = density(basis, basis[:, None] @ relative) * np.sqrt(weights)[:, None, None]
            factors = factors.reshape(len(entries), -1, entries.shape[1])
            local = factors.swapaxes(1, 2) @ factors
            rows = np.repeat(entries, entries.shape[1], axis=1).ravel()
            columns = np.tile(entries, (1, entries.shape[1])).ravel()
            total = total + sparse.coo_array((local.ravel(), (rows, columns)), shape=total.shape).tocsr()
    if refinement is not None:
        total = refinement.T @ total @ refinement
    return sparse.csr_array((total + total.T) / 2)


def _basis_derivatives(
    scheme: Scheme, signature: Signature, density: Density, order: int
) -> tuple[FloatArray, FloatArray]:
    """Derivatives ``(5, S, K)`` of a patch's basis functions at the nodes of all pieces, and weights ``(S,)``.

    Derivatives are by the parameters of each piece, as integrals over the surface do not depend on parameters.
    """
    form, (element,) = polynomial_basis(scheme), patch_trees(scheme, [signature])
    coefficients = [element.coefficients(form.of_controls)]
    for tip in element.tips:
        for level in range(_level_count(tip.irregular_patch, density)):
            # The first eigenfunction is constant, and has no derivatives.
            coefficients.append(level_rows(tip.irregular_patch, level)[:, :, 1:] @ tip.coordinates[1:])
    uv, weights = form.bernstein.domain.quadrature(order)
    joined = np.concatenate(coefficients)
    derivatives = (form.bernstein.values(uv) @ form.bernstein.two_derivatives)[:, None] @ joined[None]
    return derivatives.reshape(5, -1, joined.shape[2]), np.tile(weights, len(joined))


def _level_count(patch: IrregularPatch, density: Density) -> int:
    """Number of levels around an extraordinary point over which an energy is summed.

    From level to level, areas, and the energy of first derivatives, scale with the product of the second and third
    eigenvalues; second derivatives at most with the fourth over the square of the third. Where these are not square
    integrable, as they are at smooth vertices [Reif and Schröder 2001], only the first level is summed.
    """
    _, second, third, fourth, *_ = patch.basis.moduli
    ratio = second * third if density is gradients else (fourth / third**2) ** 2 * second * third
    # Up to rounding: at one, every level has the same energy.
    return min(int(np.ceil(np.log(TAIL) / np.log(ratio))), MOST_LEVELS) if ratio < 1 - CLUSTER_WIDTH else 1


def gradients(basis: FloatArray, points: FloatArray) -> FloatArray:
    """`Density` of the Dirichlet energy: ``(P, S, 2, K)`` gradients of basis functions in an orthonormal frame."""
    (a, b, c), area = _frames(points)
    root = np.sqrt(area)
    return np.stack([_sum([a * root, 0 * a], basis[:2]), _sum([b * root, c * root], basis[:2])], axis=2)


def hessians(basis: FloatArray, points: FloatArray) -> FloatArray:
    """`Density` of the bending energy: ``(P, S, 3, K)`` covariant Hessians of basis functions in an orthonormal frame.

    Entries 11, 12, times the square root of two as it occurs twice, and 22. Christoffel symbols are the tangential
    components of the second derivatives of the points.
    """
    (a, b, c), area = _frames(points)
    du, dv = points[:2]
    second = points[2:]
    # Components along the frame, then along the derivatives by u and v.
    along_first = np.einsum("dpsx,psx->dps", second, a[..., None] * du)
    along_second = np.einsum("dpsx,psx->dps", second, b[..., None] * du + c[..., None] * dv)
    by_u, by_v = along_first * a + along_second * b, along_second * c
    root = np.sqrt(area)
    entries = (
        root * np.stack([a * a, 0 * a, 0 * a]),
        root * np.sqrt(2) * np.stack([a * b, a * c, 0 * a]),
        root * np.stack([b * b, 2 * b * c, c * c]),
    )
    tangential = ((-(entry * by_u).sum(axis=0), -(entry * by_v).sum(axis=0)) for entry in entries)
    return np.stack([_sum([*of_first, *e], basis) for of_first, e in zip(tangential, entries, strict=True)], axis=2)


def _sum(factors: Sequence[FloatArray], weights: FloatArray) -> FloatArray:
    """``(P, S, K)`` sum of factors ``(P, S)`` times weights ``(S, K)``."""
    return (np.stack(factors).T @ weights.swapaxes(0, 1)).swapaxes(0, 1)


def _frames(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``(3, P, S)`` a, b, c of orthonormal tangents a du, b du + c dv; area elements ``(P, S)``. Zero without area."""
    du, dv = points[:2]
    area = np.linalg.norm(np.cross(du, dv), axis=-1)
    length = np.linalg.norm(du, axis=-1)
    has_area = area > 0
    safe_length, safe_area = np.where(has_area, length, 1), np.where(has_area, area, 1)
    inner = np.einsum("psx,psx->ps", du, dv)
    return has_area * np.stack([1 / safe_length, -inner / (safe_length * safe_area), safe_length / safe_area]), area
