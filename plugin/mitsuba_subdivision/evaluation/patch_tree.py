"""Patch trees: elements divided into regular and self-similar pieces, found by running the rules.

A *child* is the result of one refinement of an element: one of four copies of its domain, or the whole of it. A *piece*
is a part that needs no further division: a regular patch, or one with a single extraordinary point, its *tip*, which
consists of three regular pieces at every level (`IrregularPatch`).

A semi-sharp crease has thousands of parts along it, but few kinds: parts whose one-rings have the same signature are
divided alike. So each signature is one `PatchTree`, whatever elements it is part of, and it is divided when a part of
it is needed. Samples descend to the leaves that they lie in (`located_samples`); bounds divide parts that are not yet
tight (`divided_tile`); kernels and integrals need all pieces (`tree_arrays`, `PatchTree.coefficients`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import IntArray, VertexRule
from ..mesh.one_ring import one_ring
from ..mesh.sharpness import INFINITE
from ..mesh.signature import Fan, Signature, TaggedFan
from ..schemes.domain import IDENTITY, AffineMap, FloatArray
from ..schemes.scheme import Scheme, SchemeError
from .irregular_patch import IrregularPatch, IrregularStructure, irregular_patch
from .refined_rings import RefinedRing, refined_ring, ring_pattern

# An element without semi-sharp features consists of regular and self-similar pieces after this many refinements, or its
# scheme is refused: the rules keep making new extraordinary points. The schemes of this package need one or two.
MAX_REFINEMENTS = 6
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


class PatchTree:
    """An element of a signature, and the parts that it is divided into.

    Attributes
    ----------
    control_count : int
        K, of the element's one-ring.
    """

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self.scheme, self.signature = scheme, signature
        self.control_count = one_ring(signature.smoothed).vertex_count
        self._children: dict[int, PatchTree] = {}
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

    def child(self, number: int) -> tuple[PatchTree, FloatArray]:
        """One of the children, and its control points over those of the element: ``(K_child, K)`` float64."""
        if number not in self._stencils:
            self._stencils[number] = self._ring.stencils(number)
        return self.child_element(number), self._stencils[number]

    def child_element(self, number: int) -> PatchTree:
        """One of the children."""
        if number not in self._children:
            self._children[number] = patch_tree(self.scheme, self._ring.signature(number))
        return self._children[number]

    @property
    def children(self) -> list[tuple[PatchTree, FloatArray]]:
        """All children, as `child` gives them; none of a piece."""
        return [] if self.piece is not None else [self.child(number) for number in range(len(self.domains))]

    @cached_property
    def child_elements(self) -> list[PatchTree]:
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
        known: dict[PatchTree, FloatArray] | None = None,
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
def patch_tree(scheme: Scheme, signature: Signature) -> PatchTree:
    """The element of a signature; each call returns the same object."""
    return PatchTree(scheme, signature)


def patch_trees(scheme: Scheme, signatures: Iterable[Signature]) -> list[PatchTree]:
    """Elements of some signatures, divided completely; equal ones are the same object.

    Raises SchemeError if refinement does not separate the irregularities of a one-ring, or the scheme divides domains
    in a way of its own.
    """
    elements = [patch_tree(scheme, signature) for signature in signatures]
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


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of an element that needs no further division: a regular patch, or one with an extraordinary point."""

    domain: AffineMap  # From the element's parameters to the piece's own, which have the extraordinary point at (0, 0)
    stencils: FloatArray  # (K_piece, K) float64: the piece's control points over the element's one-ring
    # None for a regular piece, whose control points are in the order of the scheme's lattice
    patch: IrregularPatch | None

    @property
    def irregular_patch(self) -> IrregularPatch:
        """The patch of an irregular piece."""
        if self.patch is None:
            raise ValueError("a regular piece; expected one with an extraordinary point")
        return self.patch

    @cached_property
    def absolute_sums(self) -> FloatArray:
        """``(K_piece,)`` sums of the absolute weights of each control point."""
        return np.abs(self.stencils).sum(axis=1)

    @cached_property
    def coordinates(self) -> FloatArray:
        """``(K_piece, K)`` eigen-coordinates of an irregular piece over the element's one-ring."""
        return self.irregular_patch.basis.inverse @ self.stencils

    def inside(
        self,
        domain: AffineMap,  # From the larger element's parameters to the element's
        stencils: FloatArray,  # (K, K_larger) float64: the element's control points over the larger element's one-ring
    ) -> Piece:
        """The same piece as a part of a larger element."""
        return Piece(self.domain @ domain, self.stencils @ stencils, self.patch)


