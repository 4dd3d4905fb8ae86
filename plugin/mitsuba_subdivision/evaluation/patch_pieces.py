"""The two kinds of piece that elements consist of, regular and self-similar patches, found by running the rules."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import VertexRule
from ..mesh.one_ring import one_ring
from ..mesh.signature import Fan, Signature, TaggedFan
from ..schemes.domain import IDENTITY, AffineMap, FloatArray
from ..schemes.scheme import Scheme, SchemeError
from .irregular_patch import IrregularPatch, IrregularStructure, irregular_patch
from .refined_rings import refined_ring, ring_pattern

# An element without semi-sharp features consists of regular and self-similar pieces after this many refinements, or its
# scheme is refused: the rules keep making new extraordinary points. The schemes of this package need one or two.
MAX_REFINEMENTS = 6


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
