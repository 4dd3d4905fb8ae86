"""Refinement of a control cage: a cage with the same limit surface and more control points.

A scheme refines the *cut* mesh, in which each crease is a border of the faces on either side. In the refined cage the
copies of vertices are merged again, and tags reproduce the cut. This is verified: the cut mesh of the refined cage must
equal the refined cut mesh, half-edge by half-edge, with the same rules and sharpness. Then all further refinements are
equal, and so are the limit surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..cage.contents import RULES, TEXCOORDS, Attribute, CageContents, attributes_by_name
from ..cage.control_cage import ControlCage, cage_of
from ..cage.errors import CageError, CageSource, shortened, without_warnings
from ..mesh import ragged
from ..mesh.connectivity import INFINITE, IntArray, Topology, VertexRule
from ..mesh.cuts import Sharpness, value_mesh
from ..mesh.manifold import is_later
from ..schemes import Refinement, Scheme, SchemeError
from .adapted_scheme import adapted_scheme, subdivided_values

# Tolerance when comparing sharpness. Chaikin's method averages a few numbers below ten, whose order may differ.
MEAN_TOLERANCE = 1e-13
# Number of decimals of sharpness across cuts when comparing rows.
DECIMALS = 12
BoolArray = NDArray[np.bool_]
# The refined mesh of an attribute's values; `RefinedCorners.between_corners`; and (n_c,) int64: index of the refined
# value at each refined corner.
ValueMesh = tuple[Topology, BoolArray, IntArray]
# Kinds of parents of a refined vertex.
VERTEX, EDGE, FACE = range(3)
# Maximum number of iterations of `_with_tags`. One may add creases, the next one corners that depend on these creases.
MOST_REPAIRS = 3


@dataclass(frozen=True, eq=False)
class CageRefinement:
    """A refined cage, and the maps from the coarse cage to it.

    Attributes
    ----------
    cage : ControlCage
        The refined cage, with the same limit surface, texture coordinates and attributes. Under Catmull-Clark and Loop
        its vertices are those of the coarse cage, with the same indices, then one for each edge, then, under
        Catmull-Clark, one for each face. Under Doo-Sabin there is one for each face corner.
    matrix : (n, n_v) CSR array of float64
        Weights of the refined control points over the coarse ones; rows sum to one.
    element : (n_e,) int64
        For each element of the refined cage, the coarse element that contains it; under Doo-Sabin, -1 for a vertex
        without an element. Elements are faces, under Doo-Sabin vertices, as for `LimitSurface.evaluate`.
    corner : (n_e,) int64
        The 0-based corner of the coarse element at which the refined element lies. With (0, 0) at this corner, and at
        corner 0 of the refined element, the coarse parameters are half the refined ones; they are equal if the coarse
        element does not have four corners, under Loop three. Under Loop, -1 for the triangle in the middle: there the
        coarse parameters, from corner 0, are ``((1 - u) / 2, (1 - v) / 2)``, with ``(u, v)`` from corner 1.
    """

    cage: ControlCage
    matrix: sparse.csr_array
    element: IntArray
    corner: IntArray


def refine_cage(cage: ControlCage, chosen: str | Scheme | None) -> CageRefinement:
    """Refine a cage once, by a scheme as of `adapted_scheme`; the refined cage names the chosen one.

    Raises CageError and SchemeError as `ControlCage.refinement`.
    """
    scheme = adapted_scheme(cage, chosen)
    named, source = cage.scheme if chosen is None else scheme.name, CageSource(f"{cage.source.name}, refined")
    contents = replace(cage.contents, texcoords=None, attributes={}, materials={}, scheme=named, source=source)
    return (_dual if scheme.element == "vertex" else _primal)(cage, scheme, contents)


def _primal(cage: ControlCage, scheme: Scheme, contents: CageContents) -> CageRefinement:
    refinement = scheme.refine(cage.cut_mesh.topology)
    corners = RefinedCorners.of(cage, scheme, refinement.topology)
    matrix = _over_control_points(cage, refinement, corners.copies)
    t, first = cage.topology, refinement.topology.face_offsets[:-1]
    half_edge = corners.half_edge[first].astype(np.int64)
    element = t.face[half_edge].astype(np.int64)
    corner = np.where(corners.kind[first] == VERTEX, half_edge - t.face_offsets[element], -1)
    contents = replace(
        contents,
        positions=matrix @ cage.positions,
        face_sizes=refinement.topology.face_sizes,
        face_vertices=corners.vertex,
        holes=np.flatnonzero(cage.is_hole[element]),
        materials={name: np.flatnonzero(np.isin(element, faces)) for name, faces in cage.materials.items()},
    )
    contents, refined = _with_tags(cage, contents, refinement, corners)
    if not np.array_equal(refined.is_hole, cage.is_hole[element]):
        problem = "would give the refined cage other holes, as a face has an edge twice; expected another boundary"
        raise CageError(f'{cage.source.name}: boundary "{cage.boundary}" {problem}')
    if cage.texcoords is not None or cage.attributes:
        attributes, value_meshes = refined_attributes(cage, scheme, refinement, matrix, corners)
        rules = {**contents.rules, "face_varying": common_mode(cage, refined, value_meshes, corners)}
        refined = built(replace(contents, rules=rules, **attributes))
    return CageRefinement(refined, matrix, element, corner)


def _over_control_points(cage: ControlCage, refinement: Refinement, rows: IntArray) -> sparse.csr_array:
    """Return stencils over the cage's control points of refined vertices of the cut mesh, selected by ``rows``."""
    weights = refinement.stencils.matrix[rows]
    columns, shape = cage.cut_mesh.vertex[weights.indices], (len(rows), cage.vertex_count)
    matrix = sparse.csr_array((weights.data, columns, weights.indptr), shape=shape)
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    return matrix


