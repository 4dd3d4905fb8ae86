"""Sharp edges and vertices: infinitely sharp, or semi-sharp, that is for a number of refinements."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

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
    """Sharpness of a mesh's edges and vertices: 0 smooth, 10 infinitely sharp, between them semi-sharp.

    Attributes
    ----------
    edges : (n_h,) float64
        Of half-edges; both of an edge are equal.
    vertices : (n_v,) float64
    """

    edges: FloatArray
    vertices: FloatArray

    @property
    def is_sharp(self) -> NDArray[np.bool_]:
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
class SemiSharpness:
    """Semi-sharp features of a mesh whose infinitely sharp edges are borders.

    Attributes
    ----------
    edges : (n_h,) float64
        Of half-edges; both of an edge are equal. 0 for smooth ones and on borders.
    edges_left : (n_h,) float64
        What one refinement leaves, of the half of the edge at which the half-edge begins.
    vertices : (n_v,) float64
    beyond_vertex : (m,) int64
        Vertices of borders that are creases, for each semi-sharp edge that ends there on another side of the crease.
    beyond, beyond_left : (m,) float64
        Sharpness of these edges, and what one refinement leaves of it there.
    beyond_acts : (m,) bool
        Whether they make the vertex sharp; if not, they only take part in Chaikin's method.
    """

    edges: FloatArray
    edges_left: FloatArray
    vertices: FloatArray
    beyond_vertex: IntArray
    beyond: FloatArray
    beyond_left: FloatArray
    beyond_acts: NDArray[np.bool_]

    @classmethod
    def decaying(
        cls,
        origin: IntArray,
        edges: FloatArray,
        vertices: FloatArray,
        beyond_vertex: IntArray,
        beyond: FloatArray,
        beyond_acts: NDArray[np.bool_],
        method: CreaseMethod,
    ) -> SemiSharpness | None:
        """Find what one refinement leaves; None where nothing is sharp.

        Every refinement takes one from a sharpness; Chaikin's method first mixes a quarter of the mean of the other
        semi-sharp edges at the vertex into that of an edge [DeRose et al. 1998], as OpenSubdiv has it.

        Parameters
        ----------
        origin : (n_h,) int
            Vertex at which each half-edge begins.
        """
        if not (edges.any() or vertices.any() or beyond.any()):
            return None
        mixed, mixed_beyond = edges, beyond
        if method == "chaikin":
            at, sharpness = np.concatenate([origin, beyond_vertex]), np.concatenate([edges, beyond])
            total = np.bincount(at, sharpness, minlength=len(vertices))[at]
            others = np.bincount(at, sharpness > 0, minlength=len(vertices))[at] - 1
            mean = (total - sharpness) / np.maximum(others, 1)
            mixed = np.where((sharpness > 0) & (others > 0), 0.75 * sharpness + 0.25 * mean, sharpness)
            mixed, mixed_beyond = np.split(mixed, [len(edges)])
        return cls(edges, _decayed(mixed), vertices, beyond_vertex, beyond, _decayed(mixed_beyond), beyond_acts)

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
            Vertices that are new.
        """
        vertices = np.concatenate([self.vertices_left, np.zeros(new_vertex_count)])
        # Rows that have become smooth go, or what a part looks like would hang on what else is in the mesh.
        left = self.beyond_left > 0
        beyond = self.beyond_vertex[left], self.beyond_left[left], self.beyond_acts[left]
        return SemiSharpness.decaying(origin, edges, vertices, *beyond, method)


@dataclass(frozen=True)
class FanSharpness:
    """Semi-sharp features at a vertex, as `SemiSharpness` has them.

    Parameters
    ----------
    edges : tuple of (sharpness, left, left at the other end)
        Of the edges at which the faces of the fan begin, clockwise ones first.
    vertex : float
    beyond : tuple of (sharpness, left, whether it acts)
        Of edges on other sides of a crease, in increasing order.
    """

    edges: tuple[tuple[float, float, float], ...]
    vertex: float
    beyond: tuple[tuple[float, float, bool], ...]

    @property
    def least_left(self) -> float:
        """The least that one refinement leaves of what is sharp; infinite where nothing is."""
        left = [each for sharpness, *ends in self.edges if sharpness for each in ends]
        left += [each for sharpness, each, _ in self.beyond if sharpness]
        if self.vertex:
            left.append(max(self.vertex - 1, 0.0))
        return min(left, default=math.inf)

    def sharpened(self, by: int) -> FanSharpness:
        """The same with more sharpness of all that is sharp."""
        return FanSharpness(
            tuple((row[0] + by, row[1] + by, row[2] + by) if row[0] else row for row in self.edges),
            self.vertex and self.vertex + by,
            tuple((row[0] + by, row[1] + by, row[2]) if row[0] else row for row in self.beyond),
        )


def _decayed(sharpness: FloatArray) -> FloatArray:
    return np.maximum(sharpness - 1, 0)
