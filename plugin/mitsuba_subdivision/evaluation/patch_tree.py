"""Patch trees: elements divided into regular and self-similar pieces by running the rules of the scheme.

One refinement of an element gives its *children*: four, one for each copy of its domain, or one for the whole domain if
the element does not fit it, such as a corner of a pentagon under Catmull-Clark. A *piece* needs no further division: it
is a regular patch, or a *tip*, a patch with a single extraordinary point, which consists of three regular pieces at
every level (`IrregularPatch`).

Refinement along a semi-sharp crease produces thousands of parts, but few kinds of them: parts whose one-rings have the
same signature are divided alike. So there is one `PatchTree` for each signature, shared by all elements, and its
children are computed on demand. Samples descend to the leaves that contain them (`located_samples`). Bounds divide
parts whose bound is not yet tight (`divided_tile`). Kernels and integrals need all pieces (`PatchTree.coefficients`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import INFINITE, IntArray, VertexRule
from ..mesh.one_ring import RingTable, joined_rings, one_ring, one_rings
from ..mesh.signature import Fan, Signature, signatures_at
from ..schemes.domain import IDENTITY, FloatArray, ParameterMap
from ..schemes.scheme import Scheme, SchemeError
from .irregular_patch import IrregularPatch

# Number of control points of the one-rings that are refined together, which bounds memory to tens of megabytes.
JOINED_CONTROLS = 1 << 14
ROW_SUM = 1e-12  # Tolerance when comparing the sum of a stencil's weights with 1
# Maximum depth of a patch tree. Each refinement reduces the sharpness of semi-sharp features, below `INFINITE`, by one.
# Without them, the schemes of this package need one or two refinements until all elements are pieces. A scheme
# that needs more than six is refused: its rules keep making new extraordinary points.
MOST_DEPTH = int(INFINITE) + 7


class PartKind(IntEnum):
    """Kind of a node of a patch tree."""

    DIVIDED = 0  # Four children
    ONLY_CHILD = 1  # One child with the same parameters, of an element that does not fit the domain
    REGULAR = 2  # A regular patch
    TIP = 3  # A patch with one extraordinary point


class PatchTree:
    """The elements of one signature, and the parts that they are divided into."""

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self.scheme, self.signature = scheme, signature
        self.control_count = one_ring(signature).vertex_count  # K, of the element's one-ring
        # Once the element is refined: children with their stencils, and maps from its parameters to theirs
        self.refined: list[tuple[PatchTree, FloatArray]] = []
        self.domains: tuple[ParameterMap, ...] = ()

    @cached_property
    def tip_corners(self) -> list[int]:
        """Corners at which the element may be self-similar, as all others are regular; empty for regular elements."""
        scheme, signature = self.scheme, self.signature
        # Each refinement reduces the sharpness, so semi-sharp elements are not self-similar.
        if signature.is_semi_sharp or lattice_stencils(scheme, signature) is not None:
            return []
        count = len(signature.fans) if signature.kind == "face" else signature.fans[0].face_count
        # The parameters of an element that does not fit the domain begin at its first corner only.
        corners = range(count if count == scheme.domain.corner_count else 1)
        others = ((corner, signature.rotated(corner).fans[1:]) for corner in corners)
        return [corner for corner, fans in others if all(_is_regular_fan(scheme, fan) for fan in fans)]

    @cached_property
    def piece(self) -> Piece | None:
        """The whole element as one piece: a regular patch, or self-similar at one of its corners. None for others."""
        scheme, signature = self.scheme, self.signature
        if not signature.is_semi_sharp and (lattice := lattice_stencils(scheme, signature)) is not None:
            return Piece(IDENTITY, lattice, None)
        for corner in self.tip_corners:
            patch = irregular_patch(scheme, signature.rotated(corner))
            if patch is not None:
                order = rotation_order(signature, corner)
                return Piece(scheme.domain.rotation(corner).inverse(), np.eye(len(order))[order[patch.slots]], patch)
        return None

    @cached_property
    def kind(self) -> PartKind:
        if self.piece is None:
            return PartKind.ONLY_CHILD if len(self.children) == 1 else PartKind.DIVIDED
        return PartKind.REGULAR if self.piece.patch is None else PartKind.TIP

    @cached_property
    def turn(self) -> int:
        """Argument of `ParameterDomain.rotation` that maps the element's parameters to those of the tip; else 0."""
        if self.kind != PartKind.TIP or self.piece is None:
            return 0
        domain = self.scheme.domain
        return next(turn for turn in range(domain.corner_count) if domain.rotation(turn).is_same(self.piece.domain))

    @property
    def children(self) -> list[tuple[PatchTree, FloatArray]]:
        """All children with their stencils over the element's control points, ``(K_child, K)``; empty for a piece."""
        if self.piece is None and not self.refined:
            refine([self])
        return self.refined if self.piece is None else []

    @cached_property
    def regular_count(self) -> int:
        return int(self.kind == PartKind.REGULAR) + sum(child.regular_count for child, _ in self.children)

    @cached_property
    def tips(self) -> tuple[Piece, ...]:
        """All tips, as pieces of this element."""
        if self.piece is not None:
            return (self.piece,) if self.piece.patch is not None else ()
        return tuple(
            tip.inside(domain, stencils)
            for (child, stencils), domain in zip(self.children, self.domains, strict=True)
            for tip in child.tips
        )

    @cached_property
    def regular_domains(self) -> tuple[FloatArray, FloatArray]:
        """Maps from the parameters of regular pieces to the element's: ``(r, 2, 2)`` matrices, ``(r, 2)`` offsets."""
        if self.piece is not None:
            return np.eye(2)[None][: self.regular_count], np.zeros((self.regular_count, 2))
        matrices, offsets = [], []
        for (child, _), domain in zip(self.children, self.domains, strict=True):
            to_element, (inner_matrices, inner_offsets) = domain.inverse(), child.regular_domains
            matrices.append(to_element.matrix @ inner_matrices)
            offsets.append(inner_offsets @ to_element.matrix.T + to_element.offset)
        return np.concatenate(matrices), np.concatenate(offsets)

    @cached_property
    def nodes(self) -> IntArray:
        """``(n, 3)``: `kind`, `turn` and first child of each node of the tree, from the root; children are consecutive.

        For a piece the last entry is its index among those of its kind, in the order of `coefficients` or `tips`.
        """
        children, root = [child for child, _ in self.children], [self.kind, self.turn, int(self.piece is None)]
        if not children:
            return np.array([root])
        # For each child and `PartKind` the number before: of nodes for inner nodes, of pieces for regular pieces, tips.
        sizes = np.array([[len(child.nodes) - 1] * 2 + [child.regular_count, len(child.tips)] for child in children])
        before = np.cumsum(sizes, axis=0) - sizes + [len(children), len(children), 0, 0]
        of_children = [child.nodes for child in children]
        nodes = np.concatenate([[root], *[rows[:1] for rows in of_children], *[rows[1:] for rows in of_children]])
        child = np.concatenate([np.arange(len(children)), np.repeat(np.arange(len(children)), sizes[:, 0])])
        nodes[1:, 2] += before[child, nodes[1:, 0]]
        return nodes

    def coefficients(
        self,
        # (m, R) float64: from control points of a regular patch, in the order of the scheme's lattice, to coefficients
        form: FloatArray,
        # Cache of the coefficients of children, which many parts share; not kept, as these arrays are the largest
        known: dict[PatchTree, FloatArray] | None = None,
    ) -> FloatArray:
        """Compute coefficients of the regular pieces over the element's one-ring. Returns (r, m, K)."""
        if self.piece is not None and self.piece.patch is None:
            return (form @ self.piece.stencils)[None]
        known, coefficients = {} if known is None else known, [np.empty((0, len(form), self.control_count))]
        for child, stencils in self.children:
            if child not in known:
                known[child] = child.coefficients(form, known)
            coefficients.append(known[child] @ stencils)
        return np.concatenate(coefficients)


