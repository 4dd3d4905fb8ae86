"""Texture coordinates and attributes of a refined cage, and the comparison of refined meshes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import RULES, Attribute
from ..cage.control_cage import ControlCage
from ..cage.errors import CageError, shortened
from ..mesh.connectivity import IntArray, Topology, VertexRule
from ..mesh.seams import seams, value_mesh
from ..schemes import Scheme, SchemeError
from ..schemes.scheme import Refinement
from .refined_corners import RefinedCorners

if TYPE_CHECKING:
    from scipy import sparse

TEXCOORDS = "texcoords"
RefinedAttributes = tuple[Attribute | None, dict[str, Attribute]]

# Tolerance when comparing sharpness. Chaikin's method averages a few numbers below ten, whose order may differ.
MEAN_TOLERANCE = 1e-13
# Number of decimals of sharpness across cuts when comparing rows.
DECIMALS = 12
BoolArray = NDArray[np.bool_]


def refined_attributes(
    cage: ControlCage,
    refined: ControlCage,  # The refined cage with all tags, without attributes
    scheme: Scheme,
    refinement: Refinement,  # Refinement of the cut mesh
    matrix: sparse.csr_array,  # (n, n_v) weights of the refined cage's vertices over the cage's
    corners: RefinedCorners,
) -> tuple[str, Attribute | None, dict[str, Attribute]]:
    """Refine texture coordinates and attributes with a scheme whose elements are faces.

    Whether face-varying values are corners depends on the seams at a vertex, and may differ in the refined cage. Then
    the refined cage gets another face-varying rule that has the same corners.

    Raises CageError if no rule has the same corners. Raises SchemeError if an attribute has seams and the scheme does
    not support them.

    Returns the face-varying rule for the refined cage, its texture coordinates and its attributes.
    """
    attributes: dict[str, Attribute] = {}
    subdivided: dict[str, _RefinedValues] = {}
    for name, attribute in _named(cage).items():
        values, indices = attribute.values, attribute.indices
        if attribute.interpolation == "vertex":
            attributes[name] = Attribute(matrix @ values)
        elif indices is None:
            # Unused vertices keep their values.
            varying = np.zeros((refined.vertex_count, values.shape[1]))
            varying[: len(values)] = values
            varying[corners.vertex] = corners.linear(values[cage.face_vertices])
            attributes[name] = Attribute(varying, "varying")
        else:
            first, new_indices = corners.values(indices)
            if cage.face_varying == "all":
                corner_values: NDArray[np.floating] = corners.linear(values[indices])
            else:
                subdivided[name] = _RefinedValues.of(name, cage, scheme, refinement, indices, corners, new_indices)
                corner_values = subdivided[name].at_corners(values)
            attributes[name] = Attribute(corner_values[first], "face_varying", new_indices)
    mode = _common_mode(cage, refined, subdivided, corners)
    return mode, attributes.pop(TEXCOORDS, None), attributes


def dual_attributes(
    cage: ControlCage, scheme: Scheme, refinement: Refinement, matrix: sparse.csr_array
) -> RefinedAttributes:
    """Refine texture coordinates and attributes with Doo-Sabin, which subdivides them like points.

    Raises SchemeError if one is interpolated linearly, or has seams.
    """
    attributes: dict[str, Attribute] = {}
    for name, attribute in _named(cage).items():
        values, indices = attribute.values, attribute.indices
        if attribute.interpolation == "vertex":
            attributes[name] = Attribute(matrix @ values)
            continue
        if indices is None or cage.face_varying == "all" or seams(cage.topology, indices).any():
            raise SchemeError(
                f'{cage.source.name}: the scheme {scheme.name} has no rules for the attribute "{shortened(name)}"; '
                "expected one that is subdivided as points are, without seams"
            )
        row = np.zeros(cage.cut_mesh.topology.vertex_count, dtype=np.int64)
        row[cage.cut_mesh.topology.face_vertices] = indices
        attributes[name] = Attribute(refinement.apply(values[row]), "face_varying", refinement.topology.face_vertices)
    return attributes.pop(TEXCOORDS, None), attributes


def _named(cage: ControlCage) -> dict[str, Attribute]:
    return {**({} if cage.texcoords is None else {TEXCOORDS: cage.texcoords}), **cage.attributes}


@dataclass(frozen=True, eq=False)
class _RefinedValues:
    """The refinement of face-varying values that are subdivided."""

    value_index: IntArray  # (n_v,) int64: index of the attribute's value at each vertex of the value mesh
    refinement: Refinement  # Refinement of the value mesh
    # (n_c,) bool: whether a refined corner is the edge point of a border edge between two corners, which does not move
    stays: NDArray[np.bool_]
    indices: IntArray  # (n_c,) int64: index of the refined value at each refined corner

    @classmethod
    def of(
        cls,
        name: str,
        cage: ControlCage,
        scheme: Scheme,
        refinement: Refinement,
        indices: IntArray,
        corners: RefinedCorners,
        new_indices: IntArray,
    ) -> _RefinedValues:
        t, value_index = value_mesh(cage.sharp_mesh, cage.face_varying, indices)
        if not scheme.has_phantom_points and ((t.twin < 0).any() or t.vertex_rules.any()):
            raise SchemeError(
                f"{cage.source.name}: the scheme {scheme.name} has no rules for seams, as of the attribute "
                f'"{shortened(name)}"; expected an attribute without seams, or face_varying "all"'
            )
        value_refinement = refinement if t is cage.cut_mesh.topology else scheme.refine(t)
        stays = corners.at_ends(t.vertex_rules == VertexRule.CORNER, t)
        return cls(value_index, value_refinement, stays, new_indices)

    def at_corners(self, values: NDArray[np.float64]) -> NDArray[np.floating]:
        """Return ``(n_c, k)`` refined values at refined corners."""
        return self.refinement.apply(values[self.value_index])[self.refinement.topology.face_vertices]

    def differs(self, topology: Topology) -> NDArray[np.bool_]:
        """Return ``(n_c,)``: where a value mesh of the refined cage differs from the refined value mesh."""
        is_joined, is_torn, has_other_rule, is_sharper = differences(self.refinement.topology, topology)
        is_corner = (topology.vertex_rules == VertexRule.CORNER)[topology.face_vertices]
        return is_joined | is_torn | (has_other_rule & ~(self.stays & is_corner)) | is_sharper


def _common_mode(
    cage: ControlCage, refined: ControlCage, subdivided: dict[str, _RefinedValues], corners: RefinedCorners
) -> str:
    """Return the face-varying rule for which the refined cage has the refined value meshes, if possible the cage's."""
    cage_mode = cage.face_varying
    wrong = _first_wrong(refined, cage_mode, subdivided)
    if wrong is None:
        return cage_mode
    for mode in RULES["face_varying"]:
        if mode not in (cage_mode, "all") and _first_wrong(refined, mode, subdivided) is None:
            return mode
    name, corner = wrong
    where = cage.source.at_face(int(cage.topology.face[corners.half_edge[corner]]))
    raise CageError(
        f'{where}: the attribute "{shortened(name)}" has corners and borders along seams that no face_varying rule '
        "gives the refined cage, as they come from semi-sharp features of unequal sharpness on both sides of a seam; "
        f'expected face_varying "all", or an attribute without such seams (now "{cage_mode}")'
    )