def _with_tags(
    cage: ControlCage, contents: CageContents, refinement: Refinement, corners: RefinedCorners
) -> tuple[CageContents, ControlCage]:
    """Add tags so that the refined cage has the refined cut mesh; return its contents, and itself."""
    expected = refinement.topology
    sharpness = _refined_sharpness(cage.tags, refinement, corners)
    stays = corners.between_corners(cage.cut_mesh.topology)
    rules = expected.vertex_rules[expected.face_vertices]
    for _ in range(MOST_REPAIRS):
        sharp = np.flatnonzero(sharpness.edges)
        ends = corners.vertex[sharp], corners.vertex[expected.next[sharp]]
        creases = np.stack([*ends, sharpness.edges[sharp]], axis=1)
        contents = replace(contents, creases=creases, corners=sharpness.corners())
        refined = built(contents)
        is_joined, has_other_rule, is_wrong = differences(expected, refined.cut_mesh.topology, stays)
        is_missing = has_other_rule & (stays | (rules == VertexRule.CORNER))
        if not (is_joined.any() or is_missing.any()):
            break
        sharpness.edges[is_joined] = INFINITE
        sharpness.vertices[corners.vertex[is_missing]] = INFINITE
    if is_wrong.any():
        where = cage.source.at_face(int(cage.topology.face[corners.half_edge[np.argmax(is_wrong)]]))
        problem = "share two edges or more, so that refined edges would have the same two ends"
        hint = f"expected faces that share one edge at most ({is_wrong.sum()} such refined half-edges)"
        raise CageError(f"{where} and another face {problem}; {hint}")
    return contents, refined


def _refined_sharpness(tags: Sharpness, refinement: Refinement, corners: RefinedCorners) -> Sharpness:
    semi = refinement.topology.semi_sharpness
    edges = np.zeros(refinement.topology.half_edge_count) if semi is None else semi.edges.copy()
    # Halves of coarse edges begin or end at a coarse vertex.
    is_half = (corners.kind == VERTEX) | (corners.kind[corners.refined.next] == VERTEX)
    edges[is_half & tags.is_infinite[corners.half_edge]] = INFINITE
    vertices = np.zeros(len(corners.copies))
    vertices[: len(tags.vertices)] = np.where(tags.is_corner, INFINITE, np.maximum(tags.vertices - 1, 0))
    return Sharpness(edges, vertices)


def built(contents: CageContents) -> ControlCage:
    """Build a cage without warnings."""
    # Problems that cause warnings were already in the coarse cage.
    with without_warnings():
        return cage_of(contents)