# The limit is several times the number of elements of a cage with some hundred classes of semi-sharp one-rings.
@lru_cache(maxsize=8192)
def patch_tree(scheme: Scheme, signature: Signature) -> PatchTree:
    """Return the patch tree of a signature; the same object at each call."""
    return PatchTree(scheme, signature)


def divide(elements: Iterable[PatchTree]) -> None:
    """Find the pieces among elements, and make the children of all others. Raises SchemeError as `refine`."""
    elements = [*dict.fromkeys(elements)]
    new = (element for element in elements if "piece" not in vars(element))
    refine(patch_tree(one.scheme, one.signature.rotated(corner)) for one in new for corner in one.tip_corners)
    refine(element for element in elements if element.piece is None)


def refine(elements: Iterable[PatchTree]) -> None:
    """Refine the elements that are not yet refined: together they take little longer than one.

    Raises SchemeError if the scheme divides domains differently from `ParameterDomain.children`.
    """
    unrefined = [element for element in dict.fromkeys(elements) if not element.refined]
    for run in ragged.runs_of([element.control_count for element in unrefined], JOINED_CONTROLS):
        scheme, in_run = unrefined[0].scheme, unrefined[run]
        of_run = refined_children(scheme, [element.signature for element in in_run])
        different = dict.fromkeys(child.signature for children in of_run for child in children)
        trees = {signature: patch_tree(scheme, signature) for signature in different}
        for element, children in zip(in_run, of_run, strict=True):
            copies = (IDENTITY,) if len(children) == 1 else scheme.domain.children
            is_same = [child.domain.is_same(copy) for child, copy in zip(children, copies, strict=False)]
            if len(children) != len(copies) or not all(is_same):
                raise SchemeError(
                    f"{scheme.name}: a child's domain is none of {len(copies)} copies, in their order; expected "
                    "the four of `ParameterDomain.children`, or the whole domain"
                )
            element.refined = [(trees[child.signature], child.stencils) for child in children]
            element.domains = copies


