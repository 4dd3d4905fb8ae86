"""Uniform tessellations, with the same number of segments on all edges of a cage."""

from __future__ import annotations

import operator
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from ..mesh import IntArray, ragged
from ..mesh.shared import shared
from ..patches.patch_table import PatchClass, PatchTable
from ..schemes.domain import FloatArray
from .memory import require_memory
from .uniform_grid import GridPart, UniformGrid, first_sides
from .vertex_table import VertexPolynomials, VertexRuns, VertexTable, vertex_polynomials

# Most vertices of a tessellation: buffer sizes have 32 bits, and there are two triangles, of three indices, per vertex.
MOST_VERTICES = ((1 << 32) - 1) // 6


def uniform_table(patches: PatchTable, rate: int) -> VertexTable:
    """Prepare the tessellation of a cage's patches with a number of segments per edge; equal calls share the table.

    Raises ValueError if the rate is no integer, below 1, or so high that there are more than MOST_VERTICES vertices.
    Raises MemoryError if the tessellation would not fit into memory.
    """
    return shared(_table, patches, checked_rate(rate))


def _table(patches: PatchTable, rate: int) -> VertexTable:
    grid = UniformGrid(patches.scheme.domain, patches.elements, rate)
    if grid.vertex_count > MOST_VERTICES:
        expected = f"at most {MOST_VERTICES}, whose triangles fit into a buffer"
        raise ValueError(f"tessellation rate {rate} makes {grid.vertex_count} vertices; expected {expected}")
    require_memory(patches, grid)
    return VertexTable(patches, patches.patch_count, grid, _polynomials(patches, grid), _copies(patches, grid))


def checked_rate(rate: int, name: str = "tessellation rate") -> int:
    """Check that a rate is an integer of 1 or more, and return it. Raises a ValueError that begins with ``name``."""
    try:
        checked = operator.index(rate)
    except TypeError:
        raise ValueError(f"{name} {rate!r}; expected an integer") from None
    if checked < 1:
        raise ValueError(f"{name} {rate}; expected 1 or more segments per edge")
    return checked


def _polynomials(patches: PatchTable, grid: UniformGrid) -> tuple[VertexPolynomials, ...]:
    """The polynomials on which the vertices lie, class by class and part by part of the grid."""
    classes: list[PatchClass] = []
    uv: list[FloatArray] = []
    # The class, part, and patches of each kind of run.
    kinds: list[tuple[int, GridPart, slice, int]] = []
    for layout_classes, layout_uv, parts in _layouts(patches, grid):
        bounds = ragged.offsets([len(patch_class.corners) for patch_class in layout_classes])
        for part in parts:
            ends = np.searchsorted(part.patches, bounds).tolist()
            for index, (begin, end) in enumerate(pairwise(ends)):
                if begin < end and len(part.samples):
                    kinds.append((len(classes) + index, part, slice(begin, end), bounds[index]))
        classes += layout_classes
        uv += [layout_uv] * len(layout_classes)
    runs = VertexRuns(
        np.array([kind for kind, *_ in kinds]),
        np.array([len(part.samples) for _, part, *_ in kinds]),
        np.concatenate([part.samples for _, part, *_ in kinds]),
        np.concatenate([part.offsets for _, part, *_ in kinds]),
        np.repeat(np.arange(len(kinds)), [of_kind.stop - of_kind.start for *_, of_kind, _ in kinds]),
        np.concatenate([part.patches[of_kind] - first for _, part, of_kind, first in kinds]),
        np.concatenate([part.first_vertex[of_kind] for _, part, of_kind, _ in kinds]),
    )
    return vertex_polynomials(patches.scheme, classes, uv, runs)


def _layouts(patches: PatchTable, grid: UniformGrid) -> Iterator[tuple[list[PatchClass], FloatArray, list[GridPart]]]:
    """The classes of whole elements, and those of elements' corners, with their `UniformGrid.layout`."""
    by_wholeness: dict[bool, list[tuple[PatchClass, IntArray]]] = {True: [], False: []}
    for patch_class in patches.evaluated.classes:
        corners = patches.places(patch_class)
        # The first patch represents its class: all patches of a class lie in elements with the same number of corners,
        # which is the valence of the element's centre in the cage refined once.
        element = patches.elements.face[corners[:1]]
        by_wholeness[bool(patches.is_whole[element][0])].append((patch_class, corners))
    for pairs in filter(None, by_wholeness.values()):
        classes, corners_of_class = zip(*pairs, strict=True)
        # A patch of the cage refined once covers only one corner of an element, even of a whole one.
        yield [*classes], *grid.layout(np.concatenate(corners_of_class), are_corners=patches.refined is not None)


def _copies(patches: PatchTable, grid: UniformGrid) -> IntArray:
    """`VertexTable.copies` on the boundary of the cage and the sides of its creases: at corners, then inside edges."""
    t, control_of_vertex = patches.elements, patches.control_of_vertex
    border = np.flatnonzero(t.twin < 0)
    if patches.scheme.element == "vertex" or not len(border):
        return np.empty((2, 0), dtype=np.int64)
    used = np.flatnonzero(t.vertex_half_edge >= 0)
    control = control_of_vertex[used]
    first_copy = used[ragged.first_indices(control, patches.control_count)[control]]
    at_corners = grid.corner_vertex[np.stack([used, first_copy])[:, first_copy != used]]
    # A crease of one edge between darts has two sides, although its ends have no copies.
    start, steps = control_of_vertex[t.face_vertices], np.arange(1, grid.rate)
    original = first_sides(t, border, start)
    copy, original = border[original != border], original[original != border]
    originals = grid.along(original, steps)
    originals = np.where((start[original] != start[copy])[:, None], originals[:, ::-1], originals)
    return np.concatenate([at_corners, np.stack([grid.along(copy, steps), originals]).reshape(2, -1)], axis=1)
