"""Split an element into polynomial and self-similar pieces by running the scheme on its one-ring."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..cage.connectivity import IndexArray, IntArray, VertexRule
from ..cage.one_ring import one_ring
from ..cage.signature import (
    Fan,
    FanHalfEdges,
    Signature,
    TaggedFan,
    fan_half_edges,
    signature_at,
    with_sharpness,
)
from ..schemes.domain import IDENTITY, AffineMap, FloatArray, ParameterDomain
from ..schemes.scheme import Scheme, SchemeError

# Refinements after which every element of a stationary scheme consists of regular and self-similar pieces, once nothing
# is semi-sharp any more; the schemes here need one or two. More means rules that keep making new irregularities.
MAX_REFINEMENTS = 6
# What rounding may leave of the difference between a sum of weights and one.
ROW_SUM = 1e-12


@dataclass(frozen=True, eq=False)
class Piece:
    """Part of an element: a regular patch, or one with an extraordinary point at (0, 0).

    Attributes
    ----------
    domain : AffineMap
        From the element's parameters to the piece's own.
    stencils : (K_piece, K) float64
        The piece's control points over the element's one-ring.
    irregular : IrregularStructure or None
        None for a regular piece, whose control points are then in the order of the scheme's lattice.
    """

    domain: AffineMap
    stencils: FloatArray
    irregular: IrregularStructure | None


@dataclass(frozen=True, eq=False)
class IrregularStructure:
    """Subdivision matrices of a one-ring with an extraordinary point at (0, 0), as found by running the rules.

    Attributes
    ----------
    signature : Signature
        Of the one-ring; child 0 has the same.
    slots : (K,) int64
        The local vertices that the control points are: all, but for one that equals another at a dart.
    matrix : (K, K) float64
        A: control points of child 0 from those of the parent.
    children : (3, R, K) float64
        P_k Abar: control points of the regular children 1, 2, 3, in the order of the scheme's lattice.
    """

    signature: Signature
    slots: IntArray
    matrix: FloatArray
    children: FloatArray


@dataclass(frozen=True, eq=False)
class OccupiedPieces:
    """Pieces of a kind, and the samples that lie in them.

    Attributes
    ----------
    pieces : tuple of Piece
        All of one structure.
    samples : (m,) int64
        Which of the samples; at least one.
    piece : (m,) int64
        The piece that each lies in.
    local : (m, 2) float64
        Its parameters there.
    jacobian : (m, 2, 2) float64
        Derivative of these by the sample's own (u, v).
    """

    pieces: tuple[Piece, ...]
    samples: IntArray
    piece: IntArray
    local: FloatArray
    jacobian: FloatArray


def occupied_pieces(
    scheme: Scheme, signature: Signature, uv: FloatArray, corner: NDArray[np.int64]
) -> Iterator[OccupiedPieces]:
    """Pieces of an element in which samples lie, each sample in one; others are not made.

    All pieces together cover the element. There may be many: a crease of sharpness s has 2^s along it. But few parts
    that a refinement makes differ in their signatures, and those that do not are refined together.

    Parameters
    ----------
    signature : Signature
        Of the element's one-ring.
    uv : (s, 2) float64
        With (0, 0) at the sample's corner.
    corner : (s,) int64

    Raises
    ------
    SchemeError
        If refinement does not separate the irregularities of the one-ring.
    """
    parts = {signature: [_Parts.whole(scheme.domain, uv, corner)]} if len(uv) else {}
    for _ in range(MAX_REFINEMENTS + math.ceil(signature.sharpness) + 1):
        refined: dict[Signature, list[_Parts]] = {}
        for sharp, found in parts.items():
            here = _Parts.joined(found)
            steady = sharp.steady_refinements
            base = sharp.sharpened(-steady)
            piece = whole_piece(scheme, base)
            if piece is not None:
                yield here.as_pieces(piece)
                continue
            for child, inside in here.divided(scheme.domain, refined_element(scheme, base)):
                refined.setdefault(child.sharpened(steady), []).append(inside)
        parts = refined
    if parts:
        left = next(iter(parts))
        raise SchemeError(
            f"{scheme.name}: refinement leaves a {left.kind} with fans {left.fans} neither regular nor self-similar; "
            "expected a scheme that isolates extraordinary points"
        )


@dataclass(frozen=True, eq=False)
class _Parts:
    """Parts of an element that have the same signature, and the samples that lie in them.

    Attributes
    ----------
    uv : (s, 2) float64
        With (0, 0) at the sample's corner.
    corner, samples : (s,) int64
        Corner and number of each sample.
    part : (s,) int64
        The part that each lies in.
    matrices, offsets : (p, corners, 2, 2), (p, corners, 2) float64
        Maps from each corner's parameters to each part's. They are composed before they are applied, so a tiny (u, v)
        at any corner stays exact.
    stencils : (p, K_part, K) float64 or None
        Control points of each part over the element's one-ring; None for the element itself.
    """

    uv: FloatArray
    corner: NDArray[np.int64]
    samples: IntArray
    part: IntArray
    matrices: FloatArray
    offsets: FloatArray
    stencils: FloatArray | None

    @classmethod
    def whole(cls, domain: ParameterDomain, uv: FloatArray, corner: NDArray[np.int64]) -> _Parts:
        """The element itself."""
        part = np.zeros(len(uv), dtype=np.int64)
        return cls(uv, corner, np.arange(len(uv)), part, *_corner_maps(domain), None)

    @classmethod
    def joined(cls, several: list[_Parts]) -> _Parts:
        """Parts of several elements in one."""
        if len(several) == 1:
            return several[0]
        first = np.cumsum([0, *(len(parts.matrices) for parts in several)])
        names = ("uv", "corner", "samples", "matrices", "offsets", "stencils")
        fields = {name: np.concatenate([getattr(parts, name) for parts in several]) for name in names}
        return cls(part=np.concatenate([p.part + begin for p, begin in zip(several, first, strict=False)]), **fields)

    def divided(self, domain: ParameterDomain, element: RefinedElement) -> Iterator[tuple[Signature, _Parts]]:
        """Parts of these parts in which samples lie, those with the same number in ``element``; and their signature."""
        matrices = element.matrices[:, None, None] @ self.matrices
        offsets = (element.matrices[:, None, None] @ self.offsets[..., None])[..., 0] + element.offsets[:, None, None]
        # On the border of several parts, the first.
        chosen = np.argmax(domain.inside(self._applied(matrices, offsets)), axis=0)
        for number in np.flatnonzero(np.bincount(chosen)).tolist():
            own = np.flatnonzero(chosen == number)
            used, part = np.zeros(1, dtype=np.int64), self.part[own]
            if len(self.matrices) > 1:
                used, part = np.unique(part, return_inverse=True)
            child, stencils = element.part(number)
            yield (
                child,
                _Parts(
                    self.uv[own],
                    self.corner[own],
                    self.samples[own],
                    part,
                    matrices[number, used],
                    offsets[number, used],
                    stencils[None] if self.stencils is None else stencils @ self.stencils[used],
                ),
            )

    def as_pieces(self, piece: Piece) -> OccupiedPieces:
        """Pieces that the parts are, of the same structure as ``piece``."""
        matrices = piece.domain.matrix @ self.matrices
        offsets = self.offsets @ piece.domain.matrix.T + piece.domain.offset
        stencils = piece.stencils[None] if self.stencils is None else piece.stencils @ self.stencils
        return OccupiedPieces(
            tuple(Piece(AffineMap(m[0], o[0]), s, piece.irregular) for m, o, s in zip(matrices, offsets, stencils, strict=True)),
            self.samples,
            self.part,
            self._applied(matrices, offsets),
            matrices[self.part, self.corner],
        )

    def _applied(self, matrices: FloatArray, offsets: FloatArray) -> FloatArray:
        """Parameters ``(.., s, 2)`` by maps ``(.., p, corners, 2, 2)`` and ``(.., p, corners, 2)``."""
        matrix, offset = matrices[..., self.part, self.corner, :, :], offsets[..., self.part, self.corner, :]
        return matrix[..., 0] * self.uv[:, None, 0] + matrix[..., 1] * self.uv[:, None, 1] + offset


@lru_cache(maxsize=16)
def _corner_maps(domain: ParameterDomain) -> tuple[FloatArray, FloatArray]:
    """Maps from each corner's parameters to the domain's: ``(1, corners, 2, 2)`` and ``(1, corners, 2)``."""
    maps = [domain.rotation(corner) for corner in range(domain.corner_count)]
    return np.array([[m.matrix for m in maps]]), np.array([[m.offset for m in maps]])


@lru_cache(maxsize=4096)
def whole_piece(scheme: Scheme, signature: Signature) -> Piece | None:
    """The piece that an element is, if it is one."""
    lattice = lattice_stencils(scheme, signature)
    if lattice is not None:
        return Piece(IDENTITY, lattice, None)
    # What is still sharp decays, and so is not self-similar.
    for corner in range(rotation_count(scheme, signature) if signature.sharpness == 0 else 0):
        structure = irregular_structure(scheme, signature.rotated(corner))
        if structure is not None:
            order = rotation_order(signature, corner)
            turned = scheme.domain.rotation(corner).inverse()
            return Piece(turned, np.eye(len(order))[order[structure.slots]], structure)
    return None


class RefinedElement:
    """An element refined once; its parts are made when they are asked for.

    Attributes
    ----------
    domains : tuple of AffineMap
        From the element's parameters to those of each part.
    matrices, offsets : (4, 2, 2), (4, 2) or (1, 2, 2), (1, 2) float64
        Of these maps.
    """

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self._scheme, self._signature = scheme, signature
        smooth = signature.smoothed
        # Where faces and vertices come to lie does not depend on sharpness.
        self._smooth = None if smooth == signature else refined_element(scheme, smooth)
        self._refinement = scheme.refine(one_ring(signature).topology)
        self._topology = self._refinement.topology if self._smooth is None else self._smooth._topology
        self._children = self._smooth._children if self._smooth else self._named_children()
        self.domains = tuple(domain for domain, _ in self._children)
        self.matrices = np.array([domain.matrix for domain in self.domains])
        self.offsets = np.array([domain.offset for domain in self.domains])
        self._parts: dict[int, tuple[Signature, FloatArray]] = {}
        self._places: dict[int, _Place] = {}

    def _named_children(self) -> list[tuple[AffineMap, int]]:
        return self._scheme.children(one_ring(self._signature).topology, self._topology, 0)

    def part(self, number: int) -> tuple[Signature, FloatArray]:
        """Signature of a part and its control points over the element's one-ring, ``(K_part, K)``."""
        if number not in self._parts:
            place = (self._smooth or self)._place(number)
            semi_sharpness = self._refinement.topology.semi_sharpness
            child = with_sharpness(place.signature, place.fans, self._topology, semi_sharpness)
            stencils = self._refinement.stencils.dense(place.vertices)
            _require_rows_to_one(self._scheme, self._signature, stencils)
            self._parts[number] = child, stencils
        return self._parts[number]

    def _place(self, number: int) -> _Place:
        if number not in self._places:
            half_edge, kind = self._children[number][1], self._scheme.element
            smooth = signature_at(self._topology, half_edge, kind)
            vertices = one_ring(smooth).gather(self._topology, np.array([half_edge]))[0]
            self._places[number] = _Place(smooth, fan_half_edges(self._topology, half_edge, kind), vertices)
        return self._places[number]


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a part lies in the refined one-ring.

    Attributes
    ----------
    signature : Signature
        Without semi-sharp features.
    fans : list of FanHalfEdges
        Half-edges of the fan at each of its corners.
    vertices : (K_part,) int32
        Its control points.
    """

    signature: Signature
    fans: list[FanHalfEdges]
    vertices: IndexArray


@lru_cache(maxsize=1024)
def refined_element(scheme: Scheme, signature: Signature) -> RefinedElement:
    """Refine an element's one-ring once."""
    return RefinedElement(scheme, signature)


