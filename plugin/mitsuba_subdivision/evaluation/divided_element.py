"""Elements divided into pieces: a tree in which equal parts are one node, refined when a part of it is needed.

A *child* is the result of one refinement of an element: one of four copies of its domain, or the whole of it. A *piece*
is a part that needs no further division: a regular patch, or one with a single extraordinary point, its *tip*, which
consists of three regular pieces at every level (`IrregularPatch`).

A semi-sharp crease has thousands of parts along it, but few kinds: parts whose one-rings have the same signature are
divided alike. So each signature is one `DividedElement`, whatever elements it is part of. Evaluation descends to the
children that hold samples (`LocatedSamples`, `sampled_polynomials`); bounds divide parts that are not yet tight
(`divided_tile`); kernels and integrals need all pieces (`piece_tree`, `DividedElement.coefficients`).
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.sharpness import INFINITE
from ..mesh.signature import Signature
from ..schemes.domain import IDENTITY, AffineMap, FloatArray
from ..schemes.scheme import Scheme, SchemeError
from .patch_pieces import MAX_REFINEMENTS, Piece, whole_piece
from .refined_rings import RefinedRing, refined_ring, ring_pattern

# After these refinements nothing is semi-sharp: every refinement takes one from a sharpness, which is below `INFINITE`.
MOST_SEMI_SHARP_REFINEMENTS = int(INFINITE)
# After this many refinements an element consists of pieces.
MOST_DEPTH = MOST_SEMI_SHARP_REFINEMENTS + MAX_REFINEMENTS + 1


class PartKind(IntEnum):
    """Kind of a part of an element: divided into four, cut out of a polygon only, a regular piece, a tip."""

    DIVIDED = 0
    ONLY_CHILD = 1
    REGULAR = 2
    TIP = 3


class DividedElement:
    """An element of a signature, and the parts that it is divided into.

    Attributes
    ----------
    control_count : int
        K, of the element's one-ring.
    """

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self.scheme, self.signature = scheme, signature
        self.control_count = one_ring(signature.smoothed).vertex_count
        self._children: dict[int, DividedElement] = {}
        self._stencils: dict[int, FloatArray] = {}

    @cached_property
    def piece(self) -> Piece | None:
        """The element, if it needs no division."""
        return whole_piece(self.scheme, self.signature)

    @cached_property
    def kind(self) -> PartKind:
        if self.piece is None:
            return PartKind.ONLY_CHILD if len(self.domains) == 1 else PartKind.DIVIDED
        return PartKind.REGULAR if self.piece.patch is None else PartKind.TIP

    @cached_property
    def turn(self) -> int:
        """For a tip, how its own parameters are turned: from the element's by `ParameterDomain.rotation` of this."""
        if self.kind != PartKind.TIP or self.piece is None:
            return 0
        domain = self.scheme.domain
        return next(turn for turn in range(domain.corner_count) if domain.rotation(turn).is_same(self.piece.domain))

    @cached_property
    def domains(self) -> tuple[AffineMap, ...]:
        """From the element's parameters to those of each child: `ParameterDomain.children`, or the identity.

        Raises SchemeError if the scheme divides domains in a way of its own.
        """
        found = ring_pattern(self.scheme, self.signature.smoothed).domains
        expected = (IDENTITY,) if len(found) == 1 else self.scheme.domain.children
        if len(found) != len(expected) or not all(a.is_same(b) for a, b in zip(found, expected, strict=True)):
            raise SchemeError(
                f"{self.scheme.name}: a child's domain is none of {len(expected)} copies, in their order; expected "
                "the four of `ParameterDomain.children`, or the whole domain"
            )
        return expected

    def child(self, number: int) -> tuple[DividedElement, FloatArray]:
        """One of the children, and its control points over those of the element: ``(K_child, K)`` float64."""
        if number not in self._stencils:
            self._stencils[number] = self._ring.stencils(number)
        return self.child_element(number), self._stencils[number]

    def child_element(self, number: int) -> DividedElement:
        """One of the children."""
        if number not in self._children:
            self._children[number] = element_of(self.scheme, self._ring.signature(number))
        return self._children[number]

    @property
    def children(self) -> list[tuple[DividedElement, FloatArray]]:
        """All children, as `child` gives them; none of a piece."""
        return [] if self.piece is not None else [self.child(number) for number in range(len(self.domains))]

    @cached_property
    def child_elements(self) -> list[DividedElement]:
        """All children; none of a piece."""
        return [] if self.piece is not None else [self.child_element(number) for number in range(len(self.domains))]

    @cached_property
    def _ring(self) -> RefinedRing:
        return refined_ring(self.scheme, self.signature)

    @cached_property
    def regular_count(self) -> int:
        """Number of regular pieces."""
        return int(self.kind == PartKind.REGULAR) + sum(child.regular_count for child in self.child_elements)

    @cached_property
    def tip_count(self) -> int:
        """Number of pieces with an extraordinary point."""
        return int(self.kind == PartKind.TIP) + sum(child.tip_count for child in self.child_elements)

    @cached_property
    def tips(self) -> tuple[Piece, ...]:
        """All pieces with an extraordinary point."""
        if self.piece is not None:
            return (self.piece,) if self.piece.patch is not None else ()
        return tuple(
            tip.inside(domain, stencils)
            for domain, (child, stencils) in zip(self.domains, self.children, strict=True)
            for tip in child.tips
        )

    @cached_property
    def regular_domains(self) -> tuple[FloatArray, FloatArray]:
        """``(r, 2, 2)`` matrices and ``(r, 2)`` offsets: from parameters of regular pieces to those of the element."""
        if self.piece is not None:
            return np.eye(2)[None][: self.regular_count], np.zeros((self.regular_count, 2))
        matrices, offsets = [], []
        for domain, child in zip(self.domains, self.child_elements, strict=True):
            outward, (inner_matrices, inner_offsets) = domain.inverse(), child.regular_domains
            matrices.append(outward.matrix @ inner_matrices)
            offsets.append(inner_offsets @ outward.matrix.T + outward.offset)
        return np.concatenate(matrices), np.concatenate(offsets)

    @cached_property
    def nodes(self) -> IntArray:
        """``(n, 3)`` all parts of the element, which comes first: `kind`, `turn`, and the index of the first child.

        The children of a part follow each other. A piece has in place of a child its index among those of its kind, in
        the order of `coefficients` and of `tips`.
        """
        below = self._below + np.array([0, 0, 1]) * (self._below[:, :1] <= PartKind.ONLY_CHILD)
        return np.concatenate([[[self.kind, self.turn, int(self.piece is None)]], below])

    @cached_property
    def _below(self) -> IntArray:
        """`nodes` without the element itself."""
        children = self.child_elements
        rows, below = [np.empty((0, 3), dtype=np.int64)], []
        # By kinds: where the next children, regular pieces and tips come.
        first = np.array([len(children), len(children), 0, 0])
        for child in children:
            rows.append(np.array([[child.kind, child.turn, first[child.kind]]]))
            below.append(child._below + first[child._below[:, :1]] * np.array([0, 0, 1]))
            first += [len(child._below)] * 2 + [child.regular_count, child.tip_count]
        return np.concatenate(rows + below)

    def coefficients(
        self,
        # (m, R) float64: makes a piece's coefficients of its control points, in the order of the scheme's
        # lattice
        form: FloatArray,
        dtype: DTypeLike = np.float64,  # Of the result; sums are float64
        # Coefficients of elements below, by the same form: one dictionary for all elements of a cage saves
        # half of the time. Without it nothing is kept, as these are by far the largest arrays.
        known: dict[DividedElement, FloatArray] | None = None,
    ) -> NDArray[np.floating]:
        """Coefficients of regular pieces over the element's one-ring. Returns (r, m, K)."""
        known = {} if known is None else known
        found = np.empty((self.regular_count, len(form), self.control_count), dtype=dtype)
        if self.piece is not None:
            found[:] = form @ self.piece.stencils if len(found) else 0
            return found
        end = 0
        for number, child in enumerate(self.child_elements):
            if child not in known:
                known[child] = child.coefficients(form, np.float64, known)
            rows = known[child]
            begin, end = end, end + len(rows)
            if len(rows):
                found[begin:end] = rows @ self.child(number)[1]
        return found


