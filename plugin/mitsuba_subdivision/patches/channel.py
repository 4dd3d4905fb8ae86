"""Channels: how the attributes of a cage are interpolated over its elements, evaluated anywhere on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..cage import ControlCage
from ..cage.attributes import Attribute
from ..evaluation.element import ElementSamples, evaluate_samples
from ..evaluation.equations import Evaluator
from ..evaluation.located_samples import LocatedSamples
from ..evaluation.patch_tree import patch_tree
from ..mesh.connectivity import IntArray, Topology, VertexRule
from ..mesh.seams import seams, value_mesh
from ..mesh.shared import Content, Shared
from ..progress import counted
from ..schemes import Scheme, SchemeError
from ..schemes.domain import FloatArray
from .patch_table import PatchTable
from .stencil_matrices import vertex_matrices

if TYPE_CHECKING:
    from scipy import sparse

# Sums of some tens of weights of order one, in double precision.
LINEAR = 1e-13

# Samples are evaluated in runs of so many weights of each kind, which bounds temporary memory to tens of megabytes.
WEIGHTS = 1 << 19


@dataclass(frozen=True, eq=False)
class ChannelLayout:
    """How attributes are interpolated over a cage's elements, whatever their values are.

    Attributes of equal indices, of cages of the same topology, tags and rules, share a layout while it is
    referenced.
    """

    # `SubdividedChannel` or `LinearChannel`, which describe the other attributes
    kind: type[SubdividedChannel] | type[LinearChannel]
    patches: PatchTable
    value_index: IntArray  # (n,) int64
    seam: NDArray[np.bool_] | None = None  # (n_h,) bool or None

    @classmethod
    def of(
        cls,
        name: str,  # The attribute's name in error messages
        attribute: Attribute,  # Of the cage, validated
        cage: ControlCage,
        scheme: Scheme,
        patches: PatchTable,  # Of the cage's surface. Channels whose values are subdivided on the same mesh share it.
    ) -> ChannelLayout:
        """Choose how an attribute is interpolated. Raises SchemeError if the scheme has no rules for it."""
        key = cage.structure, scheme, attribute.interpolation, Content(attribute.indices)
        return _LAYOUTS.get(key, lambda: _layout_of(name, attribute, cage, scheme, patches))

    def channel(self, values: FloatArray) -> Channel:
        """The channel of some values, ``(n, k)``."""
        return self.kind(self, values)


_LAYOUTS: Shared[ChannelLayout] = Shared()


@dataclass(frozen=True, eq=False)
class _OfLayout:
    """The members that a channel takes from its layout."""

    layout: ChannelLayout
    values: FloatArray  # (n, k) float64

    @property
    def patches(self) -> PatchTable:
        """See `SubdividedChannel` and `LinearChannel`."""
        return self.layout.patches

    @property
    def value_index(self) -> IntArray:
        """``(n,)`` int64, 0-based row of ``values`` at each vertex or face corner, as `patches`."""
        return self.layout.value_index

    @property
    def seam(self) -> NDArray[np.bool_] | None:
        """``(n_h,)`` whether each half-edge of the cage lies on a seam; None where none does."""
        return self.layout.seam


class SubdividedChannel(_OfLayout):
    """Values at mesh vertices that are subdivided as points are.

    `patches` are those of the mesh on which the values are subdivided: cut along seams as well. Its half-edges have the
    cage's numbers.
    """

    def evaluate(self, half_edge: IntArray, uv: FloatArray) -> FloatArray:
        """``(s, k)`` values at samples, given as for `PatchSampler.evaluate`."""
        return self.with_derivatives(half_edge, uv)[0]

    def with_derivatives(self, half_edge: IntArray, uv: FloatArray) -> FloatArray:
        """``(3, s, k)`` values, and derivatives by u and by v; at extraordinary points, tangents as of points."""
        return self._sampler.evaluate(half_edge, uv).values

    @cached_property
    def _sampler(self) -> PatchSampler:
        return PatchSampler(self.patches, self.values, self.value_index)

    def weights(self, half_edge: IntArray, uv: FloatArray) -> sparse.csr_array:
        """``(s, n)`` weights that `evaluate` multiplies values by; rows sum to one."""
        return vertex_matrices(self.patches, self.value_index, len(self.values), half_edge, uv, 1)[0]


class LinearChannel(_OfLayout):
    """Values at face corners that are interpolated linearly over each element.

    Over a polygon that has a patch at each corner, they are interpolated bilinearly over each patch: the quadrilateral
    between the corner, the middles of its two edges and the polygon's centre, as by linear refinement. `patches` are
    those of the surface.
    """

    def evaluate(self, half_edge: IntArray, uv: FloatArray) -> FloatArray:
        """``(s, k)`` values at samples, given as for `PatchSampler.evaluate`."""
        return self.with_derivatives(half_edge, uv)[0]

    def with_derivatives(self, half_edge: IntArray, uv: FloatArray) -> FloatArray:
        """``(3, s, k)`` values, and derivatives by u and by v."""
        domain, (u, v) = self.patches.scheme.domain, uv.T[:, :, None]
        corners, face, is_partial = self._corners(half_edge)
        values = [self.values[self.value_index[corner]] for corner in corners]
        if is_partial.any():
            # Corner, middle of the edge after it, centre, middle of the edge before it.
            for middle in (values[1], values[-1]):
                middle[is_partial] = (middle[is_partial] + values[0][is_partial]) / 2
            values[2][is_partial] = self.centres[face[is_partial]]
        rows = domain.corner_weights(u, v), *domain.corner_derivatives(u, v)
        return np.stack([sum(weight * value for weight, value in zip(row, values, strict=True)) for row in rows])

    def weights(self, half_edge: IntArray, uv: FloatArray) -> sparse.csr_array:
        """``(s, n)`` weights that `evaluate` multiplies values by; rows sum to one."""
        from scipy import sparse

        t, entries = self.patches.topology, [*self.patches.scheme.domain.corner_weights(*uv.T)]
        corners, face, is_partial = self._corners(half_edge)
        columns = [self.value_index[corner] for corner in corners]
        if is_partial.any():
            # Half of the weight of the middle of an edge is that of the corner.
            kept = np.where(is_partial, 0.5, 1.0)
            entries[0] = entries[0] + (1 - kept) * (entries[1] + entries[-1])
            entries[1], entries[-1] = entries[1] * kept, entries[-1] * kept
            columns[2] = np.where(is_partial, len(self.values) + face, columns[2])
        samples = np.repeat(np.arange(len(half_edge)), len(entries))
        flat = np.stack(entries, axis=1).ravel(), (samples, np.stack(columns, axis=1).ravel())
        return (
            sparse.csr_array(flat, shape=(len(half_edge), len(self.values) + t.face_count)) @ self.with_centres
        ).tocsr()

    def _corners(self, half_edge: IntArray) -> tuple[list[IntArray], IntArray, NDArray[np.bool_]]:
        """Corners of the faces around samples, as the domain counts them from the samples' own, with the last one last.

        Returns corners, each (s,) int, the faces, and whether these have another number of corners than the domain.
        """
        t, corner_count = self.patches.topology, self.patches.scheme.domain.corner_count
        corners = [self.patches.half_edge_of_corner[half_edge]]
        for _ in range(corner_count - 2):
            corners.append(t.next[corners[-1]])
        face = t.face[corners[0]]
        return [*corners, t.prev[corners[0]]], face, t.face_sizes[face] != corner_count

    @property
    def with_centres(self) -> sparse.csr_array:
        """``(n + n_f, n)`` weights that make the values, and the `centres` after them, of the values."""
        from scipy import sparse

        t, count = self.patches.topology, len(self.values)
        entries = np.concatenate([np.ones(count), 1 / t.face_sizes[t.face]])
        rows = np.concatenate([np.arange(count), count + t.face])
        columns = np.concatenate([np.arange(count), self.value_index])
        return sparse.csr_array((entries, (rows, columns)), shape=(count + t.face_count, count))

    @cached_property
    def centres(self) -> FloatArray:
        """``(n_f, k)`` mean of the values at each face's corners."""
        t = self.patches.topology
        sums = [np.bincount(t.face, column, minlength=t.face_count) for column in self.values[self.value_index].T]
        return np.stack(sums, axis=1) / t.face_sizes[:, None]