def _dual(cage: ControlCage, scheme: Scheme, contents: CageContents) -> CageRefinement:
    # The elements are vertices, and refined vertices belong to face corners.
    cut = cage.cut_mesh.topology.with_rules(None, None)
    refinement = scheme.refine(cut)
    t = refinement.topology
    if t.vertex_count != cut.half_edge_count:
        problem = f"the scheme {scheme.name} numbers refined vertices in a way of its own"
        raise SchemeError(f"{cage.source.name}: {problem}; expected one for each face corner, as Doo-Sabin has")
    matrix = _over_control_points(cage, refinement, np.arange(t.vertex_count))
    attributes, _ = refined_attributes(cage, scheme, refinement, matrix, None)
    contents = replace(contents, positions=matrix @ cage.positions, **attributes)
    refined = built(replace(contents, face_sizes=t.face_sizes, face_vertices=t.face_vertices))
    element, corner = np.full((2, t.vertex_count), -1, dtype=np.int64)
    offsets, half_edges = cut.vertex_fans
    element[half_edges] = cut.face_vertices[half_edges]
    corner[half_edges] = ragged.index_in_row(np.diff(offsets))
    return CageRefinement(refined, matrix, element, corner)


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """The face corners, or half-edges, of the refined cut mesh of a cage.

    Those of the faces at the coarse corners come first, then, under Loop, those of middle triangles, at edge points.
    """

    cage: ControlCage
    refined: Topology  # The refined cut mesh
    kind: IntArray  # (n_c,) int: whether the parent of each refined corner is a VERTEX, an EDGE or a FACE
    # (n_c,) int: a half-edge of the cage that begins at the parent vertex, or is along the parent edge or face
    half_edge: IntArray

    @classmethod
    def of(cls, cage: ControlCage, scheme: Scheme, refined: Topology) -> RefinedCorners:
        """Find the parent of each corner. Raises SchemeError if the scheme orders refined faces differently."""
        t, cut = cage.topology, cage.cut_mesh.topology
        h = np.arange(t.half_edge_count)
        if scheme.splits_corners:
            kind = np.tile([VERTEX, EDGE, FACE, EDGE], len(h))
            half_edge = np.stack([h, h, h, t.prev], axis=1).ravel()
        else:
            kind = np.concatenate([np.tile([VERTEX, EDGE, EDGE], len(h)), np.full(len(h), EDGE)])
            half_edge = np.concatenate([np.stack([h, h, t.prev], axis=1).ravel(), h])
        corners = cls(cage, refined, kind, half_edge)
        # Refined vertices of the cut mesh must correspond one-to-one to its vertices and edges.
        parents = np.where(kind == VERTEX, cut.face_vertices[half_edge], cut.vertex_count + cut.edge[half_edge])
        known = (kind != FACE) & (len(kind) == refined.half_edge_count)
        if not known.any() or not _are_one_to_one(parents[known], refined.face_vertices[known]):
            problem = f"the scheme {scheme.name} numbers refined faces in a way of its own"
            expected = "one that refines as Catmull-Clark, Loop or Doo-Sabin do"
            raise SchemeError(f"{cage.source.name}: {problem}; expected {expected}")
        return corners

    @cached_property
    def edge(self) -> IntArray:
        """``(n_h,)`` edge of each half-edge, equal for all half-edges of a non-manifold edge."""
        non_manifold = self.cage.non_manifold
        return self.cage.topology.edge if non_manifold is None else non_manifold.edge

    @cached_property
    def is_split(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether a face has the edge twice. Its two sides then need separate edge points."""
        t = self.cage.topology
        edge_and_face = self.edge.astype(np.int64) * t.face_count + t.face
        is_double = np.bincount(self.edge, is_later(edge_and_face)) > 0
        return is_double[self.edge]

    @cached_property
    def vertex(self) -> IntArray:
        """``(n_c,)`` vertex of the refined cage at each corner, equal on all sides of a cut."""
        t, h = self.cage.topology, self.half_edge
        count, edge_count = self.cage.vertex_count, int(self.edge.max()) + 1
        split_vertex = count + edge_count + t.face_count + self.refined.face_vertices
        number = np.select(
            [self.kind == VERTEX, self.kind == FACE, self.is_split[h]],
            [t.face_vertices[h], count + edge_count + t.face[h], split_vertex],
            count + self.edge[h],
        )
        is_new = number >= count
        number[is_new] = count + np.unique(number[is_new], return_inverse=True)[1].ravel()
        return number

    @cached_property
    def copies(self) -> IntArray:
        """``(n,)`` a vertex of the refined cut mesh for each vertex of the refined cage; coarse vertices come first."""
        copies = np.arange(max(self.cage.vertex_count, int(self.vertex.max()) + 1))
        is_new = self.vertex >= self.cage.vertex_count
        copies[self.vertex[is_new]] = self.refined.face_vertices[is_new]
        return copies

    def values(self, indices: IntArray) -> tuple[IntArray, IntArray]:
        """Return a refined corner ``(n,)`` with each face-varying value, and the value of each corner ``(n_c,)``.

        Indices ``(n_h,)`` are those of the attribute's values at the cage's face corners. Refined corners share a value
        if they are at the same vertex of the refined cage and depend on the same values: that at the coarse vertex, or
        those at both ends of the edge.
        """
        t, h = self.cage.topology, self.half_edge
        start, end = h, np.where(self.kind == EDGE, t.next[h], h)
        swaps = t.face_vertices[start] > t.face_vertices[end]
        start, end = np.where(swaps, end, start), np.where(swaps, start, end)
        pair = np.where(self.kind == FACE, 0, indices[start] * (int(indices.max()) + 1) + indices[end])
        pairs, number = np.unique(pair, return_inverse=True)
        _, first, refined_indices = np.unique(self.vertex * len(pairs) + number, return_index=True, return_inverse=True)
        return first, refined_indices

    def linear(self, values: NDArray[np.float64]) -> NDArray[np.floating]:
        """Interpolate ``(n_h, k)`` values linearly to refined corners, ``(n_c, k)``: means over edges and faces."""
        t, h = self.cage.topology, self.half_edge
        sums = [np.bincount(t.face, column, minlength=t.face_count) for column in values.T]
        means = np.stack(sums, axis=1) / t.face_sizes[:, None]
        kind = self.kind[:, None]
        along = (values[h] + values[t.next[h]]) / 2
        return np.select([kind == VERTEX, kind == FACE], [values[h], means[t.face[h]]], along)

    def between_corners(self, topology: Topology) -> BoolArray:
        """Return ``(n_c,)``: whether a corner is the point of a border edge between corners, which moves no more."""
        h, t = self.half_edge, topology
        is_corner = t.vertex_rules[t.face_vertices] == VertexRule.CORNER
        return (self.kind == EDGE) & (t.twin[h] < 0) & is_corner[h] & is_corner[t.next[h]]


def _are_one_to_one(one: IntArray, other: IntArray) -> bool:
    to_other, to_one = np.zeros(one.max() + 1, dtype=np.int64), np.zeros(other.max() + 1, dtype=np.int64)
    to_other[one], to_one[other] = other, one
    return np.array_equal(to_other[one], other) and np.array_equal(to_one[other], one)


def refined_attributes(
    cage: ControlCage,
    scheme: Scheme,
    refinement: Refinement,  # Refinement of the cut mesh
    matrix: sparse.csr_array,  # (n, n_v) weights of the refined cage's vertices over the cage's
    corners: RefinedCorners | None,  # None under Doo-Sabin, which subdivides all values like points
) -> tuple[dict[str, Any], dict[str, ValueMesh]]:
    """Refine texture coordinates and attributes; also returns the value meshes of attributes with seams.

    Raises SchemeError if the scheme does not support the interpolation of an attribute, or its seams.
    """
    attributes: dict[str, Attribute] = {}
    value_meshes: dict[str, ValueMesh] = {}
    for name, attribute in attributes_by_name(cage.texcoords, cage.attributes).items():
        values, indices = attribute.values, attribute.indices
        if attribute.interpolation == "vertex":
            attributes[name] = Attribute(matrix @ values)
        elif corners is None:
            t, value_index = subdivided_values(cage, scheme, name, attribute)
            new_values = refinement.apply(values[value_index])
            attributes[name] = Attribute(new_values, "face_varying", refinement.topology.face_vertices)
        elif indices is None:
            # Unused vertices keep their values.
            varying = np.zeros((len(corners.copies), values.shape[1]))
            varying[: len(values)] = values
            varying[corners.vertex] = corners.linear(values[cage.face_vertices])
            attributes[name] = Attribute(varying, "varying")
        else:
            first, new_indices = corners.values(indices)
            if cage.face_varying == "all":
                corner_values: NDArray[np.floating] = corners.linear(values[indices])
            else:
                t, value_index = subdivided_values(cage, scheme, name, attribute)
                of_values = refinement if t is cage.cut_mesh.topology else scheme.refine(t)
                corner_values = of_values.apply(values[value_index])[of_values.topology.face_vertices]
                stays = corners.between_corners(t)
                value_meshes[name] = of_values.topology, stays, new_indices
            attributes[name] = Attribute(corner_values[first], "face_varying", new_indices)
    return {"texcoords": attributes.pop(TEXCOORDS, None), "attributes": attributes}, value_meshes


def common_mode(
    cage: ControlCage,
    refined: ControlCage,  # The refined cage with all tags, without attributes
    value_meshes: dict[str, ValueMesh],
    corners: RefinedCorners,
) -> str:
    """Return the face-varying rule for which the refined cage has the refined value meshes, if possible the cage's.

    Another rule may have the same corners, as these depend on the seams at a vertex. Raises CageError if there is none.
    """
    problems: list[tuple[str, int]] = []
    others = [mode for mode in RULES["face_varying"] if mode not in ("all", cage.face_varying)]
    for mode in (cage.face_varying, *others):
        # The first attribute and refined corner at which the value mesh differs.
        for name, (expected, stays, indices) in value_meshes.items():
            *_, is_wrong = differences(expected, value_mesh(refined.structure, mode, indices)[0], stays)
            if is_wrong.any():
                problems.append((name, int(np.argmax(is_wrong))))
                break
        else:
            return mode
    name, corner = problems[0]
    where = cage.source.at_face(int(cage.topology.face[corners.half_edge[corner]]))
    raise CageError(
        f'{where}: the attribute "{shortened(name)}" has corners and borders along seams that no face_varying rule '
        "gives the refined cage, as they come from semi-sharp features of unequal sharpness on both sides of a seam; "
        f'expected face_varying "all", or an attribute without such seams (now "{cage.face_varying}")'
    )


def differences(expected: Topology, other: Topology, stays: BoolArray) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Compare two meshes, half-edge by half-edge. Meshes without differences have equal refinements.

    The origin of a half-edge that ``stays`` does not move, so that it may be a corner.

    Returns three (n_h,) bool arrays: whether a half-edge of ``other`` has an unexpected twin; whether its origin has
    another `VertexRule`; and whether anything differs, these, or the semi-sharpness of its edge or at its origin.
    """
    has_other_twin = expected.twin != other.twin
    rules = other.vertex_rules[other.face_vertices]
    has_other_rule = expected.vertex_rules[expected.face_vertices] != rules
    has_other_rule &= ~(stays & (rules == VertexRule.CORNER))
    is_sharper = (np.abs(_sharpness(expected) - _sharpness(other)) > MEAN_TOLERANCE).any(axis=0)
    is_wrong = has_other_twin | has_other_rule | is_sharper | _differs_across(expected, other)
    return has_other_twin & (other.twin >= 0), has_other_rule, is_wrong


def _sharpness(t: Topology) -> NDArray[np.float64]:
    """Return ``(3, n_h)`` sharpness of each half-edge's edge, of the refined half at its origin, and of its origin."""
    semi = t.semi_sharpness
    if semi is None:
        return np.zeros((3, t.half_edge_count))
    return np.stack([semi.edges, semi.edges_refined, semi.vertices[t.face_vertices]])


def _differs_across(expected: Topology, other: Topology) -> NDArray[np.bool_]:
    """Return ``(n_h,)``: whether semi-sharp edges across cuts differ at the origin of each half-edge."""
    expected_rows, other_rows = _rows_across(expected), _rows_across(other)
    rows, which = np.unique(np.concatenate([expected_rows, other_rows]), axis=0, return_inverse=True)
    signs = np.repeat([1, -1], [len(expected_rows), len(other_rows)])
    surplus = np.bincount(which.ravel(), signs, minlength=len(rows))
    half_edges = rows[surplus != 0, 0].astype(np.int64)
    return np.isin(expected.face_vertices, expected.face_vertices[half_edges])


def _rows_across(t: Topology) -> NDArray[np.float64]:
    """Return ``(n, 4)`` rows of `SemiSharpness` across cuts: lowest half-edge of the vertex, then the three values.

    Edges that do not sharpen their vertex are omitted where there are no averages to which they contribute.
    """
    semi = t.semi_sharpness
    if semi is None:
        return np.empty((0, 4))
    has_means = np.zeros(t.vertex_count, dtype=bool)
    has_means[t.face_vertices[semi.edges > 0]] = True
    has_means[semi.across_vertex[semi.across_sharpens]] = True
    lowest = t.vertex_half_edge[semi.across_vertex]
    rows = np.stack([lowest, semi.across_sharpness, semi.across_refined, semi.across_sharpens], axis=1)
    return np.asarray(np.round(rows[has_means[semi.across_vertex]], DECIMALS), dtype=np.float64)
