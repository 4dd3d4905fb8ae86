"""Quadratic energies of a surface as sparse matrices over control points: Dirichlet's, and that of bending.

Every function on the surface that is subdivided as points are is a sum of basis functions, one for each control point.
An energy that is quadratic in such a function is a symmetric matrix. It is summed class by class: derivatives of the
basis functions at the nodes of a Gauss rule on every polynomial piece are weights that all patches of a class share;
each patch has its own metric.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from ..evaluation.irregular_patch import IrregularPatch, level_rows
from ..evaluation.patch_tree import patch_trees
from ..evaluation.polynomials import regular_bernstein
from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..progress import counted
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .patch_table import PatchTable

if TYPE_CHECKING:
    from scipy import sparse

# Around extraordinary points levels are summed until those left hold this part of the energy there, or less, where it
# falls from level to level by the eigenvalues; but no more levels than this.
TAIL, MOST_LEVELS = 2.0**-20, 64
# Patches and nodes are processed in runs of about this many numbers, which bounds temporary memory.
CHUNK = 1 << 21
# The derivatives whose squares an energy integrates.
FIRST, SECOND = 1, 2

# From derivatives of the basis functions (5, S, K), by u, v, uu, uv and vv, and those of points (5, P, S, 3), to
# (P, S, m, K): m derivatives of the basis functions along the surface, times the root of the area element.
Density = Callable[[FloatArray, FloatArray], FloatArray]


def energy_matrix(
    patches: PatchTable,
    control_of_vertex: IntArray,  # (n_v,) int64: 0-based control point at each mesh vertex
    control_points: FloatArray,  # (n, 3) float64: of the surface
    density: Density,
    order: int,  # Gauss nodes along each parameter of a piece
) -> sparse.csr_array:
    """Sum an energy over a surface. Returns (n, n) CSR array of float64: symmetric."""
    from scipy import sparse

    controls, refinement = patches.control_rows(control_of_vertex, len(control_points))
    table = patches if patches.refined is None else patches.refined.table
    points = control_points if refinement is None else refinement @ control_points
    total = sparse.csr_array((len(points), len(points)))
    derivative = FIRST if density is gradients else SECOND
    for patch_class in counted(table.classes, "Energies of patch classes"):
        first, shape = patch_class.first_control, patch_class.controls.shape
        own = controls[first : first + patch_class.controls.size].reshape(shape[::-1]).T
        for chosen, local in _of_class(table.scheme, patch_class.signature, points[own], density, derivative, order):
            entries = own[chosen].astype(np.int32)
            rows = np.repeat(entries, entries.shape[1], axis=1).ravel()
            columns = np.tile(entries, (1, entries.shape[1])).ravel()
            total = total + sparse.coo_array((local.ravel(), (rows, columns)), shape=total.shape).tocsr()
    if refinement is not None:
        total = refinement.T @ total @ refinement
    return sparse.csr_array((total + total.T) / 2)


def _of_class(
    scheme: Scheme, signature: Signature, points: FloatArray, density: Density, derivative: int, order: int
) -> Iterator[tuple[slice, FloatArray]]:
    """Matrices ``(p, K, K)`` of some patches of a class after another; the sums of those of a patch are its own."""
    basis, weights = _basis_derivatives(scheme, signature, derivative, order)
    places, controls = basis.shape[1:]
    run = max(1, CHUNK // (3 * controls * min(places, controls)))
    for begin in range(0, len(points), run):
        chosen = slice(begin, begin + run)
        relative = points[chosen] - points[chosen, :1]
        local = np.zeros((len(relative), controls, controls))
        step = max(1, CHUNK // (3 * controls * len(relative)))
        for place in range(0, places, step):
            at = slice(place, place + step)
            of_points = basis[:, None, at] @ relative[None]
            factors = density(basis[:, at], of_points) * np.sqrt(weights[at])[:, None, None]
            factors = factors.reshape(len(relative), -1, controls)
            local += factors.swapaxes(1, 2) @ factors
        yield chosen, local


def _basis_derivatives(
    scheme: Scheme, signature: Signature, derivative: int, order: int
) -> tuple[FloatArray, FloatArray]:
    """Derivatives ``(5, S, K)`` of a patch's basis functions at the nodes of all pieces, and weights ``(S,)``.

    They are by the parameters of the pieces. Integrals over the surface do not depend on parameters.
    """
    form, (element,) = regular_bernstein(scheme), patch_trees(scheme, [signature])
    coefficients = [element.coefficients(form.of_controls)]
    for tip in element.tips:
        for level in range(_level_count(tip.irregular_patch, derivative)):
            # The first eigen-coordinate is a point, whose weights are constant.
            coefficients.append(level_rows(tip.irregular_patch, level)[:, :, 1:] @ tip.coordinates[1:])
    uv, weights = form.basis.domain.quadrature(order)
    joined = np.concatenate(coefficients)
    found = (form.basis.values(uv) @ form.basis.two_derivatives)[:, None] @ joined[None]
    return found.reshape(5, -1, joined.shape[2]), np.tile(weights, len(joined))


def _level_count(patch: IrregularPatch, derivative: int) -> int:
    """Number of levels that are summed.

    From level to level areas go with the product of the second and third eigenvalue, and so does the energy of first
    derivatives. Second ones go with the fourth eigenvalue over the third one's square, at most. At smooth vertices
    their squares can be integrated [Reif and Schröder 2001]; where they cannot, only the first level is summed.
    """
    _, second, third, fourth, *_ = patch.basis.moduli
    ratio = second * third if derivative == FIRST else (fourth / third**2) ** 2 * second * third
    return min(int(np.ceil(np.log(TAIL) / np.log(ratio))), MOST_LEVELS) if ratio < 1 else 1


def gradients(basis: FloatArray, points: FloatArray) -> FloatArray:
    """Gradients of the basis functions, in an orthonormal frame: ``(P, S, 2, K)``; see `Density`."""
    (a, b, c), area = _frames(points)
    root = np.sqrt(area)
    return np.stack([_sum((a * root, basis[0])), _sum((b * root, basis[0]), (c * root, basis[1]))], axis=2)


def hessians(basis: FloatArray, points: FloatArray) -> FloatArray:
    """Covariant second derivatives of the basis functions, in an orthonormal frame: ``(P, S, 3, K)``; see `Density`.

    Along the first vector; along both, times the root of two; along the second one. So the sum of squares is that of
    all four entries. Christoffel's symbols are the components of the points' own second derivatives along the surface.
    """
    (a, b, c), area = _frames(points)
    du, dv = points[:2]
    second = points[2:]
    # Along the frame, then along the derivatives by u and v.
    along_first = np.einsum("dpsx,psx->dps", second, a[..., None] * du)
    along_second = np.einsum("dpsx,psx->dps", second, b[..., None] * du + c[..., None] * dv)
    by_u, by_v = along_first * a + along_second * b, along_second * c
    root = np.sqrt(area)
    entries = (
        root * np.stack([a * a, 0 * a, 0 * a]),
        root * np.sqrt(2) * np.stack([a * b, a * c, 0 * a]),
        root * np.stack([b * b, 2 * b * c, c * c]),
    )
    found = []
    for entry in entries:
        tangential = ((entry * by_u).sum(axis=0), basis[0]), ((entry * by_v).sum(axis=0), basis[1])
        found.append(_sum(*zip(entry, basis[2:], strict=True)) - _sum(*tangential))
    return np.stack(found, axis=2)


def _sum(*terms: tuple[FloatArray, FloatArray]) -> FloatArray:
    """``(P, S, K)`` sum of factors ``(P, S)`` times weights ``(S, K)``."""
    found = terms[0][0][..., None] * terms[0][1]
    for factor, weights in terms[1:]:
        found += factor[..., None] * weights
    return found


def _frames(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal tangents ``a du`` and ``b du + c dv``: ``(3, P, S)``; and area elements ``(P, S)``.

    All are zero where the surface collapses: there is no area there.
    """
    du, dv = points[:2]
    area = np.linalg.norm(np.cross(du, dv), axis=-1)
    length = np.linalg.norm(du, axis=-1)
    is_there = area > 0
    safe_length, safe_area = np.where(is_there, length, 1), np.where(is_there, area, 1)
    inner = np.einsum("psx,psx->ps", du, dv)
    return is_there * np.stack([1 / safe_length, -inner / (safe_length * safe_area), safe_length / safe_area]), area
