"""Split an element into polynomial and self-similar pieces by running the scheme on its one-ring."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..cage.connectivity import IntArray, VertexRule
from ..cage.one_ring import one_ring
from ..cage.signature import Fan, Signature, TaggedFan, signature_at
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
class OccupiedPiece:
    """A piece and the samples that lie in it.

    Attributes
    ----------
    piece : Piece
    samples : (m,) int64
        Which of the samples, in increasing order; at least one.
    local : (m, 2) float64
        Their parameters in the piece.
    jacobian : (m, 2, 2) float64
        Derivative of these by the samples' own (u, v).
    """

    piece: Piece
    samples: IntArray
    local: FloatArray
    jacobian: FloatArray


def occupied_pieces(
    scheme: Scheme, signature: Signature, uv: FloatArray, corner: NDArray[np.int64]
) -> Iterator[OccupiedPiece]:
    """Pieces of an element in which samples lie, each sample in one; others are not made.

    All pieces together cover the element, and there may be many: a crease of sharpness s has 2^s along it. But only few
    parts that a refinement makes differ in their signatures, and each of these is refined once.

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
    samples = _Samples(uv, corner, np.arange(len(uv)), *_corner_maps(scheme.domain))
    if len(uv):
        yield from _occupied(scheme, signature, samples, None, MAX_REFINEMENTS + math.ceil(signature.sharpness))


def _occupied(
    scheme: Scheme, signature: Signature, samples: _Samples, stencils: FloatArray | None, refinements: int
) -> Iterator[OccupiedPiece]:
    """Pieces of a part, whose control points are ``stencils`` over the element's one-ring; None for the element."""
    steady = signature.steady_refinements
    signature = signature.sharpened(-steady)
    piece = whole_piece(scheme, signature)
    if piece is not None:
        here = samples.within(piece.domain)
        over_element = piece.stencils if stencils is None else piece.stencils @ stencils
        domain = AffineMap(here.matrices[0], here.offsets[0])
        yield OccupiedPiece(
            Piece(domain, over_element, piece.irregular), here.which, here.local(), here.matrices[here.corner]
        )
        return
    if refinements == 0:
        raise SchemeError(
            f"{scheme.name}: refinement leaves a {signature.kind} with fans {signature.fans} neither regular nor "
            "self-similar; expected a scheme that isolates extraordinary points"
        )
    element = refined_element(scheme, signature)
    parts = [samples.within(domain) for domain in element.domains]
    # On the border of several parts, the first.
    chosen = np.argmax([scheme.domain.inside(part.local()) for part in parts], axis=0)
    for k in np.unique(chosen).tolist():
        child, over_parent = element.part(k)
        over_element = over_parent if stencils is None else over_parent @ stencils
        yield from _occupied(scheme, child.sharpened(steady), parts[k].chosen(chosen == k), over_element, refinements - 1)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples, and maps from each corner's parameters to those of a part.

    The maps are composed before they are applied, so a tiny (u, v) at any corner stays exact.

    Attributes
    ----------
    uv : (s, 2) float64
        With (0, 0) at the sample's corner.
    corner, which : (s,) int64
    matrices : (corners, 2, 2) float64
    offsets : (corners, 2) float64
    """

    uv: FloatArray
    corner: NDArray[np.int64]
    which: IntArray
    matrices: FloatArray
    offsets: FloatArray

    def within(self, part: AffineMap) -> _Samples:
        """The same, as a part of the part has them."""
        return replace(self, matrices=part.matrix @ self.matrices, offsets=self.offsets @ part.matrix.T + part.offset)

    def chosen(self, is_chosen: NDArray[np.bool_]) -> _Samples:
        return replace(self, uv=self.uv[is_chosen], corner=self.corner[is_chosen], which=self.which[is_chosen])

    def local(self) -> FloatArray:
        """``(s, 2)`` parameters in the part."""
        matrix, offset = self.matrices[self.corner], self.offsets[self.corner]
        return matrix[..., 0] * self.uv[:, None, 0] + matrix[..., 1] * self.uv[:, None, 1] + offset


@lru_cache(maxsize=16)
def _corner_maps(domain: ParameterDomain) -> tuple[FloatArray, FloatArray]:
    """Maps from each corner's parameters to the domain's: ``(corners, 2, 2)`` and ``(corners, 2)``."""
    maps = [domain.rotation(corner) for corner in range(domain.corner_count)]
    return np.array([m.matrix for m in maps]), np.array([m.offset for m in maps])


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
    """

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self._scheme, self._signature = scheme, signature
        ring = one_ring(signature)
        self._refinement = scheme.refine(ring.topology)
        children = scheme.children(ring.topology, self._refinement.topology, 0)
        self.domains = tuple(domain for domain, _ in children)
        self._half_edges = [half_edge for _, half_edge in children]
        self._parts: dict[int, tuple[Signature, FloatArray]] = {}

    def part(self, number: int) -> tuple[Signature, FloatArray]:
        """Signature of a part and its control points over the element's one-ring, ``(K_part, K)``."""
        if number not in self._parts:
            topology, half_edge = self._refinement.topology, self._half_edges[number]
            child = signature_at(topology, half_edge, self._scheme.element)
            rows = one_ring(child).gather(topology, np.array([half_edge]))[0]
            stencils = self._refinement.stencils.dense(rows)
            _require_rows_to_one(self._scheme, self._signature, stencils)
            self._parts[number] = child, stencils
        return self._parts[number]


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
