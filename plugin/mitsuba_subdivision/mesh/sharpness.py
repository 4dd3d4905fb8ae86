"""Sharpness of edges and vertices: infinite, or semi-sharp, which lasts for a number of refinements.

There are three records, because sharpness is asked for in three places. Each is made from the one before:

`Sharpness`: of a mesh as its tags give it.
    One number for each edge and each vertex, infinite sharpness among them.
`SemiSharpness`: of a mesh that is cut along its infinitely sharp edges (`cuts.semi_sharpness_of_cut`).
    Infinite sharpness is now in the mesh itself, as borders and corners. Semi-sharpness is left, with what the next
    refinement leaves of it; the two halves of an edge may differ in that. Copies of a vertex on different sides of a
    cut must move alike, so each also knows the semi-sharp edges on the other sides. A refined mesh has a record of its
    own (`SemiSharpness.refined`).
`FanSharpness`: around one vertex, seen from one of its faces (`signature.FanSharpnessRows`).
    The same numbers without those of vertices and edges, as a part of a `Signature`: elements whose surroundings are
    alike have equal ones, and so share their limit stencils. `one_ring.one_ring` writes them onto its local mesh as a
    `SemiSharpness` again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .connectivity import Topology

IntArray = NDArray[np.integer]

CreaseMethod = Literal["uniform", "chaikin"]
FloatArray = NDArray[np.float64]

# From this sharpness on a feature is infinitely sharp, as in OpenSubdiv.
INFINITE = 10.0


@dataclass(frozen=True, eq=False)
class Sharpness:
    """Sharpness of a mesh's edges and vertices: 0 smooth, `INFINITE` or more infinitely sharp, between them semi-sharp.

    Attributes
    ----------
    edges : (n_h,) float64
        Sharpness of the edge of each half-edge: both half-edges of an edge have the same.
    vertices : (n_v,) float64
        Sharpness of each vertex.
    """

    edges: FloatArray
    vertices: FloatArray

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
        return np.stack([t.face_vertices[sharp], t.face_vertices[t.following(sharp)], self.edges[sharp]], axis=1)

    def corners(self) -> FloatArray:
        """Rows (vertex, sharpness), one for each sharp vertex."""
        sharp = np.flatnonzero(self.vertices)
        return np.stack([sharp, self.vertices[sharp]], axis=1)


@dataclass(frozen=True, eq=False)
class EdgesBeyond:
    """Semi-sharp edges at vertices of a cut mesh that lie beyond the cut: each ends at another copy of the vertex.

    A vertex has a row for each of them.

    Attributes
    ----------
    vertex : (m,) int64
        The vertex of the cut mesh.
    sharpness : (m,) float64
        Sharpness of the edge.
    sharpens : (m,) bool
        Whether the edge makes the vertex sharp. If not, it only takes part in the averages of Chaikin's method.
    """

    vertex: IntArray
    sharpness: FloatArray
    sharpens: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SemiSharpness:
    """Semi-sharp features of a mesh that is cut along its infinitely sharp edges.

    Attributes
    ----------
    edges : (n_h,) float64
        Sharpness of the edge of each half-edge: both half-edges of an edge have the same. 0 for smooth edges and on
        borders.
    edges_left : (n_h,) float64
        What one refinement leaves of it on the half of the edge at which the half-edge begins.
    vertices : (n_v,) float64
        Sharpness of each vertex.
    beyond : EdgesBeyond
        Semi-sharp edges beyond the cut.
    beyond_left : (m,) float64
        What one refinement leaves of their sharpness on the half at the vertex.
    """

    edges: FloatArray
    edges_left: FloatArray
    vertices: FloatArray
    beyond: EdgesBeyond
    beyond_left: FloatArray

    @classmethod
    def decaying(
        cls, origin: IntArray, edges: FloatArray, vertices: FloatArray, beyond: EdgesBeyond, method: CreaseMethod
    ) -> SemiSharpness | None:
        """Find what one refinement leaves of some sharpness; None where nothing is sharp.

        A refinement takes one from a sharpness. Chaikin's method first replaces the sharpness of an edge by three
        quarters of it and a quarter of the mean of the other semi-sharp edges at the vertex [DeRose et al. 1998], as
        OpenSubdiv has it.

        Parameters
        ----------
        origin : (n_h,) int
            Vertex at which each half-edge begins.
        edges, vertices, beyond
            As `SemiSharpness` has them.
        method : "uniform" or "chaikin"
        """
        if not (edges.any() or vertices.any() or beyond.sharpness.any()):
            return None
        averaged, averaged_beyond = edges, beyond.sharpness
        if method == "chaikin":
            at, sharpness = np.concatenate([origin, beyond.vertex]), np.concatenate([edges, beyond.sharpness])
            total = np.bincount(at, sharpness, minlength=len(vertices))[at]
            others = np.bincount(at, sharpness > 0, minlength=len(vertices))[at] - 1
            mean = (total - sharpness) / np.maximum(others, 1)
            averaged = np.where((sharpness > 0) & (others > 0), 0.75 * sharpness + 0.25 * mean, sharpness)
            averaged, averaged_beyond = np.split(averaged, [len(edges)])
        return cls(edges, _decayed(averaged), vertices, beyond, _decayed(averaged_beyond))

    @property
    def vertices_left(self) -> FloatArray:
        """``(n_v,)`` what one refinement leaves of the vertices' sharpness."""
        return _decayed(self.vertices)

    def refined(
        self, origin: IntArray, edges: FloatArray, new_vertex_count: int, method: CreaseMethod
    ) -> SemiSharpness | None:
        """Sharpness of a refined mesh whose first vertices are those of this one.

        Parameters
        ----------
        origin, edges : (n_h',)
            Vertex at which each refined half-edge begins, and its sharpness: `edges_left`, or 0 for new edges.
        new_vertex_count : int
            Number of vertices that are new.
        method : "uniform" or "chaikin"
        """
        vertices = np.concatenate([self.vertices_left, np.zeros(new_vertex_count)])
        # Edges that have become smooth are dropped: kept at 0, they would make signatures of equal surroundings differ.
        is_kept = self.beyond_left > 0
        beyond = EdgesBeyond(self.beyond.vertex[is_kept], self.beyond_left[is_kept], self.beyond.sharpens[is_kept])
        return SemiSharpness.decaying(origin, edges, vertices, beyond, method)