def _first_wrong(refined: ControlCage, mode: str, subdivided: dict[str, _RefinedValues]) -> tuple[str, int] | None:
    """Return the first attribute and refined corner at which the value mesh differs; None if all are equal."""
    for name, values in subdivided.items():
        wrong = values.differs(value_mesh(refined.sharp_mesh, mode, values.indices)[0])
        if wrong.any():
            return name, int(np.argmax(wrong))
    return None


def differences(expected: Topology, found: Topology) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
    """Compare two meshes, half-edge by half-edge. Meshes without differences have equal refinements.

    Returns four (n_h,) bool arrays. For each half-edge of ``found``: whether it has an unexpected twin; whether it
    lacks the expected twin; whether its origin has another `VertexRule`; and whether the semi-sharpness of its edge or
    at its origin differs.
    """
    is_other = expected.twin != found.twin
    has_other_rule = expected.vertex_rules[expected.face_vertices] != found.vertex_rules[found.face_vertices]
    is_sharper = (np.abs(_sharpness(expected) - _sharpness(found)) > MEAN_TOLERANCE).any(axis=0)
    is_sharper |= _differs_across(expected, found)
    return is_other & (found.twin >= 0), is_other & (expected.twin >= 0), has_other_rule, is_sharper


def _sharpness(t: Topology) -> NDArray[np.float64]:
    """Return ``(3, n_h)`` sharpness of each half-edge's edge, of the refined half at its origin, and of its origin."""
    semi = t.semi_sharpness
    if semi is None:
        return np.zeros((3, t.half_edge_count))
    return np.stack([semi.edges, semi.edges_refined, semi.vertices[t.face_vertices]])


def _differs_across(expected: Topology, found: Topology) -> NDArray[np.bool_]:
    """Return ``(n_h,)``: whether semi-sharp edges across cuts differ at the origin of each half-edge."""
    expected_rows, found_rows = _rows_across(expected), _rows_across(found)
    rows, which = np.unique(np.concatenate([expected_rows, found_rows]), axis=0, return_inverse=True)
    signs = np.repeat([1, -1], [len(expected_rows), len(found_rows)])
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