Channel = SubdividedChannel | LinearChannel


def contracts_alike(
    channel: Channel,
    patches: PatchTable,  # Of the surface
    half_edge: IntArray,  # (s,) int64: half-edges that begin at the points
) -> NDArray[np.bool_]:
    """Whether a channel's values and the points of a surface contract alike around extraordinary points.

    If they are subdivided alike there, their tangents at the point are the same multiples of derivatives nearby.

    Returns (s,) bool.
    """
    if isinstance(channel, LinearChannel):
        return np.zeros(len(half_edge), dtype=bool)
    if channel.patches is patches:
        return np.ones(len(half_edge), dtype=bool)
    tables = channel.patches, patches
    # For both, the class and the corner that the fan is at.
    places = np.array([found for table in tables for found in table.patch_at(half_edge)[::2]])
    kinds, which = np.unique(places, axis=1, return_inverse=True)
    fans = (
        [table.classes[a].signature.fans[b] for a, b in kinds[2 * i : 2 * i + 2].T] for i, table in enumerate(tables)
    )
    alike = [of_values == of_points for of_values, of_points in zip(*fans, strict=True)]
    return np.array(alike, dtype=bool)[which.ravel()]


def _layout_of(
    name: str, attribute: Attribute, cage: ControlCage, scheme: Scheme, patches: PatchTable
) -> ChannelLayout:
    if attribute.interpolation == "vertex":
        return ChannelLayout(SubdividedChannel, patches, cage.cut_mesh.vertex)
    # Varying values have no indices, but one value for each vertex.
    indices = cage.topology.face_vertices if attribute.indices is None else attribute.indices
    lies_on_seam = seams(cage.topology, indices)
    seam = lies_on_seam if lies_on_seam.any() else None
    is_linear = attribute.interpolation == "varying" or cage.face_varying == "all"
    if scheme.element == "vertex":
        if is_linear or seam is not None:
            what = "seams" if seam is not None else "linear interpolation"
            raise SchemeError(
                f'{cage.source.name}: the scheme {scheme.name} has no rules for {what}, as of the attribute "{name}"; '
                "expected one that is subdivided as points are, without seams"
            )
        row = np.zeros(patches.topology.vertex_count, dtype=np.int64)
        row[patches.topology.face_vertices] = indices
        return ChannelLayout(SubdividedChannel, patches, row)
    if is_linear or (
        scheme.has_phantom_points and _is_cut_into_faces(cage, scheme, lies_on_seam) and _is_linear_alone(scheme)
    ):
        return ChannelLayout(LinearChannel, patches, indices, seam)
    topology, value_index = value_mesh(cage.sharp_mesh, cage.face_varying, indices)
    if not scheme.has_phantom_points and ((topology.twin < 0).any() or topology.vertex_rules.any()):
        raise SchemeError(
            f'{cage.source.name}: the scheme {scheme.name} has no rules for seams, as of the attribute "{name}", as it '
            'states no phantom_points; expected an attribute without seams, or face_varying "all"'
        )
    own = patches if topology is patches.topology else PatchTable(topology, scheme, patches.is_hole)
    return ChannelLayout(SubdividedChannel, own, value_index, seam)


