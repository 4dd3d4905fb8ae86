"""Texture coordinates and attributes of a refined cage, and how its limit surface may differ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage.attributes import Attribute
from ..cage.control_cage import ControlCage
from ..cage.errors import CageError, shortened
from ..cage.rules import RULES
from ..mesh.connectivity import IntArray, Topology, VertexRule
from ..mesh.seams import seams, value_mesh
from ..schemes import Scheme, SchemeError
from ..schemes.scheme import Refinement
from .refined_corners import RefinedCorners

if TYPE_CHECKING:
    from scipy import sparse

TEXCOORDS = "texcoords"
RefinedAttributes = tuple[Attribute | None, dict[str, Attribute]]

# Chaikin's method takes means of a few numbers below ten, whose order may differ.
MEAN_TOLERANCE = 1e-13
DECIMALS = 12
BoolArray = NDArray[np.bool_]


def refined_attributes(
    # The refined one without attributes, but with all tags
    cage: ControlCage,
    refined: ControlCage,
    scheme: Scheme,
    refinement: Refinement,  # Of the cut mesh
    matrix: sparse.csr_array,  # (n, n_v) sparse array: the refined cage's vertices over the cage's
    corners: RefinedCorners,
) -> tuple[str, Attribute | None, dict[str, Attribute]]:
    """Refine texture coordinates and attributes under a scheme whose elements are faces.

    Face-varying values are corners by conditions on the seams that meet at a vertex, which may come out otherwise in
    the refined cage: then the cage gets another rule, if one has the same corners.

    Raises CageError if no rule makes the same corners. Raises SchemeError if the scheme has no rules for seams, and an
    attribute has some.

    Returns the face-varying rule for the refined cage, its texture coordinates and its attributes.
    """
    found: dict[str, Attribute] = {}
    subdivided: dict[str, _RefinedValues] = {}
    for name, attribute in _named(cage).items():
        values, indices = attribute.values, attribute.indices
        if attribute.interpolation == "vertex":
            found[name] = Attribute(matrix @ values)
        elif indices is None:
            # Vertices of no face keep their values.
            varying = np.zeros((refined.vertex_count, values.shape[1]))
            varying[: len(values)] = values
            varying[corners.vertex] = corners.linear(values[cage.face_vertices])
            found[name] = Attribute(varying, "varying")
        else:
            first, new_indices = corners.values(indices)
            if cage.face_varying == "all":
                at_corners: NDArray[np.floating] = corners.linear(values[indices])
            else:
                subdivided[name] = _RefinedValues.of(name, cage, scheme, refinement, indices, corners, new_indices)
                at_corners = subdivided[name].at_corners(values)
            found[name] = Attribute(at_corners[first], "face_varying", new_indices)
    mode = _common_mode(cage, refined, subdivided, corners)
    return mode, found.pop(TEXCOORDS, None), found


def dual_attributes(
    cage: ControlCage, scheme: Scheme, refinement: Refinement, matrix: sparse.csr_array
) -> RefinedAttributes:
    """Refine texture coordinates and attributes under Doo-Sabin, where they are subdivided as points are.

    Raises SchemeError if one is interpolated linearly, or has seams.
    """
    found: dict[str, Attribute] = {}
    for name, attribute in _named(cage).items():
        values, indices = attribute.values, attribute.indices
        if attribute.interpolation == "vertex":
            found[name] = Attribute(matrix @ values)
            continue
        if indices is None or cage.face_varying == "all" or seams(cage.topology, indices).any():
            raise SchemeError(
                f'{cage.source.name}: the scheme {scheme.name} has no rules for the attribute "{shortened(name)}"; '
                "expected one that is subdivided as points are, without seams"
            )
        row = np.zeros(cage.cut_mesh.topology.vertex_count, dtype=np.int64)
        row[cage.cut_mesh.topology.face_vertices] = indices
        found[name] = Attribute(refinement.apply(values[row]), "face_varying", refinement.topology.face_vertices)
    return found.pop(TEXCOORDS, None), found


def _named(cage: ControlCage) -> dict[str, Attribute]:
    return {**({} if cage.texcoords is None else {TEXCOORDS: cage.texcoords}), **cage.attributes}


@dataclass(frozen=True, eq=False)
class _RefinedValues:
    """Face-varying values that are subdivided, refined once."""

    value_index: IntArray  # (n_v,) int64: of the attribute's values at each vertex of the value mesh
    refinement: Refinement  # Of the value mesh
    # (n_c,) bool: whether a refined corner is in the middle of a border between two corners: where it stays, as a
    # corner does
    stays: NDArray[np.bool_]
    indices: IntArray  # (n_c,) int64: of the refined values

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
        own = refinement if t is cage.cut_mesh.topology else scheme.refine(t)
        stays = corners.at_ends(t.vertex_rules == VertexRule.CORNER, t)
        return cls(value_index, own, stays, new_indices)

    def at_corners(self, values: NDArray[np.float64]) -> NDArray[np.floating]:
        """``(n_c, k)`` refined values at refined corners."""
        return self.refinement.apply(values[self.value_index])[self.refinement.topology.face_vertices]

    def differs(self, found: Topology) -> NDArray[np.bool_]:
        """``(n_c,)`` where the refined cage's value mesh is another one than the refined value mesh."""
        is_joined, is_torn, has_other_rule, is_sharper = differences(self.refinement.topology, found)
        is_corner = (found.vertex_rules == VertexRule.CORNER)[found.face_vertices]
        return is_joined | is_torn | (has_other_rule & ~(self.stays & is_corner)) | is_sharper