class FanSharpness(NamedTuple):
    """Semi-sharp features at one vertex of a cut mesh, in an order that does not depend on numbers of edges.

    Parameters
    ----------
    edges : tuple of (sharpness, left at the vertex, left at the other end)
        Of the edges at which the faces of the fan begin, from the most clockwise face on.
    vertex : float
        Sharpness of the vertex.
    beyond : tuple of (sharpness, left at the vertex, whether it sharpens the vertex)
        Of semi-sharp edges beyond the cut, in increasing order.
    """

    edges: tuple[tuple[float, float, float], ...]
    vertex: float
    beyond: tuple[tuple[float, float, bool], ...]

    @property
    def least_left(self) -> float:
        """The least that one refinement leaves of anything that is sharp; infinite where nothing is."""
        left = [each for sharpness, *ends in self.edges if sharpness for each in ends]
        left += [each for sharpness, each, _ in self.beyond if sharpness]
        if self.vertex:
            left.append(max(self.vertex - 1, 0.0))
        return min(left, default=math.inf)

    def sharpened(self, by: int) -> FanSharpness:
        """The same features, each sharper by the same amount; what is smooth stays smooth."""
        return FanSharpness(
            tuple((row[0] + by, row[1] + by, row[2] + by) if row[0] else row for row in self.edges),
            self.vertex and self.vertex + by,
            tuple((row[0] + by, row[1] + by, row[2]) if row[0] else row for row in self.beyond),
        )


def _decayed(sharpness: FloatArray) -> FloatArray:
    return np.maximum(sharpness - 1, 0)