def refined_parts(scheme: Scheme, signature: Signature) -> list[tuple[AffineMap, Signature, FloatArray]]:
    """All parts after one refinement: parameter map, signature, and control points over the one-ring before."""
    element = RefinedElement(scheme, signature)
    return [(domain, *element.part(number)) for number, domain in enumerate(element.domains)]


def _require_rows_to_one(scheme: Scheme, signature: Signature, stencils: FloatArray) -> None:
    sums = stencils.sum(axis=1)
    worst = int(np.argmax(np.abs(sums - 1)))
    if not abs(sums[worst] - 1) <= ROW_SUM:
        raise SchemeError(
            f"{scheme.name}: a refined vertex near a {signature.kind} with fans {signature.fans} has weights that sum "
            f"to {sums[worst]:.12g}; expected 1"
        )


def regular_signature(scheme: Scheme) -> Signature:
    """Signature of an element amid regular faces and vertices only."""
    fan = (scheme.regular_face_size,) * scheme.regular_valence
    corners = 1 if scheme.element == "vertex" else scheme.regular_face_size
    return Signature(scheme.element, (fan,) * corners)


def rotation_count(scheme: Scheme, signature: Signature) -> int:
    """In how many ways the element's domain can be turned: once per corner, or one where it is no whole domain."""
    corners = len(signature.fans) if signature.kind == "face" else len(signature.fans[0])
    return corners if corners == scheme.domain.corner_count else 1


