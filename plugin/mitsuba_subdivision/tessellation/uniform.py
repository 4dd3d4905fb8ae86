"""Uniform tessellations: as many segments on each edge of a cage."""

from __future__ import annotations

import operator
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.shared import Content, Shared
from ..patches import PatchClass, PatchTable
from ..schemes.domain import FloatArray
from .memory import require_memory
from .quad_grid import QuadGrid
from .uniform_grid import GridPart, UniformGrid
from .vertex_polynomials import VertexPolynomials, VertexRuns, vertex_polynomials
from .vertex_table import VertexTable

# Buffers have sizes of 32 bits; to each vertex belong two triangles, of three numbers each.
MOST_VERTICES = ((1 << 32) - 1) // 6


def uniform_table(
    patches: PatchTable,
    rate: int,  # Segments per edge, at least 1
    # (n_v,) int64: 0-based control point at each mesh vertex, where the mesh has several copies of some
    control_of_vertex: IntArray | None = None,
    control_count: int | None = None,  # Number of control points. By default there is one for each mesh vertex.
) -> VertexTable:
    """Prepare the uniform tessellation of a cage's patches; the same for equal arguments, while somebody holds it.

    Raises ValueError if the rate is no integer, below 1, or so high that there are more vertices than buffers hold.
    Raises MemoryError if the tessellation would not fit into memory.
    """

    def make() -> VertexTable:
        grid = _checked_grid(patches, rate)
        count = control_count or patches.topology.vertex_count
        control = np.arange(count) if control_of_vertex is None else control_of_vertex
        controls, refinement = patches.control_rows(control, count)
        polynomials, copies = _polynomials(patches, grid), _copies(patches, grid, control)
        return VertexTable(count, patches.patch_count, grid, polynomials, controls, copies, refinement)

    return _TABLES.get((patches, checked_rate(rate), Content(control_of_vertex), control_count), make)


_TABLES: Shared[VertexTable] = Shared()


def _checked_grid(patches: PatchTable, rate: int) -> UniformGrid:
    """The grid over the elements of some patches, which is known to fit into buffers and memory."""
    checked = checked_rate(rate)
    grid = _grid(patches, checked)
    if grid.vertex_count > MOST_VERTICES:
        raise ValueError(
            f"tessellation rate {checked} makes {grid.vertex_count} vertices; expected at most {MOST_VERTICES}, whose "
            "triangles fit into a buffer"
        )
    require_memory(patches, grid)
    return grid


def _grid(patches: PatchTable, rate: int) -> UniformGrid:
    if patches.scheme.domain.corner_count == 4:
        return QuadGrid(patches.elements, rate)
    from .triangle_grid import TriangleGrid

    return TriangleGrid(patches.elements, rate)


def checked_rate(rate: int, name: str = "tessellation rate") -> int:
    """A rate that is an integer of 1 or more. Raises ValueError if it is none. The message begins with the name."""
    try:
        checked = operator.index(rate)
    except TypeError:
        raise ValueError(f"{name} {rate!r}; expected an integer") from None
    if checked < 1:
        raise ValueError(f"{name} {rate}; expected 1 or more segments per edge")
    return checked


def _polynomials(patches: PatchTable, grid: UniformGrid) -> tuple[VertexPolynomials, ...]:
    """What the vertices lie on, class by class and part by part of the grid."""
    classes: list[PatchClass] = []
    uv: list[FloatArray] = []
    # Of each kind: its class, samples, patches and first vertices.
    kinds: list[tuple[int, IntArray, IntArray, IntArray]] = []
    for own_classes, samples, parts in _layouts(patches, grid):
        bounds = ragged.offsets([len(patch_class.corners) for patch_class in own_classes])
        for part in parts:
            ends = np.searchsorted(part.patches, bounds).tolist()
            for index, (begin, end) in enumerate(pairwise(ends)):
                if begin < end and len(part.samples):
                    patch = part.patches[begin:end] - bounds[index]
                    kinds.append((len(classes) + index, part.samples, patch, part.first_vertex[begin:end]))
        classes += own_classes
        uv += [samples] * len(own_classes)
    of_class, samples_of_kind, patch_of_run, first_vertex = zip(*kinds, strict=True)
    runs = VertexRuns(
        np.array(of_class),
        np.array([len(own) for own in samples_of_kind]),
        np.concatenate(samples_of_kind),
        np.repeat(np.arange(len(kinds)), [len(own) for own in patch_of_run]),
        np.concatenate(patch_of_run),
        np.concatenate(first_vertex),
    )
    return vertex_polynomials(patches.scheme, classes, uv, runs)


