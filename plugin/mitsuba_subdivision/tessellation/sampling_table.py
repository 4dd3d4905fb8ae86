"""Weights of every vertex of a tessellation: made once, applied whenever the control points move."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..evaluation.element import element_stencils
from ..evaluation.normals import ROUNDED, unit_normals
from ..evaluation.product_patch import ProductPatch, product_patch
from ..files.triangle_writer import write_triangles
from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray, gathered
from ..patches import PatchClass, PatchTable
from ..progress import counted
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .grid import Grid, GridLayout, GridPart, VertexArray
from .memory import require_memory
from .quad_grid import QuadGrid
from .triangle_grid import TriangleGrid

if TYPE_CHECKING:
    from scipy import sparse

# Patches are evaluated in runs of about this many samples, which bounds temporary memory.
CHUNK = 1 << 14
# Buffers have sizes of 32 bits; to each vertex belong two triangles, of three numbers each.
MOST_VERTICES = ((1 << 32) - 1) // 6


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

    def __repr__(self) -> str:
        data = [*([] if self.texcoords is None else ["texcoords"]), *self.attributes]
        parts = [f"{len(self.positions)} vertices", f"{len(self.triangles)} triangles", *data]
        return f"Tessellation({', '.join(parts)})"

    def save(self, path: str | Path) -> None:
        """Write to a file: ``.obj`` with every digit; ``.ply``, ``.usd``, ``.usda`` or ``.usdc`` in single precision.

        Raises
        ------
        ValueError
            If the format is unknown, or the package that writes it is missing.
        OSError
            If the file cannot be written; an existing one is then left as it was.
        """
        write_triangles(path, self.positions, self.normals, self.triangles, self.texcoords, self.attributes)


@dataclass(frozen=True, eq=False)
class SampledClass:
    """Weights of all samples of a patch, for the patches of one class.

    With ``o = C[controls[p, 0]]``, sample ``s`` of patch ``p`` lies at ``o + weights[0, s] @ (C[controls[p]] - o)``,
    and has the tangents ``weights[1, s] @ (..)`` and ``weights[2, s] @ (..)``.

    Attributes
    ----------
    weights : (3, S, K) float64
        Rows of the first sum to one, of the others to zero.
    controls : (P, K) uint32
    first_control : int
        Place of the first one in `SamplingTable.controls`, where the others follow, column by column.
    uv : (S, 2) float64
        The samples' parameters in each patch.
    first_patch : int
        Number of the class's first patch in the table; the others follow.
    product : ProductPatch or None
        What the weights are products of, up to the tangents' turn and length, if anything.
    """

    weights: FloatArray
    controls: NDArray[np.uint32]
    first_control: int
    uv: FloatArray
    first_patch: int
    product: ProductPatch | None


@dataclass(frozen=True, eq=False)
class ClassPart:
    """The patches of a class that evaluate a part.

    Attributes
    ----------
    members : SampledClass
    part : GridPart
    rows : slice
        Of the part's patches, those of the class.
    """

    members: SampledClass
    part: GridPart
    rows: slice

    @property
    def patches(self) -> IndexArray:
        """``(p,)`` counted from the first of the class."""
        return self.part.patches[self.rows] - self.members.first_patch

    @property
    def first_vertex(self) -> VertexArray:
        """``(p,)`` as in `GridPart`."""
        return self.part.first_vertex[self.rows]


@dataclass(frozen=True, eq=False)
class SamplingTable:
    """A tessellation's vertices as weights over control points, its triangles, and its elements.

    Attributes
    ----------
    control_count, patch_count : int
    classes : tuple of SampledClass
        Those with samples to evaluate. Patches that are whole elements come before others; of both, those whose weights
        are products come first, then those with fewer control points.
    parts : tuple of GridPart
        Which samples of which patches are evaluated, and for which vertex. Together they hold every vertex once.
    class_parts : tuple of ClassPart
        The parts by class.
    grid : Grid
    controls : (n,) uint32
        Those of all classes.
    copies : (2, n) int64
        Vertices that take their position from another, and the other: a crease has vertices of its own on either side,
        with their own normals but the same positions, bit by bit.
    matrix : (n, control_count) sparse array or None
        Makes of the cage's control points those that the classes refer to, of the cage refined once; None where they
        refer to the cage's own.
    """

    control_count: int
    patch_count: int
    classes: tuple[SampledClass, ...]
    parts: tuple[GridPart, ...]
    class_parts: tuple[ClassPart, ...]
    grid: Grid
    controls: NDArray[np.uint32]
    copies: IntArray
    matrix: sparse.csr_array | None = None

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
            If the rate is no integer, below 1, or so high that there are more vertices than buffers hold.
        MemoryError
            If the tessellation would not fit into memory.
        """
        rate = _checked_rate(rate)
        grid_type = QuadGrid if patches.scheme.domain.corner_count == 4 else TriangleGrid
        grid = grid_type(patches.elements, rate)
        if grid.vertex_count > MOST_VERTICES:
            raise ValueError(
                f"tessellation rate {rate} makes {grid.vertex_count} vertices; expected at most {MOST_VERTICES}, whose "
                "triangles fit into a buffer"
            )
        require_memory(patches, grid)
        control_count = control_count or patches.topology.vertex_count
        if copy_of is None:
            copy_of = np.arange(control_count)
        refined, matrix = patches.refined, None
        if refined is not None:
            from scipy import sparse

            # Columns of copies of a control point add up.
            data, columns, rows = refined.matrix.data, copy_of[refined.matrix.indices], refined.matrix.indptr
            matrix = sparse.csr_array((data, columns, rows), shape=(refined.matrix.shape[0], control_count))
            matrix.sum_duplicates()
        controls = (patches if refined is None else refined.table).controls
        if matrix is None and len(copy_of) > control_count:
            controls = gathered(copy_of.astype(np.int32), controls)
        controls = controls.view(np.uint32)
        classes, parts, class_parts, first_patch = [], [], [], 0
        for groups, layout in _layouts(patches, grid):
            bounds = first_patch + ragged.offsets([len(group.corners) for group in groups])
            own = [part.shifted(first_patch) for part in layout.parts if len(part.samples) and len(part.patches)]
            # Of the same type, or else all patches would be converted.
            rows = np.array([np.searchsorted(part.patches, bounds.astype(part.patches.dtype)) for part in own])
            for i, group in enumerate(counted(groups, "Weights of patch classes")):
                evaluated = [
                    (part, slice(r[i], r[i + 1])) for part, r in zip(own, rows.tolist(), strict=True) if r[i] < r[i + 1]
                ]
                # At low rates others may evaluate all samples of a class.
                if evaluated:
                    members = _sampled(patches.scheme, group, layout.uv, controls, int(bounds[i]))
                    classes.append(members)
                    class_parts += [ClassPart(members, *found) for found in evaluated]
            parts += own
            first_patch = int(bounds[-1])
        return cls(
            control_count,
            patches.patch_count,
            tuple(classes),
            tuple(parts),
            tuple(class_parts),
            grid,
            controls,
            _copies(patches, grid, copy_of),
            matrix,
        )

    @property
    def vertex_count(self) -> int:
        return self.grid.vertex_count

    @cached_property
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        return self.grid.triangles()

    @cached_property
    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        return self.grid.element()

    @cached_property
    def welded(self) -> IntArray:
        """``(vertex_count,)`` for each vertex, the one whose position it takes."""
        welded = np.arange(self.vertex_count)
        welded[self.copies[0]] = self.copies[1]
        return welded

    def class_points(self, control_points: FloatArray) -> FloatArray:
        """The points that the classes' controls refer to, ``(n, k)``, from ``(control_count, k)`` of the cage."""
        return control_points if self.matrix is None else self.matrix @ control_points

    def apply(self, control_points: FloatArray, dtype: DTypeLike = np.float64) -> tuple[NDArray, NDArray]:
        """Evaluate every vertex.

        Parameters
        ----------
        control_points : (control_count, 3) float64
        dtype : float64 or float32
            Of the sums, which are relative to a control point of each patch, and of the result.

        Returns
        -------
        positions, normals : (vertex_count, 3)
            Normals are zero where the surface has none, see `SurfaceSamples`.
        """
        positions = np.empty((self.vertex_count, 3), dtype=dtype)
        normals = np.empty((self.vertex_count, 3), dtype=dtype)
        coordinates = np.ascontiguousarray(self.class_points(control_points).T)
        for evaluated in self.class_parts:
            members, samples, patches = evaluated.members, evaluated.part.samples, evaluated.patches
            count = len(samples)
            matrix = members.weights[:, samples].reshape(3 * count, -1).astype(dtype)
            frame_weights = np.abs(members.weights[1:, samples]).sum(axis=2).astype(dtype)
            run = max(1, CHUNK // count)
            for begin in range(0, len(patches), run):
                controls = members.controls[patches[begin : begin + run]].T
                origin = coordinates[:, None, controls[0]]
                # Coordinates come first, then point and tangents, samples, and patches.
                relative = (coordinates[:, controls] - origin).astype(dtype)
                values = (matrix @ relative).reshape(3, 3, count, -1)
                points, du, dv = np.moveaxis(values, (1, 0), (0, -1))
                vertices = evaluated.first_vertex[begin : begin + run] + np.arange(count)[:, None]
                positions[vertices] = points + np.moveaxis(origin, 0, -1)
                reach = np.abs(relative).max(axis=1)
                if self.matrix is not None:
                    # Points of the refined cage are rounded before they are seen from the origin.
                    reach = np.maximum(reach, ROUNDED[np.dtype(np.float64)] * np.abs(origin[:, 0]))
                normals[vertices] = unit_normals(du, dv, frame_weights[:, :, None], reach.T)
        positions[self.copies[0]] = positions[self.copies[1]]
        return positions, normals

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
        for part in self.parts:
            vertices = part.first_vertex[:, None] + np.arange(len(part.samples))
            corner[vertices] = part.corners[:, None]
            uv[vertices] = part.uv
        return corner, uv


def _checked_rate(rate: int) -> int:
    try:
        checked = operator.index(rate)
    except TypeError:
        raise ValueError(f"tessellation rate {rate!r}; expected an integer") from None
    if checked < 1:
        raise ValueError(f"tessellation rate {rate}; expected 1 or more segments per edge")
    return checked


def _layouts(patches: PatchTable, grid: Grid) -> Iterator[tuple[list[PatchClass], GridLayout]]:
    """Groups of patches with grids of a kind, in the order of `SamplingTable.classes`, and the grids of all of them."""
    table = patches if patches.refined is None else patches.refined.table
    size = grid.topology.face_sizes
    of_kind: dict[bool, list[PatchClass]] = {True: [], False: []}
    for group in table.classes:
        corner = group.corners[0] if patches.refined is None else group.corners[0] // 4
        of_kind[bool(size[grid.topology.face_of(corner)] == patches.scheme.domain.corner_count)].append(group)
    for groups in filter(None, of_kind.values()):
        groups.sort(key=lambda g: (product_patch(patches.scheme, g.signature) is None, g.controls.shape[1]))
        corners = np.concatenate([group.corners for group in groups])
        yield groups, grid.layout(corners) if patches.refined is None else grid.corner_layout(corners // 4)


def _sampled(
    scheme: Scheme, group: PatchClass, uv: FloatArray, controls: NDArray[np.uint32], first_patch: int
) -> SampledClass:
    """Weights of a group of patches at some samples."""
    weights, product = element_stencils(scheme, group.signature, uv), product_patch(scheme, group.signature)
    own = controls[group.first_control :][: group.controls.size].reshape(group.controls.shape[::-1]).T
    return SampledClass(weights, own, group.first_control, uv, first_patch, product)


def _copies(patches: PatchTable, grid: Grid, copy_of: IntArray) -> IntArray:
    """Vertices that take their position from another, and the other; ``(2, n)``."""
    t, outline = patches.elements, grid.outline
    border = np.flatnonzero(t.twin < 0)
    if patches.scheme.element == "vertex" or not len(border):
        return np.empty((2, 0), dtype=np.int64)
    used = np.flatnonzero(t.vertex_half_edge >= 0)[::-1]
    first_copy = np.empty(t.vertex_count, dtype=np.int64)
    first_copy[copy_of[used]] = used
    later = used[first_copy[copy_of[used]] != used]
    corners = outline.corner_vertex[np.stack([later, first_copy[copy_of[later]]])]

    # The sides of a crease are border edges between copies of the same vertices: two in opposite directions, or more
    # where the cage is no manifold. A crease of one edge between darts has no copies of vertices.
    start, end = copy_of[t.face_vertices[border]], copy_of[t.face_vertices[t.following(border)]]
    keys = np.minimum(start, end) * t.vertex_count + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    begins = np.flatnonzero(np.diff(keys[order], prepend=-1))
    first = np.repeat(order[begins], np.diff(begins, append=len(order)))
    one, other = first[first != order], order[first != order]
    steps = np.arange(1, grid.rate)
    is_reversed = (start[one] != start[other])[:, None]
    along = outline.along(border[one], steps)
    along = np.where(is_reversed, along[:, ::-1], along)
    inside = np.stack([outline.along(border[other], steps), along]).reshape(2, -1)
    return np.concatenate([corners, inside], axis=1)
