"""Data of a control cage that does not depend on positions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..mesh.cuts import CutMesh, SharpMesh, Sharpness
from ..mesh.manifold import NonManifold
from ..mesh.shared import Content, Shared
from ..mesh.sharpness import CreaseMethod
from .validation import read_only


@dataclass(frozen=True, eq=False)
class CageStructure:
    """Faces, tags and rules of a control cage, and derived data.

    Cages with equal structure share one object, see `shared`. Attributes and properties are as in `ControlCage`.
    """

    topology: Topology
    non_manifold: NonManifold | None
    tags: Sharpness
    boundary: str
    crease_method: CreaseMethod
    triangle_rule: str
    face_varying: str
    holes: IntArray

    def shared(self) -> CageStructure:
        """Return the shared structure that equals this one, or this one if there is none yet."""
        t = self.topology
        names = None if t.edge_names is None else Content(t.edge_names)
        arrays = (t.face_sizes, t.face_vertices, self.tags.edges, self.tags.vertices, self.holes)
        rules = (self.boundary, self.crease_method, self.triangle_rule, self.face_varying)
        return _SHARED.get((t.vertex_count, names, *map(Content, arrays), *rules), lambda: self)

    @cached_property
    def is_corner(self) -> NDArray[np.bool_]:
        t, is_corner = self.topology, self.tags.is_corner
        if self.non_manifold is not None:
            is_corner = is_corner | self.non_manifold.is_corner
        if self.boundary == "edge_and_corner":
            is_corner = is_corner | t.is_border_vertex & (t.vertex_face_count == 1)
        return is_corner

    @cached_property
    def is_boundary(self) -> NDArray[np.bool_]:
        is_border, non_manifold = self.topology.twin < 0, self.non_manifold
        return is_border if non_manifold is None else is_border & ~non_manifold.is_edge | non_manifold.has_one_face

    @cached_property
    def is_boundary_vertex(self) -> NDArray[np.bool_]:
        if self.non_manifold is None:
            return self.topology.is_border_vertex
        return self.topology.ends_of(self.is_boundary)

    @cached_property
    def sharp_mesh(self) -> SharpMesh:
        is_corner, is_boundary_vertex = self.is_corner, self.is_boundary_vertex
        return SharpMesh(self.topology, self.tags, is_corner, is_boundary_vertex, self.crease_method, self.non_manifold)

    @property
    def cut_mesh(self) -> CutMesh:
        return self.sharp_mesh.cut

    @cached_property
    def is_hole(self) -> NDArray[np.bool_]:
        t = self.topology
        is_hole = np.zeros(t.face_count, dtype=bool)
        is_hole[self.holes] = True
        if self.boundary == "none":
            # Faces at infinitely sharp boundary edges are part of the surface.
            at_boundary = t.ends_of(self.is_boundary & ~self.tags.is_infinite)
            is_hole[t.face[np.flatnonzero(at_boundary[t.face_vertices])]] = True
        return is_hole

    @cached_property
    def edges(self) -> IndexArray:
        return edges_of(self.topology)

    @cached_property
    def triangles(self) -> IndexArray:
        t = self.topology
        counts = t.face_sizes - 2
        first = np.repeat(t.face_offsets[:-1], counts)
        step = first + ragged.index_in_row(counts)
        return read_only(t.face_vertices[np.stack([first, step + 1, step + 2], axis=1)])


_SHARED: Shared[CageStructure] = Shared()


def edges_of(topology: Topology) -> IndexArray:
    """Return ``(n_e, 2)`` int32 ends of each edge, the lower vertex first; sorted by the higher vertex, then the lower.

    Edges between the same two vertices, which occur in non-manifold meshes, are one edge.
    """
    start, end = topology.face_vertices, topology.face_vertices[topology.next]
    low, high = np.minimum(start, end).astype(np.int64), np.maximum(start, end).astype(np.int64)
    keys = np.unique(high * topology.vertex_count + low)
    high, low = np.divmod(keys, topology.vertex_count)
    return read_only(np.stack([low, high], axis=1).astype(np.int32))
