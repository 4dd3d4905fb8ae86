"""Channels: interpolation of a cage's attributes over its elements, and evaluation anywhere on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.contents import Attribute
from ..evaluation.located_samples import limit_stencils
from ..mesh.connectivity import IntArray, Topology, VertexRule
from ..mesh.cuts import seams
from ..mesh.shared import Content, shared_by_key
from ..refinement.adapted_scheme import subdivided_values
from ..schemes import Scheme
from ..schemes.domain import FloatArray
from .patch_samples import PatchSampler, stencil_matrices
from .patch_table import PatchTable

if TYPE_CHECKING:
    from scipy import sparse

# Tolerance when testing that an interpolation is linear: rounding of sums of some tens of weights of order one.
LINEAR = 1e-13


@dataclass(frozen=True, eq=False)
class ChannelLayout:
    """The part of an attribute's interpolation that does not depend on its values.

    Values at mesh vertices are subdivided as points are. Values at face corners are interpolated linearly over each
    element; over a polygon that has a patch at each corner, bilinearly over each patch: the quadrilateral of the
    corner, the midpoints of its two edges and the polygon's centre, as by linear refinement.

    Attributes with equal indices, on cages of the same topology, tags and rules, share a layout while it is referenced.
    """

    # Of the mesh on which values are subdivided, which is cut along seams as well and has the same half-edges as the
    # cage; for linear interpolation, of the surface
    patches: PatchTable
    value_index: IntArray  # (n,) int64: 0-based row of the values at each vertex (subdivided) or face corner (linear)
    seam: NDArray[np.bool_] | None = None  # (n_h,) bool: half-edges of the cage on a seam; None where none is
    is_linear: bool = False

    @classmethod
    def of(
        cls,
        name: str,  # The attribute's name in error messages
        attribute: Attribute,  # Of the cage, validated
        cage: ControlCage,
        scheme: Scheme,
        patches: PatchTable,  # Of the cage's surface; shared by attributes that are subdivided on the same mesh
    ) -> ChannelLayout:
        """Choose the interpolation of an attribute. Raises SchemeError if the scheme has no rules for it."""
        key = cls, cage.structure, scheme, attribute.interpolation, Content(attribute.indices)
        return shared_by_key(key, lambda: _layout_of(name, attribute, cage, scheme, patches))


@dataclass(frozen=True, eq=False)
class Channel:
    """An attribute as a scheme interpolates it over the elements. Samples are given as for `PatchSampler.evaluate`."""

    layout: ChannelLayout
    values: FloatArray  # (n, k) float64

    def evaluate(self, half_edge: IntArray, uv: FloatArray) -> FloatArray:
        """``(s, k)`` values at samples."""
        return self.with_derivatives(half_edge, uv)[0]

    def with_derivatives(self, half_edge: IntArray, uv: FloatArray) -> FloatArray:
        """``(3, s, k)`` values and derivatives by u and v; at extraordinary points tangents, see `SurfaceSamples`."""
        if self.layout.is_linear:
            rows, weights = self._linear_terms(half_edge, uv)
            return np.stack([(w[:, :, None] * self._values_and_centres[rows]).sum(axis=1) for w in weights])
        return np.stack(self._sampler.evaluate(half_edge, uv)[:3])

    def weights(self, half_edge: IntArray, uv: FloatArray) -> sparse.csr_array:
        """``(s, n)`` weights of the values at samples; rows sum to one."""
        if not self.layout.is_linear:
            patches, values = self.layout.patches, (self.layout.value_index, len(self.values))
            return stencil_matrices(patches, half_edge, uv, limit_stencils, 1, *values)[0]
        from scipy import sparse

        rows, (weights, *_) = self._linear_terms(half_edge, uv)
        samples, centres = np.repeat(np.arange(len(uv)), rows.shape[1]), self.with_centres
        at_corners = sparse.csr_array((weights.ravel(), (samples, rows.ravel())), shape=(len(uv), centres.shape[0]))
        return (at_corners @ centres).tocsr()

    @cached_property
    def _sampler(self) -> PatchSampler:
        return PatchSampler(self.layout.patches, self.values, self.layout.value_index)

    @cached_property
    def _values_and_centres(self) -> FloatArray:
        return self.with_centres @ self.values

    @property
    def with_centres(self) -> sparse.csr_array:
        """``(n + n_f, n)`` matrix from linear values to the values followed by their means over each face."""
        from scipy import sparse

        t, count = self.layout.patches.topology, len(self.values)
        entries = np.concatenate([np.ones(count), 1 / t.face_sizes[t.face]])
        rows = np.concatenate([np.arange(count), count + t.face])
        columns = np.concatenate([np.arange(count), self.layout.value_index])
        return sparse.csr_array((entries, (rows, columns)), shape=(count + t.face_count, count))

    @property
    def linear_polynomials(self) -> sparse.csr_array:
        """Matrix from linear values to coefficients of 1, u, v and, on the square, u v, for each half-edge."""
        from scipy import sparse

        half_edges = np.arange(len(self.layout.patches.half_edge_of_corner))
        at_start, at_end = (
            self._linear_terms(half_edges, np.tile(uv, (len(half_edges), 1))) for uv in ((0.0, 0.0), (0.0, 1.0))
        )
        (rows, coefficients), (_, (_, by_u, _)) = at_start, at_end
        if self.layout.patches.scheme.domain.corner_count == 4:
            coefficients = np.concatenate([coefficients, [by_u - coefficients[1]]])
        weights, centres = coefficients.swapaxes(0, 1), self.with_centres
        columns = np.broadcast_to(rows[:, None], weights.shape)
        starts = np.arange(0, weights.size + 1, rows.shape[1])
        of_corners = sparse.csr_array((weights.ravel(), columns.ravel(), starts), (len(starts) - 1, centres.shape[0]))
        return of_corners @ centres

    def _linear_terms(self, half_edge: IntArray, uv: FloatArray) -> tuple[IntArray, FloatArray]:
        """Rows ``(s, m)`` of `with_centres`, and their weights ``(3, s, m)`` in values and derivatives by u and v."""
        t, domain = self.layout.patches.topology, self.layout.patches.scheme.domain
        corners = t.around_faces(self.layout.patches.half_edge_of_corner[half_edge], domain.corner_count - 1)
        rows = self.layout.value_index[np.stack([*corners, t.prev[corners[0]]], axis=1)]
        weights = np.array([domain.corner_weights(*uv.T), *domain.corner_derivatives(*uv.T)]).swapaxes(1, 2)
        face = t.face[corners[0]]
        is_partial = t.face_sizes[face] != domain.corner_count
        if is_partial.any():
            # Corner, midpoint of the edge after it, centre, midpoint of the edge before it. Midpoints pass half of
            # their weights on to the corner.
            rows[is_partial, 2] = len(self.values) + face[is_partial]
            halves = np.where(is_partial[:, None], weights[:, :, [1, -1]] / 2, 0)
            weights[:, :, [1, -1]] -= halves
            weights[:, :, 0] += halves.sum(axis=2)
        return rows, weights


def contracts_alike(
    channel: Channel,
    patches: PatchTable,  # Of the surface
    half_edge: IntArray,  # (s,) int64: half-edges that begin at the points
) -> NDArray[np.bool_]:
    """``(s,)`` whether values are subdivided as points are, so that tangents are the same multiples of derivatives."""
    if channel.layout.is_linear:
        return np.zeros(len(half_edge), dtype=bool)
    if channel.layout.patches is patches:
        return np.ones(len(half_edge), dtype=bool)
    tables = channel.layout.patches, patches
    # For values and for points, rows of the patch class and of the corner of the patch, which determine the fan.
    places = np.array([column for table in tables for column in table.patch_at(half_edge)[::2]])
    distinct, place_index = np.unique(places, axis=1, return_inverse=True)
    fans = (
        [table.classes[class_index].signature.fans[corner] for class_index, corner in distinct[2 * i : 2 * i + 2].T]
        for i, table in enumerate(tables)
    )
    alike = [value_fan == point_fan for value_fan, point_fan in zip(*fans, strict=True)]
    return np.array(alike, dtype=bool)[place_index.ravel()]


def _layout_of(
    name: str, attribute: Attribute, cage: ControlCage, scheme: Scheme, patches: PatchTable
) -> ChannelLayout:
    if attribute.interpolation == "vertex":
        return ChannelLayout(patches, cage.cut_mesh.vertex)
    # Varying attributes have one value per vertex instead of indices.
    indices = cage.topology.face_vertices if attribute.indices is None else attribute.indices
    lies_on_seam = seams(cage.topology, indices)
    seam = lies_on_seam if lies_on_seam.any() else None
    is_linear = attribute.interpolation == "varying" or cage.face_varying == "all"
    if scheme.element == "face" and (
        is_linear
        or (scheme.has_phantom_points and _is_cut_into_faces(cage, scheme, lies_on_seam) and _is_linear_alone(scheme))
    ):
        return ChannelLayout(patches, indices, seam, is_linear=True)
    topology, value_index = subdivided_values(cage, scheme, name, attribute)
    if scheme.element == "vertex" or topology is patches.topology:
        return ChannelLayout(patches, value_index, seam)
    return ChannelLayout(PatchTable(topology, scheme, patches.is_hole), value_index, seam)


def _is_cut_into_faces(cage: ControlCage, scheme: Scheme, lies_on_seam: NDArray[np.bool_]) -> bool:
    """Whether seams and borders separate the values of all faces, and all their corners are sharp to the values."""
    t = cage.topology
    return bool(
        cage.face_varying != "none"
        and (lies_on_seam | (t.twin < 0)).all()
        and (t.ends_of(lies_on_seam) | (t.vertex_face_count <= 1)).all()
        and (t.face_sizes == scheme.domain.corner_count).all()
    )


@lru_cache(maxsize=32)
def _is_linear_alone(scheme: Scheme) -> bool:
    """Whether a scheme's surface over a single element with sharp corners is linear interpolation."""
    count, corners = scheme.domain.corner_count, np.arange(scheme.domain.corner_count, dtype=np.int32)
    rules = np.full(count, VertexRule.CORNER, dtype=np.int8)
    patches = PatchTable(Topology(count, np.array([count]), corners, rules=rules), scheme)
    uv = np.array([(0.1, 0.2), (0.5, 0.25), (0.3, 0.6)])
    layouts = (ChannelLayout(patches, corners.astype(np.int64), is_linear=is_linear) for is_linear in (False, True))
    channels = (Channel(layout, np.eye(count)) for layout in layouts)
    subdivided, linear = (channel.evaluate(np.zeros(3, np.int64), uv) for channel in channels)
    return np.allclose(subdivided, linear, rtol=0, atol=LINEAR)
