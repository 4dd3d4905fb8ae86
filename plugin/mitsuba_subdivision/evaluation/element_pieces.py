"""All pieces of an element in Bernstein form: for bounds, integrals and searches over the whole of it.

Regular pieces have their coefficients over the element's one-ring. An extraordinary point has no last piece. Its *tip*
is the part of the element around it, which consists of three regular pieces at every level; `ElementTip` gives the
pieces of any level, and bounds what lies beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..schemes.domain import IDENTITY, AffineMap, FloatArray
from ..schemes.scheme import Scheme, SchemeError
from .bernstein import regular_bernstein
from .eigenbasis import Eigenbasis
from .equations import times_powers
from .irregular_patch import IrregularPatch, irregular_patch
from .occupied_pieces import MOST_SEMI_SHARP_REFINEMENTS
from .patch_pieces import MAX_REFINEMENTS, whole_piece
from .refined_element import refined_element

# Powers of a Jordan block grow before they shrink. Eigenvalues of blocks are at most a half, times some rounding: after
# so many levels the powers are below all before.
GROWING_LEVELS = 16


@dataclass(frozen=True, eq=False)
class ElementTip:
    """The part of an element around an extraordinary point.

    Attributes
    ----------
    patch : IrregularPatch
    coordinates : (K, K_e) float64
        The patch's eigen-coordinates over the element's one-ring.
    domain : AffineMap
        From the tip's parameters, with the point at (0, 0), to those of the element.
    """

    patch: IrregularPatch
    coordinates: FloatArray
    domain: AffineMap


@dataclass(frozen=True, eq=False)
class ElementPieces:
    """The pieces of an element.

    Attributes
    ----------
    rows : (q, b, K_e) float64
        Bernstein coefficients of the regular pieces over the element's one-ring.
    domains : tuple of q AffineMap
        From the parameters of each to those of the element.
    tips : tuple of ElementTip
    """

    rows: FloatArray
    domains: tuple[AffineMap, ...]
    tips: tuple[ElementTip, ...]


@lru_cache(maxsize=1024)
def element_pieces(scheme: Scheme, signature: Signature) -> ElementPieces:
    """Divide an element of a signature completely.

    Raises
    ------
    SchemeError
        If refinement does not separate the irregularities of the one-ring, or the scheme's regular patches are no
        polynomials.
    """
    of_controls = regular_bernstein(scheme).of_controls
    rows, domains, tips = [], [], []
    parts = [(IDENTITY, signature, np.eye(one_ring(signature).vertex_count))]
    for _ in range(MOST_SEMI_SHARP_REFINEMENTS + MAX_REFINEMENTS + 1):
        divided = []
        for domain, part, over in parts:
            piece = whole_piece(scheme, part)
            if piece is None:
                element = refined_element(scheme, part)
                for number, inner in enumerate(element.domains):
                    child, stencils = element.child(number)
                    divided.append((inner @ domain, child, stencils @ over))
                continue
            own, controls = (piece.domain @ domain).inverse(), piece.stencils @ over
            if piece.irregular is None:
                rows.append(of_controls @ controls)
                domains.append(own)
            else:
                patch = irregular_patch(scheme, piece.irregular)
                tips.append(ElementTip(patch, patch.basis.inverse @ controls, own))
        parts = divided
    if parts:
        raise SchemeError(
            f"{scheme.name}: refinement leaves a {parts[0][1].kind} with fans {parts[0][1].fans} neither regular nor "
            "self-similar; expected a scheme that isolates extraordinary points"
        )
    none = np.empty((0, len(of_controls), one_ring(signature).vertex_count))
    return ElementPieces(np.concatenate([none, *(each[None] for each in rows)]), tuple(domains), tuple(tips))


@lru_cache(maxsize=4096)
def level_rows(patch: IrregularPatch, level: int) -> FloatArray:
    """``(3, b, K)`` Bernstein coefficients of a level's regular pieces over the eigen-coordinates, read-only."""
    rows = _rows(patch)
    flat = rows.reshape(1, -1, rows.shape[2])
    found = times_powers(flat, np.full(flat.shape[1], level), patch.basis, 1.0).reshape(rows.shape)
    found.flags.writeable = False
    return found


def level_domains(patch: IrregularPatch, level: int) -> list[AffineMap]:
    """From the parameters of each of a level's regular pieces to those of the tip."""
    shrunk = AffineMap(np.eye(2) * 2.0**-level, np.zeros(2))
    return [shrunk @ child.inverse() for child in patch.scheme.domain.children[1:]]


def level_at_size(patch: IrregularPatch, size: float) -> int:
    """The first level at which the second eigenvalue has shrunk the tip to a size, in sizes of the patch."""
    return int(np.ceil(np.log(size) / np.log(patch.basis.subdominant)))


@lru_cache(maxsize=4096)
def rest_rows(patch: IrregularPatch, level: int) -> FloatArray:
    """How far the surface is from the extraordinary point at a level and all later ones, at most.

    The point is ``ĉ_1``, and a piece of level n has the Bernstein coefficients ``Σ_i φ_i λ_iⁿ ĉ_i``. So in each
    coordinate it is within ``max_k Σ_{i ≥ 2} |φ_ki| |λ_i|ⁿ |ĉ_i|`` of the point, for weights of any sign.

    Returns
    -------
    (r, K) float64, read-only
        Times the absolute eigen-coordinates; the largest of the r sums is the bound.
    """
    rows = np.abs(_rows(patch)).reshape(-1, len(patch.basis.eigenvalues))
    # Where one row is nowhere above another, it is never the largest.
    found = np.unique(rows @ _largest_powers(patch.basis, level), axis=0)
    found.flags.writeable = False
    return found


def _rows(patch: IrregularPatch) -> FloatArray:
    return regular_bernstein(patch.scheme).of_controls @ patch.eigen_children


def _largest_powers(basis: Eigenbasis, level: int) -> FloatArray:
    """``(K, K)`` largest entries of ``|Tⁿ|`` at a level and all later ones, without the first eigenvalue."""
    powers = np.diag(basis.moduli**level)
    for place, block in basis.blocks:
        first = np.linalg.matrix_power(block, level)
        largest = np.abs(first)
        for _ in range(GROWING_LEVELS):
            first = first @ block
            largest = np.maximum(largest, np.abs(first))
        powers[place, place] = largest
    powers[0, 0] = 0
    return powers