@lru_cache(maxsize=4096)
def whole_piece(scheme: Scheme, signature: Signature) -> Piece | None:
    """The element as one piece, if it is a regular patch, or self-similar when seen from one of its corners."""
    if signature.is_semi_sharp:
        # Each refinement takes from its sharpness.
        return None
    lattice = lattice_stencils(scheme, signature)
    if lattice is not None:
        return Piece(IDENTITY, lattice, None)
    for corner in range(rotation_count(scheme, signature)):
        structure = irregular_structure(scheme, signature.rotated(corner))
        if structure is not None:
            order = rotation_order(signature, corner)
            turned = scheme.domain.rotation(corner).inverse()
            patch = irregular_patch(scheme, structure)
            return Piece(turned, np.eye(len(order))[order[structure.slots]], patch)
    return None


def regular_signature(scheme: Scheme) -> Signature:
    """Signature of an element amid regular faces and vertices only."""
    corners = 1 if scheme.element == "vertex" else scheme.regular_face_size
    return Signature(scheme.element, (_regular_fan(scheme),) * corners)


def isolated_signature(
    scheme: Scheme,
    # Of the extraordinary vertex. Where elements are vertices, the number of corners of the extraordinary face.
    valence: int,
) -> Signature:
    """Signature of an element with one extraordinary point, at its first corner, amid regular faces and vertices."""
    regular = _regular_fan(scheme)
    if scheme.element == "vertex":
        return Signature("vertex", ((valence, *regular[1:]),))
    return Signature("face", ((scheme.regular_face_size,) * valence, *(regular,) * (scheme.regular_face_size - 1)))


def _regular_fan(scheme: Scheme) -> tuple[int, ...]:
    """Faces around a regular vertex."""
    return (scheme.regular_face_size,) * scheme.regular_valence


def rotation_count(scheme: Scheme, signature: Signature) -> int:
    """Number of corners that an element can be seen from: all, or one if the domain has another number of corners."""
    corners = len(signature.fans) if signature.kind == "face" else len(signature.fans[0])
    return corners if corners == scheme.domain.corner_count else 1


@lru_cache(maxsize=4096)
def rotation_order(signature: Signature, corner: int) -> NDArray[np.int64]:
    """Control points of an element, in the order in which they come when the element is named by a later corner."""
    ring = one_ring(signature)
    if corner == 0:
        return np.arange(ring.vertex_count)
    half_edge = 0
    for _ in range(corner):
        half_edge = int(ring.topology.next[half_edge] if signature.kind == "face" else ring.topology.turn(half_edge))
    return one_ring(signature.rotated(corner)).gather(ring.topology, np.array([half_edge]))[0]


@lru_cache(maxsize=1024)
def irregular_structure(scheme: Scheme, signature: Signature) -> IrregularStructure | None:
    """Subdivision matrices of a self-similar one-ring: child 0 has the same signature, the others are regular.

    None if the one-ring is not self-similar.
    """
    # Its other corners are corners of the regular children, too.
    if not all(_is_regular_fan(scheme, fan) for fan in signature.fans[1:]):
        return None
    if len(ring_pattern(scheme, signature.smoothed).domains) != len(scheme.domain.children):
        return None
    ring = refined_ring(scheme, signature)
    if ring.signature(0) != signature:
        return None
    matrix, regular = ring.stencils(0), []
    for number in range(1, len(scheme.domain.children)):
        lattice = lattice_stencils(scheme, ring.signature(number))
        if lattice is None:
            return None
        regular.append(lattice @ ring.stencils(number))
    children = np.stack(regular)
    slots = np.arange(len(matrix))
    if (merged := _merged_slots(signature)) is not None:
        kept, dropped = merged
        slots = np.delete(slots, dropped)
        for columns in (matrix, children):
            columns[..., kept] += columns[..., dropped]
        matrix, children = matrix[np.ix_(slots, slots)], children[..., slots]
    return IrregularStructure(signature, slots, matrix, children)


