"""Elements divided completely: trees of parts, down to regular pieces and tips.

`occupied_pieces` divides an element where samples lie. Where these are not known, as in kernels, or where a bound or an
integral is over all of it, the whole element is divided. An extraordinary point has no last piece. Its *tip* is the
part of the element around it, which consists of three regular pieces at every level (`tip_levels`).

A semi-sharp crease has thousands of parts along it, but few kinds: parts whose one-rings have the same signature are
divided alike. So each signature is one `DividedElement`, refined once, whatever elements it is part of. What comes of
all these is refined together, depth by depth. Arrays over the parts of an element are put together from those of its
children.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..schemes.domain import IDENTITY, AffineMap, FloatArray, ParameterDomain
from ..schemes.scheme import Scheme, SchemeError
from .irregular_patch import IrregularPatch, irregular_patch
from .occupied_pieces import MOST_SEMI_SHARP_REFINEMENTS, not_isolated, steady_refinements
from .patch_pieces import MAX_REFINEMENTS, Piece, whole_piece
from .refined_element import RefinedElement

if TYPE_CHECKING:
    from .ring_mesh import RingMesh

# After so many refinements an element consists of pieces and tips.
MOST_DEPTH = MOST_SEMI_SHARP_REFINEMENTS + MAX_REFINEMENTS + 1


class PartKind(IntEnum):
    """What a part of an element is: divided into four, turned or cut out of a polygon only, a regular piece, a tip."""

    DIVIDED = 0
    ONLY_CHILD = 1
    REGULAR = 2
    TIP = 3


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


class ChildCopy(NamedTuple):
    """Where a child lies in its parent's domain.

    Attributes
    ----------
    number : int
        Which of the children of a `RefinedElement` it is.
    turn : int
        As in `DividedElement.turns`.
    into, domain : AffineMap
        From its parent's parameters to its own, and from its own to its parent's.
    """

    number: int
    turn: int
    into: AffineMap
    domain: AffineMap


class Child(NamedTuple):
    """A child of an element, and its control points over those of its parent, ``(K_child, K)`` float64."""

    element: DividedElement
    stencils: FloatArray


class DividedElement:
    """An element of a signature, and all its parts: n of them.

    The first part is the element itself. Children come after their parents, and those of one parent follow each other.

    Attributes
    ----------
    signature : Signature
    control_count : int
        K, of the element's one-ring.
    piece : Piece or None
        The element, if it needs no division.
    copies : tuple of ChildCopy
        Where its children lie, in the order of `ParameterDomain.children`; one, which covers all of it; or none, for a
        piece, and before the element has been divided.
    """

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self.signature, self.control_count = signature, one_ring(signature.smoothed).vertex_count
        self.piece = whole_piece(scheme, signature)
        self.copies: tuple[ChildCopy, ...] = ()
        self._scheme = scheme
        # Refined with less sharpness, and with how much less.
        self._refined: tuple[RefinedElement, int] | None = None
        self._children: dict[int, Child] = {}

    def take(self, refined: RefinedElement, steady: int) -> None:
        """Take for its own children those of an element that is less sharp by ``steady``, and sharpen them again."""
        self._refined = refined, steady
        self.copies = _placed(self._scheme, refined.matrices.tobytes(), refined.offsets.tobytes())

    def child(self, place: int) -> Child:
        """The child in one of `copies`; made when it is first asked for."""
        if place not in self._children:
            if self._refined is None:
                raise ValueError(f"a {self.signature.kind} with fans {self.signature.fans}; expected a divided one")
            refined, steady = self._refined
            signature, stencils = refined.child(self.copies[place].number)
            self._children[place] = Child(element_of(self._scheme, signature.sharpened(steady)), stencils)
        return self._children[place]

    @property
    def children_below(self) -> list[tuple[Child, ChildCopy]]:
        """All children, in the order of `copies`."""
        return [(self.child(place), copy) for place, copy in enumerate(self.copies)]

    @property
    def own_piece(self) -> Piece:
        """`piece`, of an element that is one."""
        if self.piece is None:
            raise ValueError(f"a {self.signature.kind} with fans {self.signature.fans}; expected a piece")
        return self.piece

    @property
    def kinds(self) -> IntArray:
        """``(n,)`` `PartKind` of each part."""
        return self._parts.kinds

    @property
    def turns(self) -> IntArray:
        """``(n,)`` how a part's parameters follow from those of the copy of its parent's domain that it covers.

        They do by `ParameterDomain.rotation` of this.
        """
        return self._parts.turns

    @property
    def children(self) -> IntArray:
        """``(n,)`` number of a part's first child, after which come the others; -1 for pieces and tips.

        Four are the copies of the part's domain, in the order of `ParameterDomain.children`. One covers all of it.
        """
        return self._parts.children

    @property
    def leaf(self) -> IntArray:
        """``(n,)`` for a regular piece its row of `controls`; for a tip its place in `tips`; else -1."""
        return self._parts.leaf

    @property
    def regular_count(self) -> int:
        """How many regular pieces there are."""
        return self._parts.regular_count

    @cached_property
    def domains(self) -> tuple[FloatArray, FloatArray]:
        """``(n, 2, 2)`` matrices and ``(n, 2)`` offsets: maps from a part's parameters to those of the element.

        The parameters of a tip have the extraordinary point at (0, 0).
        """
        if self.piece is not None:
            whole = self.piece.domain.inverse() if self.piece.irregular is not None else IDENTITY
            return whole.matrix[None], whole.offset[None]
        matrices, offsets = [IDENTITY.matrix[None]], [IDENTITY.offset[None]]
        for child, copy in self.children_below:
            inner_matrices, inner_offsets = child.element.domains
            matrices.append(copy.domain.matrix @ inner_matrices)
            offsets.append(inner_offsets @ copy.domain.matrix.T + copy.domain.offset)
        order = self._parts.order
        return np.concatenate(matrices)[order], np.concatenate(offsets)[order]

    @cached_property
    def tips(self) -> tuple[ElementTip, ...]:
        """All tips."""
        if self.piece is None:
            below = [(tip, child.stencils) for child, _ in self.children_below for tip in child.element.tips]
            return tuple(ElementTip(tip.patch, tip.coordinates @ stencils) for tip, stencils in below)
        if self.piece.irregular is None:
            return ()
        patch = irregular_patch(self._scheme, self.piece.irregular)
        return (ElementTip(patch, patch.basis.inverse @ self.piece.stencils),)

    @property
    def controls(self) -> FloatArray:
        """``(r, R, K)`` control points of regular pieces over the element's one-ring; R as the scheme's lattice."""
        return self.coefficients(np.eye(len(self._scheme.regular_lattice)))

    def coefficients(
        self,
        form: FloatArray,
        dtype: DTypeLike = np.float64,
        known: dict[DividedElement, FloatArray] | None = None,
    ) -> NDArray[np.floating]:
        """Coefficients of regular pieces over the element's one-ring.

        Parameters
        ----------
        form : (m, R) float64
            Makes a piece's coefficients of its control points, in the order of the scheme's lattice.
        dtype : float64 or float32
            Of the result; sums are float64.
        known : dict, optional
            Those of elements below, by the same form: the same dictionary for all elements of a cage saves half of the
            time. Else nothing is kept, as these are by far the largest arrays.

        Returns
        -------
        (r, m, K)
        """
        known = {} if known is None else known
        found = np.empty((self._parts.regular_count, len(form), self.control_count), dtype=dtype)
        if self.piece is not None:
            found[:] = form @ self.piece.stencils if len(found) else 0
            return found
        end = 0
        for child, _ in self.children_below:
            if child.element not in known:
                known[child.element] = child.element.coefficients(form, np.float64, known)
            rows = known[child.element]
            begin, end = end, end + len(rows)
            # Piece by piece, so that BLAS starts no threads: these would take longer to wait for each other.
            np.matmul(rows, child.stencils, out=found[begin:end], casting="same_kind")
        return found

    @cached_property
    def _parts(self) -> _Parts:
        if self.piece is None:
            return _Parts.above(
                [(child.element._parts, copy.turn) for child, copy in self.children_below], self._scheme.domain
            )
        if self.piece.irregular is None:
            return _Parts.leaf_of(PartKind.REGULAR, 0)
        return _Parts.leaf_of(PartKind.TIP, _turn_of(self._scheme.domain, self.piece))


class _Parts(NamedTuple):
    """Arrays over the parts of an element, as `DividedElement` has them.

    Attributes
    ----------
    kinds, turns, children, leaf : (n,) int64
    depths : (n,) uint8
    order : (n,) int64
        Of the element, followed by all parts of one child, all parts of the next, and so on: which of these each is.
    regular_count, tip_count : int
    """

    kinds: IntArray
    turns: IntArray
    children: IntArray
    leaf: IntArray
    depths: NDArray[np.uint8]
    order: IntArray
    regular_count: int
    tip_count: int

    @classmethod
    def leaf_of(cls, kind: PartKind, turn: int) -> _Parts:
        """A part that needs no division."""
        is_tip = kind == PartKind.TIP
        kinds, turns, children, leaf, order = np.array([kind, turn, -1, 0, 0]).reshape(-1, 1)
        return cls(kinds, turns, children, leaf, np.zeros(1, dtype=np.uint8), order, int(not is_tip), int(is_tip))

    @classmethod
    def above(cls, below: list[tuple[_Parts, int]], domain: ParameterDomain) -> _Parts:
        """The parts of an element with these children, each turned by so much."""
        kind = PartKind.ONLY_CHILD if len(below) == 1 else PartKind.DIVIDED
        columns = [np.array([kind, 0, 1, -1]).reshape(-1, 1)]
        depths = [np.zeros(1, dtype=np.uint8)]
        first = 1 + ragged.starts(np.array([len(parts.kinds) for parts, _ in below]))
        regular_count = tip_count = 0
        for (parts, turn), begin in zip(below, first.tolist(), strict=True):
            turns = parts.turns.copy()
            turns[0] = (turns[0] + turn) % domain.corner_count
            children = np.where(parts.children < 0, -1, parts.children + begin)
            leaf = parts.leaf + np.array([0, 0, regular_count, tip_count])[parts.kinds]
            columns.append(np.stack([parts.kinds, turns, children, leaf]))
            depths.append(parts.depths + np.uint8(1))
            regular_count += parts.regular_count
            tip_count += parts.tip_count
        # By depth, so that siblings follow each other.
        all_depths = np.concatenate(depths)
        order = np.argsort(all_depths, kind="stable")
        number = np.empty_like(order)
        number[order] = np.arange(len(order))
        kinds, turns, children, leaf = np.concatenate(columns, axis=1)[:, order]
        children = np.where(children < 0, -1, number[children])
        return cls(kinds, turns, children, leaf, all_depths[order], order, regular_count, tip_count)


def divided_elements(scheme: Scheme, signatures: Iterable[Signature]) -> list[DividedElement]:
    """Elements of some signatures, divided completely; equal ones are the same object.

    Raises
    ------
    SchemeError
        If refinement does not separate the irregularities of a one-ring, or the scheme divides domains in a way of its
        own.
    """
    elements = [element_of(scheme, signature) for signature in signatures]
    undivided = list(dict.fromkeys(elements))
    mesh: RingMesh | None = None
    for _ in range(MOST_DEPTH + 1):
        mesh = divide_once(scheme, undivided, mesh)
        undivided = list(dict.fromkeys(child.element for element in undivided for child, _ in element.children_below))
        if not undivided:
            return elements
    raise not_isolated(scheme, undivided[0].signature, MOST_DEPTH + 1)


# As many as a cage with some hundred classes of semi-sharp one-rings has, some times over.
@lru_cache(maxsize=8192)
def element_of(scheme: Scheme, signature: Signature) -> DividedElement:
    """The element of a signature, which may not have been divided; the same object whenever it is asked for."""
    return DividedElement(scheme, signature)


def divide_once(scheme: Scheme, elements: list[DividedElement], mesh: RingMesh | None) -> RingMesh | None:
    """Divide those of some elements that are no pieces, and have not been divided; all are refined together.

    Parameters
    ----------
    mesh : RingMesh or None
        What was returned before, as in `refined_together`.

    Raises
    ------
    SchemeError
        If the scheme divides domains in a way of its own.
    """
    from .ring_mesh import refined_together

    new = [element for element in elements if element.piece is None and not element.copies]
    steady = [steady_refinements(scheme, element.signature) for element in new]
    lowered = [element.signature.sharpened(-by) for element, by in zip(new, steady, strict=True)]
    refined, mesh = refined_together(scheme, lowered, mesh)
    for element, by, own in zip(new, steady, refined, strict=True):
        element.take(own, by)
    return mesh


@lru_cache(maxsize=64)
def _placed(scheme: Scheme, matrices: bytes, offsets: bytes) -> tuple[ChildCopy, ...]:
    """Which child covers each copy of the domain, and how.

    Parameters
    ----------
    matrices, offsets : bytes
        Of `RefinedElement.matrices` and `RefinedElement.offsets`.
    """
    maps = zip(np.frombuffer(matrices).reshape(-1, 2, 2), np.frombuffer(offsets).reshape(-1, 2), strict=True)
    inner = [AffineMap(matrix, offset) for matrix, offset in maps]
    copies = (IDENTITY,) if len(inner) == 1 else scheme.domain.children
    found = [(*_copy_of(scheme, copies, each), number) for number, each in enumerate(inner)]
    return tuple(ChildCopy(number, turn, inner[number], inner[number].inverse()) for _, turn, number in sorted(found))


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
