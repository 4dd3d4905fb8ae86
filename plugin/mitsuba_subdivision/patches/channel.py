"""Channels: interpolation of a cage's attributes over its elements, and evaluation anywhere on them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..cage import ControlCage
from ..cage.contents import Attribute
from ..evaluation.element import ElementSamples, evaluate_samples
from ..evaluation.equations import Evaluator
from ..evaluation.located_samples import LocatedSamples
from ..evaluation.patch_tree import patch_tree
from ..mesh.connectivity import IntArray, Topology, VertexRule
from ..mesh.cuts import seams, value_mesh
from ..mesh.shared import Content, Shared
from ..messages import counted
from ..schemes import Scheme, SchemeError
from ..schemes.domain import FloatArray
from .patch_table import PatchTable
from .stencil_matrices import vertex_matrices

if TYPE_CHECKING:
    from scipy import sparse

# Tolerance when testing that an interpolation is linear: rounding of sums of some tens of weights of order one.
LINEAR = 1e-13

# Weights per run of samples, for values and for each derivative, which bounds temporary memory to tens of megabytes.
WEIGHTS = 1 << 19


@dataclass(frozen=True, eq=False)
class ChannelLayout:
    """The part of an attribute's interpolation that does not depend on its values.

    Attributes with equal indices, on cages of the same topology, tags and rules, share a layout while it is referenced.
    """

    # `SubdividedChannel` or `LinearChannel`; its docstring defines `patches`
    kind: type[SubdividedChannel] | type[LinearChannel]
    patches: PatchTable
    value_index: IntArray  # (n,) int64: 0-based row of the values at each vertex or face corner
    seam: NDArray[np.bool_] | None = None  # (n_h,) bool: half-edges on a seam, or None

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
        key = cage.structure, scheme, attribute.interpolation, Content(attribute.indices)
        return _LAYOUTS.get(key, lambda: _layout_of(name, attribute, cage, scheme, patches))

    def channel(self, values: FloatArray) -> Channel:
        """The channel with values ``(n, k)``."""
        return self.kind(self, values)


_LAYOUTS: Shared[ChannelLayout] = Shared()


@dataclass(frozen=True, eq=False)
class Channel(ABC):
    """An attribute as a scheme interpolates it over the elements. Samples are given as for `PatchSampler.evaluate`."""

    layout: ChannelLayout
    values: FloatArray  # (n, k) float64

    def evaluate(self, half_edge: IntArray, uv: FloatArray) -> FloatArray:
        """``(s, k)`` values at samples."""
        return self.with_derivatives(half_edge, uv)[0]

    @abstractmethod
    def with_derivatives(self, half_edge: IntArray, uv: FloatArray) -> FloatArray:
        """``(3, s, k)`` values and derivatives by u and v."""

    @abstractmethod
    def weights(self, half_edge: IntArray, uv: FloatArray) -> sparse.csr_array:
        """``(s, n)`` weights of the values at samples; rows sum to one."""

    @property
    def patches(self) -> PatchTable:
        """See `SubdividedChannel` and `LinearChannel`."""
        return self.layout.patches

    @property
    def value_index(self) -> IntArray:
        """``(n,)`` int64, 0-based row of ``values`` at each vertex (subdivided) or face corner (linear)."""
        return self.layout.value_index

    @property
    def seam(self) -> NDArray[np.bool_] | None:
        """``(n_h,)`` whether each half-edge of the cage lies on a seam; None where none does."""
        return self.layout.seam


class SubdividedChannel(Channel):
    """Values at mesh vertices that are subdivided as points are.

    `patches` belong to the mesh on which the values are subdivided, which is cut along seams as well. Its half-edges
    have the same indices as the cage's.
    """

    def with_derivatives(self, half_edge: IntArray, uv: FloatArray) -> FloatArray:
        """``(3, s, k)`` values and derivatives by u and v; at extraordinary points tangents, see `SurfaceSamples`."""
        return self._sampler.evaluate(half_edge, uv).values

    @cached_property
    def _sampler(self) -> PatchSampler:
        return PatchSampler(self.patches, self.values, self.value_index)

    def weights(self, half_edge: IntArray, uv: FloatArray) -> sparse.csr_array:
        return vertex_matrices(self.patches, self.value_index, len(self.values), half_edge, uv, 1)[0]


class LinearChannel(Channel):
    """Values at face corners that are interpolated linearly over each element.

    Over a polygon that has a patch at each corner, values are interpolated bilinearly over each patch: the
    quadrilateral of the corner, the midpoints of its two edges and the polygon's centre, as by linear refinement.
    `patches` are those of the surface.
    """

    def with_derivatives(self, half_edge: IntArray, uv: FloatArray) -> FloatArray:
        domain, (u, v) = self.patches.scheme.domain, uv.T[:, :, None]
        corners, face, is_partial = self._corners(half_edge)
        values = [self.values[self.value_index[corner]] for corner in corners]
        if is_partial.any():
            # Corner, midpoint of the edge after it, centre, midpoint of the edge before it.
            for midpoint in (values[1], values[-1]):
                midpoint[is_partial] = (midpoint[is_partial] + values[0][is_partial]) / 2
            values[2][is_partial] = self.centres[face[is_partial]]
        rows = domain.corner_weights(u, v), *domain.corner_derivatives(u, v)
        return np.stack([sum(weight * value for weight, value in zip(row, values, strict=True)) for row in rows])

    def weights(self, half_edge: IntArray, uv: FloatArray) -> sparse.csr_array:
        from scipy import sparse

        t, entries = self.patches.topology, [*self.patches.scheme.domain.corner_weights(*uv.T)]
        corners, face, is_partial = self._corners(half_edge)
        columns = [self.value_index[corner] for corner in corners]
        if is_partial.any():
            # The midpoint of an edge passes half of its weight on to the corner.
            kept = np.where(is_partial, 0.5, 1.0)
            entries[0] = entries[0] + (1 - kept) * (entries[1] + entries[-1])
            entries[1], entries[-1] = entries[1] * kept, entries[-1] * kept
            columns[2] = np.where(is_partial, len(self.values) + face, columns[2])
        samples = np.repeat(np.arange(len(half_edge)), len(entries))
        coordinates = np.stack(entries, axis=1).ravel(), (samples, np.stack(columns, axis=1).ravel())
        shape = len(half_edge), len(self.values) + t.face_count
        return (sparse.csr_array(coordinates, shape=shape) @ self.with_centres).tocsr()

    def _corners(self, half_edge: IntArray) -> tuple[list[IntArray], IntArray, NDArray[np.bool_]]:
        """Corners of the samples' faces, in the order of the domain's corners, starting at the samples' half-edges.

        Returns the corners, each (s,) int; the faces; and whether these have a patch at each corner.
        """
        t, corner_count = self.patches.topology, self.patches.scheme.domain.corner_count
        corners = [self.patches.half_edge_of_corner[half_edge]]
        for _ in range(corner_count - 2):
            corners.append(t.next[corners[-1]])
        face = t.face[corners[0]]
        return [*corners, t.prev[corners[0]]], face, t.face_sizes[face] != corner_count

    @property
    def with_centres(self) -> sparse.csr_array:
        """``(n + n_f, n)`` matrix from the values to the values followed by `centres`."""
        from scipy import sparse

        t, count = self.patches.topology, len(self.values)
        entries = np.concatenate([np.ones(count), 1 / t.face_sizes[t.face]])
        rows = np.concatenate([np.arange(count), count + t.face])
        columns = np.concatenate([np.arange(count), self.value_index])
        return sparse.csr_array((entries, (rows, columns)), shape=(count + t.face_count, count))

    @cached_property
    def centres(self) -> FloatArray:
        """``(n_f, k)`` means of the values at the corners of each face."""
        t = self.patches.topology
        sums = [np.bincount(t.face, column, minlength=t.face_count) for column in self.values[self.value_index].T]
        return np.stack(sums, axis=1) / t.face_sizes[:, None]


def contracts_alike(
    channel: Channel,
    patches: PatchTable,  # Of the surface
    half_edge: IntArray,  # (s,) int64: half-edges that begin at the points
) -> NDArray[np.bool_]:
    """``(s,)`` whether a channel's values are subdivided as the surface's points are, around extraordinary points.

    If so, tangents of the values and of the points are the same multiples of derivatives nearby.
    """
    if isinstance(channel, LinearChannel):
        return np.zeros(len(half_edge), dtype=bool)
    if channel.patches is patches:
        return np.ones(len(half_edge), dtype=bool)
    tables = channel.patches, patches
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
        return ChannelLayout(SubdividedChannel, patches, cage.cut_mesh.vertex)
    # Varying attributes have one value per vertex instead of indices.
    indices = cage.topology.face_vertices if attribute.indices is None else attribute.indices
    lies_on_seam = seams(cage.topology, indices)
    seam = lies_on_seam if lies_on_seam.any() else None
    is_linear = attribute.interpolation == "varying" or cage.face_varying == "all"
    if scheme.element == "vertex":
        if is_linear or seam is not None:
            need = "seams" if seam is not None else "linear interpolation"
            raise SchemeError(
                f'{cage.source.name}: the scheme {scheme.name} has no rules for {need}, as of the attribute "{name}"; '
                "expected one that is subdivided as points are, without seams"
            )
        value_index: IntArray = np.zeros(patches.topology.vertex_count, dtype=np.int64)
        value_index[patches.topology.face_vertices] = indices
        return ChannelLayout(SubdividedChannel, patches, value_index)
    if is_linear or (
        scheme.has_phantom_points and _is_cut_into_faces(cage, scheme, lies_on_seam) and _is_linear_alone(scheme)
    ):
        return ChannelLayout(LinearChannel, patches, indices, seam)
    topology, value_index = value_mesh(cage.structure, cage.face_varying, indices)
    if not scheme.has_phantom_points and ((topology.twin < 0).any() or topology.vertex_rules.any()):
        raise SchemeError(
            f'{cage.source.name}: the scheme {scheme.name} has no rules for seams, as of the attribute "{name}", as it '
            'states no phantom_points; expected an attribute without seams, or face_varying "all"'
        )
    value_patches = patches if topology is patches.topology else PatchTable(topology, scheme, patches.is_hole)
    return ChannelLayout(SubdividedChannel, value_patches, value_index, seam)


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
    count = scheme.domain.corner_count
    corners = np.arange(count, dtype=np.int32)
    rules = np.full(count, VertexRule.CORNER, dtype=np.int8)
    patches = PatchTable(Topology(count, np.array([count]), corners, rules=rules), scheme)
    uv = np.array([(0.1, 0.2), (0.5, 0.25), (0.3, 0.6)])
    subdivided, linear = (
        ChannelLayout(kind, patches, corners.astype(np.int64))
        .channel(np.eye(count))
        .evaluate(np.zeros(3, np.int64), uv)
        for kind in (SubdividedChannel, LinearChannel)
    )
    return np.allclose(subdivided, linear, rtol=0, atol=LINEAR)


@dataclass(frozen=True, eq=False)
class PatchSampler:
    """Evaluates points, or other values that are subdivided like points, anywhere on patches."""

    patches: PatchTable
    control_values: FloatArray  # (n, k) float64
    control_of_vertex: IntArray  # (n_v,) int64: 0-based row of ``control_values`` at each mesh vertex

    def evaluate(
        self,
        # (s,) int64: the corner of an element where a sample's parameters are (0, 0), a half-edge of
        # `PatchTable.elements`
        half_edge: IntArray,
        uv: FloatArray,  # (s, 2) float64: parameters, starting at that corner
        # As for `LimitSurface.evaluate`
        evaluator: Evaluator = "stabilized",
        dtype: DTypeLike = np.float64,
        derivatives: int = 1,
    ) -> ElementSamples:
        """Evaluate points, derivatives and normals at samples."""
        scheme, classes = self.patches.scheme, self.patches.classes
        class_index, patch, corner = self.patches.patch_at(half_edge)
        samples = ElementSamples.empty(len(uv), self.control_values.shape[1], dtype, derivatives)
        # Samples are sorted by class, so that a run has few classes and few control points.
        order = np.argsort(class_index.astype(np.min_scalar_type(len(classes))), kind="stable")
        ends = np.cumsum(self.patches.control_counts[class_index[order]]) // WEIGHTS
        runs = np.split(order, np.flatnonzero(np.diff(ends)) + 1) if len(order) else []
        for run in counted(runs, "Evaluated patches"):
            used, element = np.unique(class_index[run], return_inverse=True)
            run_classes = [classes[index] for index in used.tolist()]
            elements = [patch_tree(scheme, patch_class.signature) for patch_class in run_classes]
            located = LocatedSamples(scheme, elements, element, uv[run], corner[run])
            controls = [
                patch_class.controls.take(patch[run[class_samples]], axis=0)
                for patch_class, class_samples in zip(run_classes, located.slices(), strict=True)
            ]
            points = [self._values.take(indices, axis=0) for indices in controls]
            samples.put(run, evaluate_samples(located, points, self._extent, evaluator, dtype, derivatives))
        return samples

    @cached_property
    def _extent(self) -> FloatArray:
        """``(k,)`` range of the control values, maximum minus minimum."""
        return np.array([np.ptp(column) if len(column) else 0 for column in self.control_values.T])

    @cached_property
    def _values(self) -> FloatArray:
        """``(n_v, k)`` control values at the mesh's vertices."""
        return self.control_values[self.control_of_vertex]