def _merged_slots(signature: Signature) -> tuple[int, int] | None:
    """Two vertices of a one-ring that are one point: that which stays, and that which goes; None without such.

    At a dart, the sharp edge's other end is seen from both sides, as two local vertices. Kept apart, they would add an
    eigenvector that no cage can have.
    """
    fan = signature.fans[0]
    if not isinstance(fan, TaggedFan) or fan.rule != VertexRule.DART:
        return None
    first, *_, last = one_ring(signature).edge_neighbours()
    return first, last


@lru_cache(maxsize=1024)
def lattice_stencils(scheme: Scheme, signature: Signature) -> FloatArray | None:
    """Control points of an element that is a regular patch, in the order of the scheme's lattice.

    Beside a border some of them are phantom points, which the scheme's `phantom_points` make of control points within.

    Returns (R, K) float64, or None: None if the element is no regular patch. It is one if all its corners are regular,
    be it inside, on a border or at a corner of the border.
    """
    if not (signature.kind == scheme.element and all(_is_regular_fan(scheme, fan) for fan in signature.fans)):
        return None
    if len(signature.fans) != len(regular_signature(scheme).fans):
        return None
    points = _lattice_points(scheme, signature)
    rows = dict(zip(points, np.eye(len(points)), strict=True))
    wanted = [tuple(point) for point in scheme.regular_lattice]
    # Phantom points: first those across one border; then, around a corner, those across both, made of the first ones.
    while missing := [point for point in wanted if point not in rows]:
        phantom = {point: row for point in missing if (row := _phantom_point(scheme, rows, point)) is not None}
        if not phantom:
            raise SchemeError(
                f"{scheme.name}: the phantom points give no control point at {missing[0]} of a regular patch"
            )
        rows |= phantom
    return np.array([rows[point] for point in wanted])


def _phantom_point(scheme: Scheme, rows: dict, point: tuple[float, float]) -> FloatArray | None:
    """Stencil of a lattice point beyond the border, if the scheme makes it of points whose stencils are known."""
    for phantom in scheme.phantom_points or ():
        others = [(point[0] + x, point[1] + y) for x, y in phantom.offsets]
        if all(other in rows for other in others):
            return sum(weight * rows[other] for weight, other in zip(phantom.weights, others, strict=True))
    return None


def _is_regular_fan(scheme: Scheme, fan: Fan) -> bool:
    if not isinstance(fan, TaggedFan):
        return fan == _regular_fan(scheme)
    if fan.is_closed or fan.rule == VertexRule.DART or fan.sharpness is not None:
        return False
    regular = 1 if fan.rule == VertexRule.CORNER else scheme.regular_border_faces
    return fan.ahead + fan.behind == (scheme.regular_face_size,) * regular


def _lattice_points(scheme: Scheme, signature: Signature) -> list[tuple[float, float]]:
    """Lattice point at which each local vertex of a regular one-ring sits."""
    topology = one_ring(signature).topology
    start = {0: (scheme.first_edge[0], scheme.first_edge[1] - scheme.first_edge[0])}
    point_of_vertex: dict[int, tuple[float, float]] = {}
    while start:
        half_edge, (point, edge) = start.popitem()
        for _ in range(scheme.regular_face_size):
            twin = int(topology.twin[half_edge])
            point_of_vertex[int(topology.face_vertices[half_edge])] = tuple(point)
            if twin >= 0 and int(topology.face_vertices[topology.prev[twin]]) not in point_of_vertex:
                start[twin] = (point + edge, -edge)
            point, edge = point + edge, scheme.edge_turn @ edge
            half_edge = int(topology.next[half_edge])
    return [point_of_vertex[vertex] for vertex in range(topology.vertex_count)]
