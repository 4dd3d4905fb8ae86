"""Regular patches over the unit square whose weights are products of one-dimensional ones, as of tensor B-splines."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .patch_pieces import lattice_stencils, regular_signature

# Rounding error of a weight against the product that it equals, and of equal parameters.
SAME = 1e-13


@dataclass(frozen=True, eq=False)
class LatticeRows:
    """Samples of a patch that are the rows of a lattice, u fastest, seen from one of the patch's corners."""

    corner: int
    # (m,), (n,) float64: sample ``j m + i`` has the parameters ``(u[i], v[j])``
    u: FloatArray
    v: FloatArray


@dataclass(frozen=True, eq=False)
class ProductPatch:
    """The regular patch of a scheme whose basis is a product.

    Seen from any corner, the point at (u, v) is the sum over j and i of ``L[0, j](v) L[0, i](u)`` times the control
    point ``lattice_index[corner, j, i]``, with ``L`` from `line_weights`.

    Parameters
    ----------
    lattice_index : (4, r, r) int64
        Control points of the one-ring.
    """

    scheme: Scheme
    lattice_index: IntArray

    def line_weights(self, parameters: FloatArray) -> FloatArray:
        """Values and derivatives of the one-dimensional basis: ``(2, s, r)``."""
        # As weights sum to one along v, sums of products over v are the factors along u.
        rows = self.basis(np.stack([parameters, parameters], axis=1))
        return rows[:2].sum(axis=2)

    def rows(self, uv: FloatArray) -> LatticeRows:
        """Samples ``(s, 2)`` as the rows of a lattice, seen from the corner that makes the rows longest.

        Raises ValueError if the samples are not the rows of a lattice, seen from any corner.
        """
        longest: LatticeRows | None = None
        for corner in range(4):
            rows = self._rows_from(corner, uv)
            if rows is not None and (longest is None or len(rows.u) > len(longest.u)):
                longest = rows
                if len(rows.u) == len(uv):
                    # No row is longer than one of all samples.
                    break
        if longest is None:
            raise ValueError("samples are no rows of a lattice, u fastest, from any corner of the patch")
        return longest

    def _rows_from(self, corner: int, uv: FloatArray) -> LatticeRows | None:
        u, v = self.scheme.domain.rotation(corner).inverse()(uv).T
        length = int(np.argmax(np.append(np.abs(v - v[0]) > SAME, True)))
        if len(u) % length:
            return None
        u, v = u.reshape(-1, length), v.reshape(-1, length)
        if max(np.abs(u - u[0]).max(), np.abs(v - v[:, :1]).max()) > SAME:
            return None
        return LatticeRows(corner, u[0], v[:, 0])

    def basis(self, uv: FloatArray) -> FloatArray:
        """The scheme's own weights, value and derivatives by u and v, seen from corner 0: ``(3, s, r, r)``."""
        count = self.lattice_index.shape[1]
        return self.scheme.regular_basis(uv, 1)[:, :, _lattice_order(self.scheme)].reshape(3, -1, count, count)


@lru_cache(maxsize=64)
def product_patch(scheme: Scheme, signature: Signature) -> ProductPatch | None:
    """The patch of a signature as a product; None if its weights are no products, or the patch is not regular."""
    count = round(len(scheme.regular_lattice) ** 0.5)
    if signature != regular_signature(scheme) or scheme.domain.corner_count != 4:
        return None
    if count**2 != len(scheme.regular_lattice):
        return None
    stencils = lattice_stencils(scheme, signature)
    if stencils is None:
        return None
    lattice = scheme.regular_lattice[_lattice_order(scheme)]
    lattice_index = []
    for corner in range(4):
        seen = scheme.domain.rotation(corner)(lattice)
        at = [np.flatnonzero(np.abs(scheme.regular_lattice - point).max(axis=1) < SAME) for point in seen]
        if any(len(found) != 1 for found in at):
            return None
        lattice_index.append(np.argmax(stencils[np.concatenate(at)], axis=1))
    patch = ProductPatch(scheme, np.array(lattice_index).reshape(4, count, count))
    return patch if _is_product(patch) else None


def _lattice_order(scheme: Scheme) -> IntArray:
    """Order that sorts the lattice row by row, u fastest."""
    return np.lexsort(scheme.regular_lattice.T)


def _is_product(patch: ProductPatch) -> bool:
    """Whether products of `line_weights` equal the scheme's basis, seen from every corner."""
    inside = np.array([(0.1, 0.2), (0.35, 0.85), (0.7, 0.6)])
    along_u, along_v = (patch.line_weights(parameters)[0] for parameters in inside.T)
    products = along_v[:, :, None] * along_u[:, None, :]
    for corner in range(4):
        basis = patch.basis(patch.scheme.domain.rotation(corner)(inside))[0]
        if np.abs(_placed(products, patch.lattice_index[corner]) - _placed(basis, patch.lattice_index[0])).max() > SAME:
            return False
    return True


def _placed(weights: FloatArray, lattice_index: IntArray) -> FloatArray:
    """Weights ``(s, r, r)`` of a lattice's points, in the order of the one-ring's vertices: ``(s, r^2)``."""
    placed = np.zeros((len(weights), lattice_index.size))
    placed[:, lattice_index.ravel()] = weights.reshape(len(weights), -1)
    return placed
