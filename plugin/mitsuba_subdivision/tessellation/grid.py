"""Grids: how a tessellation numbers its vertices and triangles, and where these lie."""

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
        """Where each vertex lies on the surface.

        Returns
        -------
        half_edge : (vertex_count,) int64
            The corner of an element that the parameters start from, a half-edge of `PatchTable.elements`.
        uv : (vertex_count, 2) float64
            Samples at corners have (0, 0).
        """
        ...

    def cut(self, topology: Topology) -> Grid:
        """The same triangles over elements of the same half-edges that are cut along more edges: more vertices.

        Vertices on a cut have a copy on each side, and lie on their side of it.
        """
        ...

    def vertices_of(self, other: Any) -> IntArray:
        """``(vertex_count,)`` for each vertex, that at the same place of a grid of which this one is a `cut`."""
        ...