@lru_cache(maxsize=4096)
def rotation_order(signature: Signature, corner: int) -> NDArray[np.int64]:
    """Local vertices in the order in which the walk from a later corner meets them."""
    ring = one_ring(signature)
    half_edge = 0
    for _ in range(corner):
        half_edge = int(ring.topology.next[half_edge] if signature.kind == "face" else ring.topology.turn(half_edge))
    return one_ring(signature.rotated(corner)).gather(ring.topology, np.array([half_edge]))[0]


@lru_cache(maxsize=1024)
def irregular_structure(scheme: Scheme, signature: Signature) -> IrregularStructure | None:
    """Subdivision matrices of a one-ring if it is self-similar: child 0 of the same shape, the others regular."""
    element = RefinedElement(scheme, signature)
    if len(element.domains) != len(scheme.domain.children):
        return None
    child, matrix = element.part(0)
    if child != signature:
        return None
    others = [element.part(number) for number in range(1, len(element.domains))]
    lattices = [lattice_stencils(scheme, child) for child, _ in others]
    if any(lattice is None for lattice in lattices):
        return None
    children = [lattice @ stencils for lattice, (_, stencils) in zip(lattices, others, strict=True)]
    slots, merge = _distinct_slots(signature)
    return IrregularStructure(signature, slots, matrix[slots] @ merge, np.stack(children) @ merge)