def _layouts(patches: PatchTable, grid: UniformGrid) -> Iterator[tuple[list[PatchClass], FloatArray, list[GridPart]]]:
    """Classes whose patches have grids of a kind, and `UniformGrid.layout` of all.

    A patch's grid is that of a whole element, or of an element's corner.
    """
    refined = patches.refined
    of_kind: dict[bool, list[tuple[PatchClass, IntArray]]] = {True: [], False: []}
    for patch_class in (patches if refined is None else refined.table).classes:
        corners = patch_class.corners if refined is None else refined.corners(patch_class)
        # The first patch stands for its class. In the cage refined once, too, all patches of a class lie in elements of
        # the same number of corners: it is the valence of the elements' centres.
        element = patches.elements.face[corners[:1]]
        of_kind[bool(patches.is_whole[element][0])].append((patch_class, corners))
    for found in filter(None, of_kind.values()):
        corners = np.concatenate([corners for _, corners in found])
        if refined is not None and isinstance(grid, QuadGrid):
            # Even where an element is whole, a patch of the cage refined once covers one of its corners only.
            layout = grid.corner_layout(corners)
        else:
            layout = grid.layout(corners)
        yield [patch_class for patch_class, _ in found], *layout


def _copies(patches: PatchTable, grid: UniformGrid, control_of_vertex: IntArray) -> IntArray:
    """`VertexTable.copies`: at the corners of elements, then inside edges.

    The border of the mesh is the boundary of the cage and the sides of its creases.
    """
    t = patches.elements
    border = np.flatnonzero(t.twin < 0)
    if patches.scheme.element == "vertex" or not len(border):
        return np.empty((2, 0), dtype=np.int64)
    used = np.flatnonzero(t.vertex_half_edge >= 0)[::-1]
    # Of several copies of a control point, the last that is assigned stays: the first one.
    first_copy = np.empty(t.vertex_count, dtype=np.int64)
    first_copy[control_of_vertex[used]] = used
    later = used[first_copy[control_of_vertex[used]] != used]
    at_corners = grid.corner_vertex[np.stack([later, first_copy[control_of_vertex[later]]])]
    return np.concatenate([at_corners, _copies_inside_edges(grid, border, control_of_vertex)], axis=1)


def _copies_inside_edges(grid: UniformGrid, border: IntArray, control_of_vertex: IntArray) -> IntArray:
    """Copies inside border edges that join the same control points, as the sides of a crease do.

    They are two edges in opposite directions, or more where the cage is no manifold. A crease of one edge between darts
    has two sides, too, though its ends have no copies.
    """
    t = grid.topology
    start, end = control_of_vertex[t.face_vertices[border]], control_of_vertex[t.face_vertices[t.next[border]]]
    keys = np.minimum(start, end) * t.vertex_count + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    begins = np.flatnonzero(np.diff(keys[order], prepend=-1))
    first = np.repeat(order[begins], np.diff(begins, append=len(order)))
    one, other = first[first != order], order[first != order]
    steps = np.arange(1, grid.rate)
    along = grid.along(border[one], steps)
    is_reversed = (start[one] != start[other])[:, None]
    along = np.where(is_reversed, along[:, ::-1], along)
    return np.stack([grid.along(border[other], steps), along]).reshape(2, -1)
