"""Grids: the numbering and locations of a tessellation's vertices and triangles."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray


class Grid(Protocol):
    """Numbering of a tessellation: the same for all surfaces over the same elements."""

    @property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        ...

    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        ...

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        ...

    def locations(self) -> tuple[IntArray, FloatArray]:
        """Locations of the vertices on the surface.

        Returns
        -------
        half_edge : (vertex_count,) int64
            Corner of an element at the origin of the parameters, a half-edge of `PatchTable.elements`.
        uv : (vertex_count, 2) float64
            Samples at corners have (0, 0).
        """
        ...

    def cut(self, topology: Topology) -> Grid:
        """The same triangles over elements with the same half-edges, cut along more edges.

        Vertices on a cut have a copy on each side, and lie on their side of it.
        """
        ...

    def vertices_of(self, other: Any) -> IntArray:
        """``(vertex_count,)`` for each vertex, its original in a grid of which this one is a `cut`."""
        ...