def patch_trees(scheme: Scheme, signatures: Iterable[Signature]) -> list[PatchTree]:
    """Return completely divided patch trees of signatures; equal ones are the same object.

    Raises SchemeError if refinement does not separate the irregularities of a one-ring, or as `divide` does.
    """
    elements = [patch_tree(scheme, signature) for signature in signatures]
    undivided = list(dict.fromkeys(elements))
    for _ in range(MOST_DEPTH + 1):
        divide(undivided)
        undivided = list(dict.fromkeys(child for element in undivided for child, _ in element.children))
        if not undivided:
            return elements
    raise not_isolated(scheme, undivided[0].signature)


def not_isolated(scheme: Scheme, rest: Signature) -> SchemeError:
    """Return the error for a signature that is no piece after `MOST_DEPTH` refinements and one."""
    if rest.is_semi_sharp:
        return SchemeError(
            f"{scheme.name}: {MOST_DEPTH + 1} refinements leave something of a {rest.kind} semi-sharp; expected each "
            "to decrease the sharpness by one"
        )
    return SchemeError(
        f"{scheme.name}: refinement leaves a {rest.kind} with fans {rest.fans} neither regular nor self-similar; "
        "expected a scheme that isolates extraordinary points"
    )


class Child(NamedTuple):
    """A child of an element."""

    domain: ParameterMap  # From the element's parameters to the child's
    signature: Signature
    stencils: FloatArray  # (K_child, K) float64: the child's control points over those of the element


