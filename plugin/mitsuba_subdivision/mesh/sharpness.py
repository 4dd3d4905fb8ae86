"""Sharpness of edges and vertices. It is infinite from 10; below, it lasts for a number of refinements (semi-sharp).

`Sharpness` (`cuts`) has that of the control cage, from its tags, including infinite sharpness. `SemiSharpness` has that
of a mesh that is cut along its infinitely sharp edges, where only finite sharpness remains. A `Fan` of a signature has
that around one vertex, from which `joined_rings` makes a `SemiSharpness` of the local mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .ragged import IntArray

FloatArray = NDArray[np.float64]

# Least sharpness that is infinite, as in OpenSubdiv.
INFINITE = 10.0

CreaseMethod = Literal["uniform", "chaikin"]


@dataclass(frozen=True, eq=False)
class SemiSharpness:
    """Semi-sharp edges and vertices of a mesh that is cut along its infinitely sharp edges.

    Copies of a vertex on the two sides of a cut must have the same position. So each copy has a row for every
    semi-sharp edge *across* the cut, which ends at another copy of the vertex.
    """

    # (n_h,) float64: sharpness of the edge of each half-edge, equal for both half-edges of an edge. 0 for smooth edges
    # and on borders.
    edges: FloatArray
    # (n_h,) float64: sharpness after the next refinement of the half of the edge at the origin of the half-edge
    edges_refined: FloatArray
    vertices: FloatArray  # (n_v,) float64: sharpness of each vertex
    across_vertex: IntArray  # (m,) int64: vertex of the cut mesh, for each row of a semi-sharp edge across the cut
    across_sharpness: FloatArray  # (m,) float64: sharpness of the edge
    # (m,) float64: sharpness after the next refinement of the half of the edge at the vertex
    across_refined: FloatArray
    # (m,) bool: whether the edge makes the vertex sharp. If not, it only contributes to the averages of Chaikin's
    # method.
    across_sharpens: NDArray[np.bool_]

    @classmethod
    def decaying(
        cls,
        origin: IntArray,  # (n_h,) int: vertex at which each half-edge begins
        # The following as in `SemiSharpness`
        edges: FloatArray,
        vertices: FloatArray,
        across_vertex: IntArray,
        across_sharpness: FloatArray,
        across_sharpens: NDArray[np.bool_],
        method: CreaseMethod,
    ) -> SemiSharpness | None:
        """Return the sharpness including that after the next refinement; None if nothing is sharp.

        A refinement lowers each sharpness by one. As in OpenSubdiv, Chaikin's method first replaces the sharpness of an
        edge by 3/4 of it plus 1/4 of the mean of the other semi-sharp edges at the vertex [DeRose et al. 1998].
        """
        if not (edges.any() or vertices.any() or across_sharpness.any()):
            return None
        sharpness = averaged = np.concatenate([edges, across_sharpness])
        if method == "chaikin":
            vertex = np.concatenate([origin, across_vertex])
            total = np.bincount(vertex, sharpness, minlength=len(vertices))[vertex]
            other_count = np.bincount(vertex, sharpness > 0, minlength=len(vertices))[vertex] - 1
            mean = (total - sharpness) / np.maximum(other_count, 1)
            averaged = np.where((sharpness > 0) & (other_count > 0), 0.75 * sharpness + 0.25 * mean, sharpness)
        edges_refined, across_refined = np.split(_lowered(averaged), [len(edges)])
        return cls(edges, edges_refined, vertices, across_vertex, across_sharpness, across_refined, across_sharpens)

    @property
    def vertices_refined(self) -> FloatArray:
        """``(n_v,)`` sharpness of the vertices after the next refinement."""
        return _lowered(self.vertices)

    def refined(
        self,
        origin: IntArray,  # (n_h',) vertex at which each refined half-edge begins
        edges: FloatArray,  # (n_h',) sharpness of each refined half-edge: `edges_refined`, or 0 for new edges
        new_vertex_count: int,  # Number of vertices that the refinement adds after the present ones
        method: CreaseMethod,
    ) -> SemiSharpness | None:
        """Return the sharpness of the refined mesh."""
        vertices = np.concatenate([self.vertices_refined, np.zeros(new_vertex_count)])
        # Edges that have become smooth are removed, so that signatures of equal surroundings are equal.
        kept = self.across_refined > 0
        across = self.across_vertex[kept], self.across_refined[kept], self.across_sharpens[kept]
        return SemiSharpness.decaying(origin, edges, vertices, *across, method)


def _lowered(sharpness: FloatArray) -> FloatArray:
    return np.maximum(sharpness - 1, 0)
