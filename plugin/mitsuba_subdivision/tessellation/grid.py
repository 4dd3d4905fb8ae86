"""Grids: the numbering of a uniform tessellation, over the squares or triangles that are a scheme's domain."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, Topology
from ..patches import PatchTable
from ..schemes.domain import FloatArray
from .outline import GridLayout, Outline
from .quad_grid import QuadGrid


class Grid(Protocol):
    """Numbering of a uniform tessellation."""

    @property
    def topology(self) -> Topology:
        """Of the elements: each face is an element, and a half-edge stands for the corner where it begins."""
        ...

    @property
    def rate(self) -> int:
        """Segments on every edge."""
        ...

    @property
    def outline(self) -> Outline:
        """Numbering of the vertices at corners and on edges."""
        ...

    @property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        ...

    def layout(self, corners: IntArray) -> GridLayout:
        """Grids of the patches that begin at these corners; all of them whole elements, or none."""
        ...

    @property
    def triangle_counts(self) -> IntArray:
        """``(n_f,)`` triangles of each element."""
        ...

    def triangle_parameters(self) -> tuple[FloatArray, FloatArray]:
        """Parameters at the corners of an element's triangles.

        Returns
        -------
        whole : (T, 3, 2) float64
            Of an element that fits the domain, seen from its first corner.
        corner : (T, 3, 2) float64
            Of a corner of any other element, to which so many triangles belong for each; seen from that corner. Some
            may reach beyond u = 1, into the next corner.
        """
        ...

    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        ...

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        ...


def grid_of(patches: PatchTable, rate: int) -> Grid:
    """The grid over the elements of some patches."""
    elements = patches.elements
    if patches.scheme.domain.corner_count == 4:
        return QuadGrid(elements, rate)
    from .triangle_grid import TriangleGrid

    return TriangleGrid(elements, rate)