def refined_children(scheme: Scheme, signatures: Sequence[Signature]) -> list[list[Child]]:
    """Return the children of elements of some signatures, whose small one-rings are refined side by side, as one mesh.

    Raises SchemeError if the weights of a control point do not sum to one.
    """
    topology, first_half_edges, first_vertices = joined_rings(signatures)
    refined, table = scheme.refine(topology)
    parts = [
        (parent, domain, half_edge)
        for parent, first in enumerate(first_half_edges.tolist())
        for domain, half_edge in scheme.children(topology, refined, first)
    ]
    half_edges = np.array([half_edge for *_, half_edge in parts])
    of_parts = signatures_at(refined, half_edges, scheme.element)
    groups = {signature: group for group, signature in enumerate(dict.fromkeys(of_parts))}
    group = np.array([groups[signature] for signature in of_parts])
    order, group_counts = np.argsort(group, kind="stable"), np.bincount(group)
    rings = RingTable(refined, one_rings(groups), half_edges[order], group_counts)
    # A row for each control point of each child, as long as the one-ring of the parent has vertices.
    controls = np.concatenate(rings.vertices_of(group[order], ragged.index_in_row(group_counts)), axis=None)
    row_counts = rings.vertex_counts[group[order]]
    parent_of_row = np.repeat(np.array([parent for parent, *_ in parts])[order], row_counts)
    offsets = ragged.offsets(np.diff(first_vertices)[parent_of_row])
    rows, columns, weights = table.entries(controls)
    error = np.abs(np.bincount(rows, weights, minlength=len(parent_of_row)) - 1)
    if not error.max() <= ROW_SUM:  # `not <=` also refuses NaN
        worst = int(np.argmax(error))
        smooth, total = signatures[parent_of_row[worst]].smoothed, weights[rows == worst].sum()
        raise SchemeError(
            f"{scheme.name}: a refined vertex near a {smooth.kind} with fans {smooth.fans} has "
            f"weights that sum to {total:.12g}; expected 1"
        )
    places = offsets[rows] + columns - first_vertices[parent_of_row[rows]]
    flat: FloatArray = np.bincount(places, weights, minlength=offsets[-1]).astype(np.float64, copy=False)
    blocks = ragged.rows(flat, np.diff(offsets[ragged.offsets(row_counts)]))
    children: list[list[Child]] = [[] for _ in signatures]
    for (parent, domain, _), signature, place in zip(parts, of_parts, np.argsort(order).tolist(), strict=True):
        children[parent].append(Child(domain, signature, blocks[place].reshape(row_counts[place], -1)))
    return children


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of an element that needs no further division: a regular patch, or one with an extraordinary point."""

    domain: ParameterMap  # From the element's parameters to the piece's, where an extraordinary point is at (0, 0)
    stencils: FloatArray  # (K_piece, K) float64: the piece's control points over the element's one-ring
    # None for a regular piece; its control points are in the order of the scheme's lattice
    patch: IrregularPatch | None

    @property
    def irregular_patch(self) -> IrregularPatch:
        if self.patch is None:
            raise ValueError("a regular piece; expected one with an extraordinary point")
        return self.patch

    @cached_property
    def absolute_sums(self) -> FloatArray:
        """``(K_piece,)`` sums of the absolute weights of control points, or of the terms of eigen-coordinates."""
        sums = np.abs(self.stencils).sum(axis=1)
        return sums if self.patch is None else np.abs(self.patch.basis.inverse) @ sums

    @cached_property
    def coordinates(self) -> FloatArray:
        """``(K_piece, K)`` stencils of an irregular piece's eigen-coordinates over the element's one-ring."""
        return self.irregular_patch.basis.inverse @ self.stencils

    def inside(
        self,
        domain: ParameterMap,  # From the parent's parameters to the element's
        stencils: FloatArray,  # (K, K_parent) float64: the element's control points over the parent's one-ring
    ) -> Piece:
        """Return the same piece as a part of the element's parent."""
        return Piece(self.domain @ domain, self.stencils @ stencils, self.patch)


def regular_signature(scheme: Scheme) -> Signature:
    """Return the signature of an element surrounded by regular faces and vertices."""
    corners = 1 if scheme.element == "vertex" else scheme.regular_face_size
    return Signature(scheme.element, (_regular_fan(scheme),) * corners)


def isolated_signature(
    scheme: Scheme,
    # Valence of the extraordinary vertex. Where elements are vertices, number of corners of the extraordinary face.
    valence: int,
) -> Signature:
    """Return the signature of an element whose only irregularity is an extraordinary point at its first corner."""
    regular = _regular_fan(scheme)
    if scheme.element == "vertex":
        return Signature("vertex", (Fan((valence, *regular.ahead[1:])),))
    fan = Fan((scheme.regular_face_size,) * valence)
    return Signature("face", (fan, *(regular,) * (scheme.regular_face_size - 1)))


def _regular_fan(scheme: Scheme) -> Fan:
    return Fan((scheme.regular_face_size,) * scheme.regular_valence)


