"""Weights of every vertex of a tessellation: made once, applied whenever the control points move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cage.connectivity import IntArray, Topology
from ..evaluation.element import element_stencils
from ..evaluation.normals import unit_normals
from ..patches import PatchGroup, PatchTable
from ..schemes.domain import FloatArray
from .grid import Grid, QuadGrid, edge_vertices
from .triangle_grid import TriangleGrid
from .writers import write_triangles

# Patches are evaluated in runs of about this many control points, which bounds temporary memory.
CHUNK = 1 << 20


@dataclass(frozen=True, eq=False)
class Tessellation:
    """Triangles on a limit surface.

    Attributes
    ----------
    positions, normals : (n, 3) float64
        Exact points and unit normals of the limit surface.
    triangles : (m, 3) uint32
        0-based vertices, counter-clockwise from outside. Neighbours share vertices: there are no cracks.
    element : (m,) uint32
        0-based element of each triangle.
    texcoords : (n, 2) float64 or None
        Texture coordinates. Along their seams, and those of other attributes, vertices have copies with the same
        position and normal.
    attributes : dict of str to (n, k) float64
        The cage's other attributes.
    """

    positions: FloatArray
    normals: FloatArray
    triangles: NDArray[np.uint32]
    element: NDArray[np.uint32]
    texcoords: FloatArray | None = None
    attributes: Mapping[str, FloatArray] = field(default_factory=dict)

    def save(self, path: str | Path) -> None:
        """Write to a ``.ply``, ``.usd``, ``.usda`` or ``.usdc`` file, in single precision.

        Raises
        ------
        ValueError
            If the format is unknown, or the package that writes it is missing.
        OSError
            If the file cannot be written; an existing one is then left as it was.
        """
        write_triangles(path, self.positions, self.normals, self.triangles)


@dataclass(frozen=True, eq=False)
class SampleBlock:
    """The same samples on many patches of one class.

    With ``o = C[controls[p, 0]]``, vertex ``vertices[p, s]`` lies at ``o + weights[0, s] @ (C[controls[p]] - o)``, and
    has the tangents ``weights[1, s] @ (..)`` and ``weights[2, s] @ (..)``.

    Attributes
    ----------
    weights : (3, S, K) float64
        Rows of the first sum to one, of the others to zero.
    controls : (P, K) uint32
    vertices : (P, S) uint32
    corners : (P,) int64
        The corners of elements that the parameters start from, half-edges of `PatchTable.elements`.
    uv : (S, 2) float64
        The samples' parameters.
    """

    weights: FloatArray
    controls: NDArray[np.uint32]
    vertices: NDArray[np.uint32]
    corners: IntArray
    uv: FloatArray


@dataclass(frozen=True, eq=False)
class SamplingTable:
    """A tessellation's vertices as weights over control points, its triangles, and its elements.

    Attributes
    ----------
    control_count, vertex_count, patch_count : int
    blocks : tuple of SampleBlock
        Together they hold every vertex once.
    triangles : (m, 3) uint32
    element : (m,) uint32
    welded : (vertex_count,) int64
        For each vertex, the one whose position it takes: a crease has vertices of its own on either side, with their
        own normals but the same positions, bit by bit.
    """

    control_count: int
    vertex_count: int
    patch_count: int
    blocks: tuple[SampleBlock, ...]
    triangles: NDArray[np.uint32]
    element: NDArray[np.uint32]
    welded: IntArray

    @classmethod
    def build(
        cls, patches: PatchTable, rate: int, copy_of: IntArray | None = None, control_count: int | None = None
    ) -> SamplingTable:
        """Prepare the uniform tessellation of a cage's patches.

        Parameters
        ----------
        rate : int
            Segments per edge, at least 1.
        copy_of : (n_v,) int64, optional
            The control point that each vertex of the patches' topology is a copy of, where that is a cut mesh.
        control_count : int, optional
            Number of control points.

        Raises
        ------
        ValueError
            If the rate is below 1.
        """
        if rate < 1:
            raise ValueError(f"tessellation rate {rate}; expected 1 or more segments per edge")
        grid = uniform_grid(patches.elements, rate, patches.scheme.domain.corner_count)
        if copy_of is None:
            copy_of = np.arange(patches.topology.vertex_count)
        blocks = tuple(block for group in patches.groups for block in _group_blocks(patches, group, grid, copy_of))
        return cls(
            control_count or patches.topology.vertex_count,
            grid.vertex_count,
            patches.patch_count,
            blocks,
            grid.triangles,
            grid.element,
            _welded(patches, grid, copy_of),
        )

    def apply(self, control_points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Evaluate every vertex in float64.

        Parameters
        ----------
        control_points : (control_count, 3) float64

        Returns
        -------
        positions, normals : (vertex_count, 3) float64
        """
        positions = np.empty((self.vertex_count, 3))
        normals = np.empty((self.vertex_count, 3))
        for block in self.blocks:
            _, sample_count, control_count = block.weights.shape
            matrix = block.weights.reshape(-1, control_count)
            run = max(1, CHUNK // control_count)
            for begin in range(0, len(block.controls), run):
                controls, vertices = block.controls[begin : begin + run], block.vertices[begin : begin + run]
                origin = control_points[controls[:, 0]]
                relative = control_points[controls.T] - origin
                values = (matrix @ relative.reshape(control_count, -1)).reshape(3, sample_count, -1, 3)
                positions[vertices.T] = values[0] + origin
                normals[vertices.T] = unit_normals(*values[1:].reshape(2, -1, 3)).reshape(values[1].shape)
        return positions[self.welded], normals

    def locations(self) -> tuple[IntArray, FloatArray]:
        """Where each vertex lies on the surface.

        Returns
        -------
        corner : (vertex_count,) int64
            The corner of an element that the parameters start from, a half-edge of `PatchTable.elements`.
        uv : (vertex_count, 2) float64
            Samples at corners have (0, 0).
        """
        corner = np.empty(self.vertex_count, dtype=np.int64)
        uv = np.empty((self.vertex_count, 2))
        for block in self.blocks:
            corner[block.vertices] = block.corners[:, None]
            uv[block.vertices] = block.uv
        return corner, uv

    def tessellation(self, control_points: FloatArray) -> Tessellation:
        """Evaluate into a triangle mesh."""
        return Tessellation(*self.apply(control_points), self.triangles, self.element)


def uniform_grid(elements: Topology, rate: int, corner_count: int) -> Grid:
    """Numbering of a uniform tessellation over a domain with so many corners."""
    return (QuadGrid if corner_count == 4 else TriangleGrid)(elements, rate)


def _group_blocks(patches: PatchTable, group: PatchGroup, grid: Grid, copy_of: IntArray) -> Iterator[SampleBlock]:
    """Blocks of one class: for each part of its grid, the patches that evaluate that part."""
    layout = grid.layout(group.corners)
    weights = element_stencils(patches.scheme, group.signature, layout.uv)
    controls = copy_of[group.controls].astype(np.uint32)
    for part in layout.parts:
        if len(part.samples) and part.evaluates.any():
            chosen = np.flatnonzero(part.evaluates)
            yield SampleBlock(
                np.ascontiguousarray(weights[:, part.samples]),
                controls[chosen],
                layout.vertices[chosen[:, None], part.samples].astype(np.uint32),
                part.corners[chosen],
                part.uv,
            )


def _welded(patches: PatchTable, grid: Grid, copy_of: IntArray) -> IntArray:
    """For each vertex, the one whose position it takes."""
    welded = np.arange(grid.vertex_count)
    if patches.scheme.element == "vertex":
        return welded
    t = patches.topology
    first_copy = np.empty(t.vertex_count, dtype=np.int64)
    first_copy[copy_of[::-1]] = np.arange(t.vertex_count - 1, -1, -1)
    welded[: t.vertex_count] = first_copy[copy_of]

    # The two sides of a crease are border edges between copies of the same vertices, in opposite directions.
    border = np.flatnonzero(t.twin < 0)
    start, end = copy_of[t.face_vertices[border]], copy_of[t.face_vertices[t.next[border]]]
    keys = np.minimum(start, end) * t.vertex_count + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    is_pair = np.flatnonzero(np.diff(keys[order]) == 0)
    one, other = border[order[is_pair]], border[order[is_pair + 1]]
    steps = np.arange(1, grid.rate)
    welded[edge_vertices(t, grid.rate, other, steps)] = edge_vertices(t, grid.rate, one, grid.rate - steps)
    return welded
