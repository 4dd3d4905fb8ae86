"""Sharpness of edges and vertices, infinite, or finite: below 10, which lasts for a number of refinements.

Three classes hold sharpness, each made from the one before:

`Sharpness` (`cuts`): of the control cage, from its tags.
    One number for each edge and each vertex, infinite sharpness among them.
`SemiSharpness`: of a mesh that is cut along its infinitely sharp edges.
    Infinite sharpness is now in the mesh itself, as borders and corners. The rest is finite. Each refinement of the
    mesh has its own (`SemiSharpness.refined`).
`FanSharpness`: around one vertex, seen from one of its faces, as a part of a `Signature`.
    The same numbers without those of vertices and edges: elements with equal ones share their limit stencils.
    `one_ring` writes them onto its local mesh as a `SemiSharpness` again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.integer]
FloatArray = NDArray[np.float64]

# From this sharpness on a feature is infinitely sharp, as in OpenSubdiv.
INFINITE = 10.0

CreaseMethod = Literal["uniform", "chaikin"]


@dataclass(frozen=True, eq=False)
class SemiSharpness:
    """Semi-sharp edges and vertices of a mesh that is cut along its infinitely sharp edges.

    Copies of a vertex on the two sides of a cut must move alike. So each also knows the semi-sharp edges *across* the
    cut, which end at another copy of the vertex; it has a row for each of them.
    """

    # (n_h,) float64: sharpness of the edge of each half-edge: both half-edges of an edge have the same. 0 for smooth
    # edges and on borders.
    edges: FloatArray
    # (n_h,) float64: sharpness that the next refinement gives the half of the edge at which the half-edge begins
    edges_refined: FloatArray
    vertices: FloatArray  # (n_v,) float64: sharpness of each vertex
    # (m,) int64: of semi-sharp edges across the cut, the vertex of the cut mesh that knows of the edge
    across_vertex: IntArray
    across_sharpness: FloatArray  # (m,) float64: sharpness of the edge
    across_refined: FloatArray  # (m,) float64: sharpness that the next refinement gives the half at the vertex
    # (m,) bool: whether the edge makes the vertex sharp. If not, it only takes part in the averages of Chaikin's
    # method.
    across_sharpens: NDArray[np.bool_]

    @classmethod
    def decaying(
        cls,
        origin: IntArray,  # (n_h,) int: vertex at which each half-edge begins
        # As `SemiSharpness` has them
        edges: FloatArray,
        vertices: FloatArray,
        across_vertex: IntArray,
        across_sharpness: FloatArray,
        across_sharpens: NDArray[np.bool_],
        method: CreaseMethod,
    ) -> SemiSharpness | None:
        """Find the sharpness after the next refinement; None where nothing is sharp.

        A refinement lowers each sharpness by one. Chaikin's method first replaces the sharpness of an edge by three
        quarters of it and a quarter of the mean of the other semi-sharp edges at the vertex [DeRose et al. 1998], as
        OpenSubdiv does.
        """
        if not (edges.any() or vertices.any() or across_sharpness.any()):
            return None
        sharpness = averaged = np.concatenate([edges, across_sharpness])
        if method == "chaikin":
            vertex = np.concatenate([origin, across_vertex])
            total = np.bincount(vertex, sharpness, minlength=len(vertices))[vertex]
            others = np.bincount(vertex, sharpness > 0, minlength=len(vertices))[vertex] - 1
            mean = (total - sharpness) / np.maximum(others, 1)
            averaged = np.where((sharpness > 0) & (others > 0), 0.75 * sharpness + 0.25 * mean, sharpness)
        edges_refined, across_refined = np.split(_lowered(averaged), [len(edges)])
        return cls(edges, edges_refined, vertices, across_vertex, across_sharpness, across_refined, across_sharpens)

    @property
    def vertices_refined(self) -> FloatArray:
        """``(n_v,)`` sharpness of the vertices after the next refinement."""
        return _lowered(self.vertices)

    def refined(
        self,
        # (n_h',): vertex at which each refined half-edge begins, and its sharpness: `edges_refined`, or 0 for
        # new edges
        origin: IntArray,
        edges: FloatArray,
        new_vertex_count: int,  # Number of vertices that are new
        method: CreaseMethod,
    ) -> SemiSharpness | None:
        """Sharpness of a refined mesh whose first vertices are those of this one."""
        vertices = np.concatenate([self.vertices_refined, np.zeros(new_vertex_count)])
        # Edges that have become smooth are dropped: kept at 0, they would make signatures of equal surroundings differ.
        kept = self.across_refined > 0
        across = self.across_vertex[kept], self.across_refined[kept], self.across_sharpens[kept]
        return SemiSharpness.decaying(origin, edges, vertices, *across, method)


# Of a smooth edge in `FanSharpness`: one for all, as a fan may have very many.
SMOOTH_EDGE = 0.0, 0.0, 0.0


class FanSharpness(NamedTuple):
    """Semi-sharp features at one vertex of a cut mesh, in an order that does not depend on numbers of edges."""

    # (sharpness, sharpness of the refined half at the vertex, of the half at the other end) of the edges at which the
    # faces of the fan begin, from the most clockwise face on
    edges: tuple[tuple[float, float, float], ...]
    vertex: float  # Sharpness of the vertex
    # (sharpness, sharpness of the refined half at the vertex, whether the edge sharpens the vertex) of semi-sharp edges
    # across the cut, in increasing order
    across: tuple[tuple[float, float, bool], ...]


def _lowered(sharpness: FloatArray) -> FloatArray:
    return np.maximum(sharpness - 1, 0)