# As many as a cage with some hundred classes of semi-sharp one-rings has, some times over.
@lru_cache(maxsize=8192)
def element_of(scheme: Scheme, signature: Signature) -> DividedElement:
    """The element of a signature; each call returns the same object."""
    return DividedElement(scheme, signature)


def divided_elements(scheme: Scheme, signatures: Iterable[Signature]) -> list[DividedElement]:
    """Elements of some signatures, divided completely; equal ones are the same object.

    Raises SchemeError if refinement does not separate the irregularities of a one-ring, or the scheme divides domains
    in a way of its own.
    """
    elements = [element_of(scheme, signature) for signature in signatures]
    undivided = list(dict.fromkeys(elements))
    for _ in range(MOST_DEPTH + 1):
        undivided = list(dict.fromkeys(child for element in undivided for child in element.child_elements))
        if not undivided:
            return elements
    raise not_isolated(scheme, undivided[0].signature, MOST_DEPTH + 1)


def not_isolated(scheme: Scheme, rest: Signature, refinements: int) -> SchemeError:
    """The error if an element of some signature is left after so many refinements."""
    if rest.is_semi_sharp:
        return SchemeError(
            f"{scheme.name}: {refinements} refinements leave something of a {rest.kind} semi-sharp; expected each to "
            "take one from the sharpness"
        )
    return SchemeError(
        f"{scheme.name}: refinement leaves a {rest.kind} with fans {rest.fans} neither regular nor self-similar; "
        "expected a scheme that isolates extraordinary points"
    )
