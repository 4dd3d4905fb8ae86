"""Sharpness of edges and vertices as tags give it, infinite or finite.

Three classes hold sharpness, each made from the one before:

`Sharpness`: of the control cage, from its tags.
    One number for each edge and each vertex, infinite sharpness among them.
`SemiSharpness` (`semi_sharpness`): of a mesh that is cut along its infinitely sharp edges.
    Infinite sharpness is now in the mesh itself, as borders and corners. The rest is finite. Each refinement of the
    mesh has its own (`SemiSharpness.refined`).
`FanSharpness` (`semi_sharpness`): around one vertex, seen from one of its faces, as a part of a `Signature`.
    The same numbers without those of vertices and edges: elements with equal ones share their limit stencils.
    `one_ring` writes them onto its local mesh as a `SemiSharpness` again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .connectivity import Topology

FloatArray = NDArray[np.float64]

# From this sharpness on a feature is infinitely sharp, as in OpenSubdiv.
INFINITE = 10.0


@dataclass(frozen=True, eq=False)
class Sharpness:
    """Sharpness of edges and vertices: 0 smooth, `INFINITE` or more infinitely sharp, between them semi-sharp."""

    # (n_h,) float64: sharpness of the edge of each half-edge: both half-edges of an edge have the same
    edges: FloatArray
    vertices: FloatArray  # (n_v,) float64: sharpness of each vertex

    @property
    def is_infinite(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether each half-edge is infinitely sharp."""
        return self.edges >= INFINITE

    @property
    def is_corner(self) -> NDArray[np.bool_]:
        """``(n_v,)`` whether each vertex is infinitely sharp."""
        return self.vertices >= INFINITE

    @property
    def any(self) -> bool:
        """Whether anything is sharp."""
        return bool(self.edges.any() or self.vertices.any())

    def creases(self, topology: Topology) -> FloatArray:
        """Rows (vertex, vertex, sharpness), one for each sharp edge."""
        t = topology
        sharp = t.edge_half_edge[self.edges[t.edge_half_edge] > 0]
        return np.stack([t.face_vertices[sharp], t.face_vertices[t.next[sharp]], self.edges[sharp]], axis=1)

    def corners(self) -> FloatArray:
        """Rows (vertex, sharpness), one for each sharp vertex."""
        sharp = np.flatnonzero(self.vertices)
        return np.stack([sharp, self.vertices[sharp]], axis=1)