def _distinct_slots(signature: Signature) -> tuple[IntArray, FloatArray]:
    """Local vertices that stand for different points, and the matrix ``(all, distinct)`` that repeats the others.

    At a dart, the sharp edge's other end is seen from both sides, as two local vertices. Kept apart, they would add an
    eigenvector that no cage can have.
    """
    ring, fan = one_ring(signature), signature.fans[0]
    unit = np.eye(ring.vertex_count)
    slots = np.arange(ring.vertex_count)
    if not isinstance(fan, TaggedFan) or fan.rule != VertexRule.DART:
        return slots, unit
    first, *_, last = ring.edge_neighbours()
    unit[last] = unit[first]
    distinct = slots[slots != last]
    return distinct, unit[:, distinct]


@lru_cache(maxsize=1024)
def lattice_stencils(scheme: Scheme, signature: Signature) -> FloatArray | None:
    """Control points ``(R, K)`` of the polynomial patch that an element is, in the order of the scheme's lattice.

    Returns
    -------
    None if the element is no polynomial patch: unless all its corners are regular, inside, on a border or at a corner.
    """
    if not (signature.kind == scheme.element and all(_is_regular_fan(scheme, fan) for fan in signature.fans)):
        return None
    if len(signature.fans) != len(regular_signature(scheme).fans):
        return None
    points = _lattice_points(scheme, signature)
    rows = dict(zip(points, np.eye(len(points)), strict=True))
    wanted = [tuple(point) for point in scheme.regular_lattice]
    # First the points across the border from what is there, then, around corners, those across both borders.
    while missing := [point for point in wanted if point not in rows]:
        beyond = {point: row for point in missing if (row := _beyond_border(scheme, rows, point)) is not None}
        if not beyond:
            raise SchemeError(
                f"{scheme.name}: the border rules give no control point at {missing[0]} of a regular patch"
            )
        rows |= beyond
    return np.array([rows[point] for point in wanted])


def _beyond_border(scheme: Scheme, rows: dict, point: tuple[float, float]) -> FloatArray | None:
    """Stencil of a lattice point beyond the border, if a rule gives it from those there are."""
    for rule in scheme.border_rules:
        others = [(point[0] + x, point[1] + y) for x, y in rule.offsets]
        if all(other in rows for other in others):
            return sum(weight * rows[other] for weight, other in zip(rule.weights, others, strict=True))
    return None


def _is_regular_fan(scheme: Scheme, fan: Fan) -> bool:
    if not isinstance(fan, TaggedFan):
        return fan == (scheme.regular_face_size,) * scheme.regular_valence
    if fan.is_closed or fan.rule == VertexRule.DART or fan.sharpness is not None:
        return False
    regular = 1 if fan.rule == VertexRule.CORNER else scheme.regular_border_faces
    return fan.ahead + fan.behind == (scheme.regular_face_size,) * regular


def _lattice_points(scheme: Scheme, signature: Signature) -> list[tuple[float, float]]:
    """Lattice point at which each local vertex of a regular one-ring sits."""
    topology = one_ring(signature).topology
    start = {0: (scheme.first_edge[0], scheme.first_edge[1] - scheme.first_edge[0])}
    place: dict[int, tuple[float, float]] = {}
    while start:
        half_edge, (point, edge) = start.popitem()
        for _ in range(scheme.regular_face_size):
            twin = int(topology.twin[half_edge])
            place[int(topology.face_vertices[half_edge])] = tuple(point)
            if twin >= 0 and int(topology.face_vertices[topology.prev[twin]]) not in place:
                start[twin] = (point + edge, -edge)
            point, edge = point + edge, scheme.edge_turn @ edge
            half_edge = int(topology.next[half_edge])
    return [place[vertex] for vertex in range(topology.vertex_count)]
