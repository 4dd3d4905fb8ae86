"""Face corners of a refined mesh: their parents in the cage, values of attributes, and the comparison of meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import RULES, Attribute
from ..cage.control_cage import ControlCage
from ..cage.errors import CageError, shortened
from ..mesh.connectivity import IntArray, Topology, VertexRule
from ..mesh.cuts import value_mesh
from ..mesh.manifold import is_later
from ..schemes import Scheme, SchemeError
from ..schemes.scheme import Refinement
from .adapted_scheme import subdivided_values

if TYPE_CHECKING:
    from scipy import sparse

TEXCOORDS = "texcoords"

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


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """The face corners, or half-edges, of the refined cut mesh of a cage.

    The first faces are those at the coarse corners, listed from the coarse vertex on. Then come, under Loop, the middle
    triangles, whose corners are edge points.
    """

    cage: ControlCage
    refined: Topology  # The refined cut mesh
    kind: IntArray  # (n_c,) int: whether the parent of each refined corner is a VERTEX, an EDGE or a FACE
    # (n_c,) int: a half-edge of the cage that begins at the parent vertex, is along the parent edge or in the parent
    # face
    half_edge: IntArray

    @classmethod
    def of(cls, cage: ControlCage, scheme: Scheme, refined: Topology) -> RefinedCorners:
        """Find the parent of each corner.

        Raises SchemeError if the scheme orders refined faces differently.
        """
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
            raise SchemeError(
                f"{cage.source.name}: the scheme {scheme.name} numbers refined faces in a way of its own; expected one "
                "that refines as Catmull-Clark, Loop or Doo-Sabin do"
            )
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

    def values(
        self,
        indices: IntArray,  # (n_h,) int: index of the attribute's value at each face corner of the cage
    ) -> tuple[IntArray, IntArray]:
        """Determine the distinct refined values of a face-varying attribute.

        Refined corners share a value if they are at the same vertex of the refined cage and depend on the same values:
        that at the coarse vertex, or those at both ends of the edge.

        Returns (n,) int64, a refined corner with each value, and (n_c,) int64, the index of the value at each refined
        corner.
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
        """Return ``(n_c,)``: whether a corner is the edge point of a border edge between two corners of a coarse mesh.

        It does not move in later refinements, like a corner.
        """
        h, t = self.half_edge, topology
        is_corner = t.vertex_rules[t.face_vertices] == VertexRule.CORNER
        return (self.kind == EDGE) & (t.twin[h] < 0) & is_corner[h] & is_corner[t.next[h]]


def _are_one_to_one(one: IntArray, other: IntArray) -> bool:
    """Return whether two arrays of labels define the same partition."""
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
    """Refine texture coordinates and attributes.

    Raises SchemeError if the scheme does not support the interpolation of an attribute, or its seams.

    Returns ``texcoords`` and ``attributes`` of the refined cage, and the value meshes of attributes with seams.
    """
    attributes: dict[str, Attribute] = {}
    value_meshes: dict[str, ValueMesh] = {}
    given = cage.attributes if cage.texcoords is None else {TEXCOORDS: cage.texcoords, **cage.attributes}
    for name, attribute in given.items():
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

    Whether face-varying values are corners depends on the seams at a vertex, and may differ in the refined cage. Then
    it gets another rule that has the same corners. Raises CageError if there is none.
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


def differences(
    expected: Topology,
    other: Topology,
    stays: BoolArray,  # (n_h,) bool: half-edges whose origin does not move, so that it may be a corner
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Compare two meshes, half-edge by half-edge. Meshes without differences have equal refinements.

    Returns three (n_h,) bool arrays. For each half-edge of ``other``: whether it has an unexpected twin; whether its
    origin has another `VertexRule`; and whether there is any difference, in these, or in the semi-sharpness of its edge
    or at its origin.
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

    Edges that do not sharpen their vertex only contribute to averages. They are omitted at vertices without averages.
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