def _is_cut_into_faces(cage: ControlCage, scheme: Scheme, lies_on_seam: NDArray[np.bool_]) -> bool:
    """Whether every face is an element of its own to the values, and all of its corners are corners to them."""
    t = cage.topology
    return bool(
        cage.face_varying != "none"
        and (lies_on_seam | (t.twin < 0)).all()
        and (t.ends_of(lies_on_seam) | (t.vertex_face_count <= 1)).all()
        and (t.face_sizes == scheme.domain.corner_count).all()
    )


@lru_cache(maxsize=32)
def _is_linear_alone(scheme: Scheme) -> bool:
    """Whether a scheme interpolates linearly over an element of its own whose corners are corners."""
    count = scheme.domain.corner_count
    corners = np.arange(count, dtype=np.int32)
    rules = np.full(count, VertexRule.CORNER, dtype=np.int8)
    patches = PatchTable(Topology(count, np.array([count]), corners, rules=rules), scheme)
    uv = np.array([(0.1, 0.2), (0.5, 0.25), (0.3, 0.6)])
    found, expected = (
        ChannelLayout(kind, patches, corners.astype(np.int64))
        .channel(np.eye(count))
        .evaluate(np.zeros(3, np.int64), uv)
        for kind in (SubdividedChannel, LinearChannel)
    )
    return np.allclose(found, expected, rtol=0, atol=LINEAR)


@dataclass(frozen=True, eq=False)
class PatchSampler:
    """Evaluates points, or other values that are subdivided as points are, anywhere on patches."""

    patches: PatchTable
    control_values: FloatArray  # (n, k) float64
    control_of_vertex: IntArray  # (n_v,) int64: 0-based row of ``control_values`` at each mesh vertex

    def evaluate(
        self,
        # (s,) int64: the corner of an element where each sample's parameters are (0, 0), a half-edge of
        # `PatchTable.elements`
        half_edge: IntArray,
        uv: FloatArray,  # (s, 2) float64: parameters, seen from that corner
        # As for `LimitSurface.evaluate`
        evaluator: Evaluator = "stabilized",
        dtype: DTypeLike = np.float64,
        derivatives: int = 1,
    ) -> ElementSamples:
        """Evaluate samples."""
        scheme, classes = self.patches.scheme, self.patches.classes
        class_index, patch, corner = self.patches.patch_at(half_edge)
        samples = ElementSamples.empty(len(uv), self.control_values.shape[1], dtype, derivatives)
        # Sorted by class, a run of samples has few classes, and few control points.
        order = np.argsort(class_index.astype(np.min_scalar_type(len(classes))), kind="stable")
        ends = np.cumsum(self.patches.control_counts[class_index[order]]) // WEIGHTS
        runs = np.split(order, np.flatnonzero(np.diff(ends)) + 1) if len(order) else []
        for at in counted(runs, "Evaluated patches"):
            used, element = np.unique(class_index[at], return_inverse=True)
            own = [classes[index] for index in used.tolist()]
            elements = [patch_tree(scheme, each.signature) for each in own]
            located = LocatedSamples(scheme, elements, element, uv[at], corner[at])
            controls = [
                each.controls.take(patch[at[of_element]], axis=0)
                for each, of_element in zip(own, located.slices(), strict=True)
            ]
            points = [self._values.take(indices, axis=0) for indices in controls]
            samples.put(at, evaluate_samples(located, points, self._extent, evaluator, dtype, derivatives))
        return samples

    @cached_property
    def _extent(self) -> FloatArray:
        """``(k,)`` extent of all control values."""
        return np.array([np.ptp(column) if len(column) else 0 for column in self.control_values.T])

    @cached_property
    def _values(self) -> FloatArray:
        """``(n_v, k)`` control values of the mesh's vertices."""
        return self.control_values[self.control_of_vertex]
