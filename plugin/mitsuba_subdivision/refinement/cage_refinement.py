"""Refinement of a control cage: a cage with the same limit surface and more control points.

A scheme refines the *cut* mesh, in which each crease is a border of the faces on either side. In the refined cage the
copies of vertices are merged again, and tags reproduce the cut. This is verified: the cut mesh of the refined cage must
equal the refined cut mesh, half-edge by half-edge, with the same rules and sharpness. Then all further refinements are
equal, and so are the limit surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..cage.contents import RULES, CageContents
from ..cage.control_cage import ControlCage
from ..cage.errors import CageError, CageSource, without_warnings
from ..mesh import ragged
from ..mesh.connectivity import INFINITE, IntArray, VertexRule
from ..mesh.cuts import Sharpness
from ..schemes import Scheme, SchemeError
from ..schemes.scheme import Refinement
from .adapted_scheme import adapted_scheme
from .refined_corners import VERTEX, RefinedCorners, common_mode, differences, refined_attributes

if TYPE_CHECKING:
    from scipy import sparse

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


def refine_cage(
    cage: ControlCage,
    chosen: str | Scheme | None,  # As for `adapted_scheme`. If not None, it becomes the refined cage's scheme.
) -> CageRefinement:
    """Refine a cage once.

    Raises CageError if no cage represents the refined surface, or the refined values of an attribute. Raises
    SchemeError if the scheme does not order refined faces as Catmull-Clark, Loop or Doo-Sabin do, or does not support
    an attribute.
    """
    scheme = adapted_scheme(cage, chosen)
    contents = CageContents(
        positions=cage.positions,
        face_sizes=cage.face_sizes,
        face_vertices=cage.face_vertices,
        rules={name: getattr(cage, name) for name in RULES},
        scheme=cage.scheme if chosen is None else scheme.name,
        source=CageSource(f"{cage.source.name}, refined"),
    )
    return (_dual if scheme.element == "vertex" else _primal)(cage, scheme, contents)


def _primal(cage: ControlCage, scheme: Scheme, contents: CageContents) -> CageRefinement:
    """Refine a cage with a scheme whose elements are faces."""
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
        raise CageError(
            f'{cage.source.name}: boundary "{cage.boundary}" would make other holes of the refined cage, as a face has '
            "an edge twice; expected none that does"
        )
    if cage.texcoords is not None or cage.attributes:
        attributes, value_meshes = refined_attributes(cage, scheme, refinement, matrix, corners)
        rules = {**contents.rules, "face_varying": common_mode(cage, refined, value_meshes, corners)}
        refined = built(replace(contents, rules=rules, **attributes))
    return CageRefinement(refined, matrix, element, corner)


def _over_control_points(cage: ControlCage, refinement: Refinement, rows: IntArray) -> sparse.csr_array:
    """Return stencils over the cage's control points of refined vertices of the cut mesh, selected by ``rows``."""
    from scipy import sparse

    weights = refinement.stencils.matrix[rows]
    columns, shape = cage.cut_mesh.vertex[weights.indices], (len(rows), cage.vertex_count)
    matrix = sparse.csr_array((weights.data, columns, weights.indptr), shape=shape)
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    return matrix


def _with_tags(
    cage: ControlCage, contents: CageContents, refinement: Refinement, corners: RefinedCorners
) -> tuple[CageContents, ControlCage]:
    """Add tags so that the refined cage has the refined cut mesh. Return the contents and the refined cage.

    Raises CageError if there are no such tags.
    """
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
        raise CageError(
            f"{where} and another face share two edges or more, so that refined edges would have the same two ends; "
            f"expected faces that share one edge at most ({is_wrong.sum()} such refined half-edges)"
        )
    return contents, refined


def _refined_sharpness(tags: Sharpness, refinement: Refinement, corners: RefinedCorners) -> Sharpness:
    """Return the sharpness of the refined cage: finite sharpness is lowered."""
    semi = refinement.topology.semi_sharpness
    edges = np.zeros(refinement.topology.half_edge_count) if semi is None else semi.edges.copy()
    # Halves of coarse edges begin or end at a coarse vertex.
    is_half = (corners.kind == VERTEX) | (corners.kind[corners.refined.next] == VERTEX)
    edges[is_half & tags.is_infinite[corners.half_edge]] = INFINITE
    vertices = np.zeros(len(corners.copies))
    vertices[: len(tags.vertices)] = np.where(tags.is_corner, INFINITE, np.maximum(tags.vertices - 1, 0))
    return Sharpness(edges, vertices)


def built(contents: CageContents) -> ControlCage:
    """Build a cage without warnings, as problems that cause warnings were already in the coarse cage."""
    with without_warnings():
        return ControlCage.from_arrays(**contents.as_arguments())


def _dual(cage: ControlCage, scheme: Scheme, contents: CageContents) -> CageRefinement:
    """Refine a cage with Doo-Sabin, whose elements are vertices, and whose refined vertices belong to face corners."""
    cut = cage.cut_mesh.topology.with_rules(None, None)
    refinement = scheme.refine(cut)
    t = refinement.topology
    if t.vertex_count != cut.half_edge_count:
        raise SchemeError(
            f"{cage.source.name}: the scheme {scheme.name} numbers refined vertices in a way of its own; expected one "
            "for each face corner, as Doo-Sabin has"
        )
    matrix = _over_control_points(cage, refinement, np.arange(t.vertex_count))
    attributes, _ = refined_attributes(cage, scheme, refinement, matrix, None)
    refined = built(
        replace(
            contents,
            positions=matrix @ cage.positions,
            face_sizes=t.face_sizes,
            face_vertices=t.face_vertices,
            **attributes,
        )
    )
    element, corner = np.full((2, t.vertex_count), -1, dtype=np.int64)
    offsets, half_edges = cut.vertex_fans
    element[half_edges] = cut.face_vertices[half_edges]
    corner[half_edges] = ragged.index_in_row(np.diff(offsets))
    return CageRefinement(refined, matrix, element, corner)