def rotation_order(signature: Signature, corner: int) -> IntArray:
    """Return indices of an element's control points in the order of ``signature.rotated(corner)``."""
    ring = one_ring(signature)
    if corner == 0:
        return np.arange(ring.vertex_count)
    half_edge = 0
    for _ in range(corner):
        half_edge = int(ring.topology.next[half_edge] if signature.kind == "face" else ring.topology.turn[half_edge])
    rotated = one_ring(signature.rotated(corner))
    return RingTable(ring.topology, [rotated], np.array([half_edge]), np.array([1])).vertices


@lru_cache(maxsize=1024)
def irregular_patch(scheme: Scheme, signature: Signature) -> IrregularPatch | None:
    """Return the patch of a self-similar one-ring: child 0 has its signature, all others are regular; else None."""
    refine([element := patch_tree(scheme, signature)])
    (first, matrix), *others = element.refined
    if len(others) != len(scheme.domain.children) - 1 or first.signature != signature:
        return None
    regular_stencils = []
    for child, stencils in others:
        lattice = lattice_stencils(scheme, child.signature)
        if lattice is None:
            return None
        regular_stencils.append(lattice @ stencils)
    matrix, children = matrix.copy(), np.stack(regular_stencils)
    slots = np.arange(len(matrix))
    if signature.fans[0].rule == VertexRule.DART:
        # The other end of the sharp edge is two vertices of the one-ring, one on each side of the edge. As separate
        # control points they would add an eigenvector that no cage can have.
        kept, *_, dropped = one_ring(signature).edge_neighbours()
        slots = np.delete(slots, dropped)
        for weights in (matrix, children):
            weights[..., kept] += weights[..., dropped]
        matrix, children = matrix[np.ix_(slots, slots)], children[..., slots]
    return IrregularPatch(scheme, signature, slots, matrix, children)


@lru_cache(maxsize=1024)
def lattice_stencils(scheme: Scheme, signature: Signature) -> FloatArray | None:
    """Return stencils ``(R, K)`` of the control points of a regular patch, in the order of the scheme's lattice.

    None if a corner of the element is not regular: inside the mesh, on a border or at a corner of the border. Beside a
    border some control points are phantom points, computed from inner ones.
    """
    if not (signature.kind == scheme.element and all(_is_regular_fan(scheme, fan) for fan in signature.fans)):
        return None
    if len(signature.fans) != len(regular_signature(scheme).fans):
        return None
    points = _lattice_points(scheme, signature)
    stencils = dict(zip(points, np.eye(len(points)), strict=True))
    lattice = [tuple(point) for point in scheme.regular_lattice]
    # Phantom points across one border come first; those across both borders at a corner are computed from them.
    while missing := [point for point in lattice if point not in stencils]:
        phantom = {point: row for point in missing if (row := _phantom_point(scheme, stencils, point)) is not None}
        if not phantom:
            raise SchemeError(
                f"{scheme.name}: the phantom points give no control point at {missing[0]} of a regular patch"
            )
        stencils |= phantom
    return np.array([stencils[point] for point in lattice])


def _phantom_point(scheme: Scheme, stencils: dict, point: tuple[float, float]) -> FloatArray | None:
    """Return the stencil of a lattice point beyond the border, or None if it needs points that are not known yet."""
    for phantom in scheme.phantom_points or ():
        sources = [(point[0] + x, point[1] + y) for x, y in phantom.offsets]
        if all(source in stencils for source in sources):
            return sum(weight * stencils[source] for weight, source in zip(phantom.weights, sources, strict=True))
    return None


def _is_regular_fan(scheme: Scheme, fan: Fan) -> bool:
    if fan.is_inside:
        return fan == _regular_fan(scheme)
    if fan.behind is None or fan.rule == VertexRule.DART or fan.is_semi_sharp:
        return False
    face_count = 1 if fan.rule == VertexRule.CORNER else scheme.regular_border_faces
    return fan.ahead + fan.behind == (scheme.regular_face_size,) * face_count


def _lattice_points(scheme: Scheme, signature: Signature) -> list[tuple[float, float]]:
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