def _common_mode(
    cage: ControlCage, refined: ControlCage, subdivided: dict[str, _RefinedValues], corners: RefinedCorners
) -> str:
    """The rule, the cage's own if possible, under which the refined cage's value meshes are the refined ones."""
    own = cage.face_varying
    wrong = _first_wrong(refined, own, subdivided)
    if wrong is None:
        return own
    for mode in RULES["face_varying"]:
        if mode not in (own, "all") and _first_wrong(refined, mode, subdivided) is None:
            return mode
    name, corner = wrong
    where = cage.source.at_face(int(cage.topology.face[corners.half_edge[corner]]))
    raise CageError(
        f'{where}: the attribute "{shortened(name)}" has corners and borders along seams that no face_varying rule '
        "gives the refined cage, as they come from semi-sharp features of unequal sharpness on both sides of a seam; "
        f'expected face_varying "all", or an attribute without such seams (now "{own}")'
    )


def _first_wrong(refined: ControlCage, mode: str, subdivided: dict[str, _RefinedValues]) -> tuple[str, int] | None:
    """The first attribute and refined corner at which a rule makes another value mesh; None if all agree."""
    for name, values in subdivided.items():
        wrong = values.differs(value_mesh(refined.sharp_mesh, mode, values.indices)[0])
        if wrong.any():
            return name, int(np.argmax(wrong))
    return None


def differences(expected: Topology, found: Topology) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
    """Compare two meshes, half-edge by half-edge. Without differences refinement does the same to both.

    Returns, each (n_h,) bool, whether a half-edge of the found mesh has a twin that is not expected; whether it lacks
    the expected one; whether the vertex at its beginning has another `VertexRule`; and whether semi-sharpness of its
    edge, or at the vertex at its beginning, is another one.
    """
    is_other = expected.twin != found.twin
    has_other_rule = expected.vertex_rules[expected.face_vertices] != found.vertex_rules[found.face_vertices]
    is_sharper = (np.abs(_sharpness(expected) - _sharpness(found)) > MEAN_TOLERANCE).any(axis=0)
    is_sharper |= _differs_across(expected, found)
    return is_other & (found.twin >= 0), is_other & (expected.twin >= 0), has_other_rule, is_sharper


def _sharpness(t: Topology) -> NDArray[np.float64]:
    """``(3, n_h)`` of each half-edge's edge, of its half after a refinement, and of the vertex at its beginning."""
    semi = t.semi_sharpness
    if semi is None:
        return np.zeros((3, t.half_edge_count))
    return np.stack([semi.edges, semi.edges_refined, semi.vertices[t.face_vertices]])


def _differs_across(expected: Topology, found: Topology) -> NDArray[np.bool_]:
    """``(n_h,)`` whether the vertex at the beginning of each half-edge has other semi-sharp edges across cuts."""
    one, other = _rows_across(expected), _rows_across(found)
    rows, which = np.unique(np.concatenate([one, other]), axis=0, return_inverse=True)
    surplus = np.bincount(which.ravel(), np.repeat([1, -1], [len(one), len(other)]), minlength=len(rows))
    at = rows[surplus != 0, 0].astype(np.int64)
    return np.isin(expected.face_vertices, expected.face_vertices[at])


def _rows_across(t: Topology) -> NDArray[np.float64]:
    """``(n, 4)`` edges across cuts: lowest half-edge of the vertex, sharpness, refined sharpness, whether it sharpens.

    Edges that do not sharpen a vertex take part in means only. They are left out where nothing has a mean.
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
