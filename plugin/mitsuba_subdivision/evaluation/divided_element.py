"""Elements divided completely: a tree of parts, down to regular pieces and tips.

`occupied_pieces` divides an element where samples lie. Where these are not known, as in kernels, or where a bound or an
integral is over all of it, the whole element is divided. An extraordinary point has no last piece. Its *tip* is the
part of the element around it, which consists of three regular pieces at every level (`tip_levels`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..schemes.domain import IDENTITY, AffineMap, FloatArray, ParameterDomain
from ..schemes.scheme import Scheme, SchemeError
from .irregular_patch import IrregularPatch, irregular_patch
from .occupied_pieces import MOST_SEMI_SHARP_REFINEMENTS
from .patch_pieces import MAX_REFINEMENTS, Piece, whole_piece
from .refined_element import refined_element


@dataclass(frozen=True, eq=False)
class ElementTip:
    """The part of an element around an extraordinary point.

    Attributes
    ----------
    patch : IrregularPatch
    coordinates : (K_tip, K) float64
        The patch's eigen-coordinates over the element's one-ring.
    """

    patch: IrregularPatch
    coordinates: FloatArray


@dataclass(frozen=True, eq=False)
class Part:
    """A part of an element: divided, a regular piece, or a tip.

    Attributes
    ----------
    turn : int
        How its parameters follow from those of the copy of its parent's domain that it covers:
        `ParameterDomain.rotation` of this.
    domain : AffineMap
        From its parameters, those of a tip with the extraordinary point at (0, 0), to those of the element.
    children : range
        Numbers of the parts that it is divided into: the four copies of its domain, in the order of
        `ParameterDomain.children`; or one, which covers all of it. Pieces and tips have none.
    controls : (R, K) float64 or None
        Of a regular piece: its control points, in the order of the scheme's lattice, over the element's one-ring.
    tip : ElementTip or None
    """

    turn: int
    domain: AffineMap
    children: range = range(0)
    controls: FloatArray | None = None
    tip: ElementTip | None = None


@lru_cache(maxsize=1024)
def divided_element(scheme: Scheme, signature: Signature) -> tuple[Part, ...]:
    """Divide an element of a signature completely. The first part is the element; children come after their parents.

    Raises
    ------
    SchemeError
        If refinement does not separate the irregularities of the one-ring, or the scheme divides domains in a way of
        its own.
    """
    parts: list[Part] = []
    # Children are appended while the loop runs.
    found = [_Found(signature, np.eye(one_ring(signature).vertex_count), 0, IDENTITY, 0)]
    for each in found:
        piece = whole_piece(scheme, each.signature)
        if piece is None:
            children = each.children(scheme)
            parts.append(Part(each.turn, each.domain, range(len(found), len(found) + len(children))))
            found += children
            continue
        controls = piece.stencils @ each.stencils
        if piece.irregular is None:
            parts.append(Part(each.turn, each.domain, controls=controls))
            continue
        turn = (each.turn + _turn_of(scheme.domain, piece)) % scheme.domain.corner_count
        patch = irregular_patch(scheme, piece.irregular)
        tip = ElementTip(patch, patch.basis.inverse @ controls)
        parts.append(Part(turn, each.domain @ piece.domain.inverse(), tip=tip))
    return tuple(parts)


@dataclass(frozen=True, eq=False)
class _Found:
    """What becomes a part.

    Attributes
    ----------
    signature : Signature
    stencils : (K_part, K) float64
        Its control points over those of the element.
    turn, domain
        As in `Part`.
    depth : int
    """

    signature: Signature
    stencils: FloatArray
    turn: int
    domain: AffineMap
    depth: int

    def children(self, scheme: Scheme) -> list[_Found]:
        if self.depth > MOST_SEMI_SHARP_REFINEMENTS + MAX_REFINEMENTS:
            raise SchemeError(
                f"{scheme.name}: refinement leaves a {self.signature.kind} with fans {self.signature.fans} "
                "neither regular nor self-similar; expected a scheme that isolates extraordinary points"
            )
        element = refined_element(scheme, self.signature)
        copies = (IDENTITY,) if len(element.domains) == 1 else scheme.domain.children
        found: dict[int, _Found] = {}
        for number, inner in enumerate(element.domains):
            copy, turn = _copy_of(scheme, copies, inner)
            child, stencils = element.child(number)
            domain = self.domain @ inner.inverse()
            found[copy] = _Found(child, stencils @ self.stencils, turn, domain, self.depth + 1)
        return [found[copy] for copy in range(len(copies))]


def _turn_of(domain: ParameterDomain, piece: Piece) -> int:
    """The turn that leads to a whole piece's own parameters."""
    return next(turn for turn in range(domain.corner_count) if domain.rotation(turn).is_same(piece.domain))


def _copy_of(scheme: Scheme, copies: tuple[AffineMap, ...], inner: AffineMap) -> tuple[int, int]:
    """In which copy of the domain a child lies, and how it is turned there."""
    for turn in range(scheme.domain.corner_count):
        rotation = scheme.domain.rotation(turn)
        for number, copy in enumerate(copies):
            if (rotation @ copy).is_same(inner):
                return number, turn
    raise SchemeError(f"{scheme.name}: a child's domain is none of {len(copies)} copies; expected one, maybe turned")
