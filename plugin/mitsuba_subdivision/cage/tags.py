"""Creases and corners of a control cage, checked."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..mesh.connectivity import IntArray, Topology
from ..mesh.cuts import Sharpness
from ..mesh.sharpness import INFINITE
from .errors import CageError, in_digits, number_of_such, warn
from .source import CageSource
from .validation import read_only

# Up to this number, float64 holds every integer.
_LARGEST_INDEX = 2**53


def validated_tags(
    topology: Topology,
    creases: Sequence[tuple[int, int, float]] | NDArray,
    corners: Sequence[tuple[int, float]] | NDArray,
    source: CageSource,
) -> Sharpness:
    """Check creases and corners. If an edge or vertex is given more than once, its last sharpness counts.

    As in OpenSubdiv, those that name an edge or a vertex that the mesh does not have are ignored.

    Raises CageError if rows are no numbers of vertices, or a sharpness is negative or not a number. Warns if creases or
    corners are ignored.
    """
    edges = _table(creases, 3, "creases", "(vertex, vertex, sharpness)", source)
    vertices = _table(corners, 2, "corners", "(vertex, sharpness)", source)
    if not len(edges) and not len(vertices):
        return Sharpness(_zeros(topology.half_edge_count), _zeros(topology.vertex_count))
    starts, ends = edges[:, :2].astype(np.int64).T
    half_edge = _half_edges_between(topology, starts, ends)
    vertex = vertices[:, 0].astype(np.int64)

    def at_edge(row: int) -> str:
        return f"{source.at_tag('creases', row)}: crease along {source.edge(starts[row], ends[row])}"

    def at_vertex(row: int) -> str:
        return f"{source.at_tag('corners', row)}: corner at {source.vertex(vertex[row])}"

    require_sharpness(edges[:, 2], at_edge)
    require_sharpness(vertices[:, 1], at_vertex)
    is_edge, is_vertex = half_edge >= 0, (vertex >= 0) & (vertex < topology.vertex_count)
    _warn_of_ignored(is_edge, at_edge, "is no edge of a face", "crease", source)
    _warn_of_ignored(is_vertex, at_vertex, f"is none of {topology.vertex_count} vertices", "corner", source)

    half_edge, sharpness = half_edge[is_edge], edges[is_edge, 2]
    twin = topology.twin[half_edge]
    has_twin = twin >= 0
    both_sides = np.concatenate([half_edge, twin[has_twin]])
    return Sharpness(
        _sharpness(topology.half_edge_count, both_sides, np.concatenate([sharpness, sharpness[has_twin]])),
        _sharpness(topology.vertex_count, vertex[is_vertex], vertices[is_vertex, 1]),
    )


def validated_edges(topology: Topology, edges: ArrayLike, source: CageSource) -> IntArray:
    """Check pairs of vertices, and find a half-edge of each.

    Raises CageError if a pair is no edge of two faces, or is given twice.
    """
    t, ends = topology, np.asarray(edges)
    if ends.size and (ends.dtype.kind not in "iu" or ends.shape != (len(ends), 2)):
        raise CageError(f"{source.name}: edges of shape {ends.shape} and type {ends.dtype}; expected integers, (n, 2)")
    ends = ends.astype(np.int64).reshape(-1, 2)
    found = _half_edges_between(t, *ends.T).astype(np.int64)

    def where(row: int) -> str:
        return f"{source.name}: {source.edge(*ends[row])}"

    _require(found >= 0, where, "is no edge of a face", "edges of two faces", source)
    _require(t.twin[found] >= 0, where, "is infinitely sharp, as it has not two faces", "edges of two faces", source)
    is_first = np.zeros(len(found), dtype=bool)
    is_first[np.unique(t.edge[found], return_index=True)[1]] = True
    _require(is_first, where, "is given twice", "each edge once", source)
    return found


def _require(
    holds: NDArray[np.bool_], where: Callable[[int], str], problem: str, expected: str, source: CageSource
) -> None:
    for row in np.flatnonzero(~holds)[:1]:
        raise CageError(f"{where(row)} {problem}; expected {expected} (numbers count from {source.index_base})")


def _sharpness(count: int, indices: IntArray, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Read-only values at some indices, and zero elsewhere."""
    if not len(indices):
        return _zeros(count)
    found = np.zeros(count)
    found[indices] = np.minimum(values, INFINITE)
    return read_only(found)


def _zeros(count: int) -> NDArray[np.float64]:
    """Read-only zeros. As in most cages nothing is sharp, they take no memory."""
    return np.broadcast_to(0.0, count)


def _table(
    rows: Sequence[tuple[float, ...]] | NDArray, columns: int, name: str, expected: str, source: CageSource
) -> NDArray[np.float64]:
    try:
        table = np.array(rows, dtype=np.float64).reshape(len(rows), columns)
    except (TypeError, ValueError, OverflowError) as error:
        raise CageError(f"{source.name}: {name} are not a table ({error}); expected rows {expected}") from error
    if not len(table):
        return table
    vertices = table[:, :-1]
    is_index = (vertices == np.floor(vertices)) & (np.abs(vertices) <= _LARGEST_INDEX)
    for row in np.flatnonzero(~is_index.all(axis=1))[:1]:
        raise CageError(f"{source.at_tag(name, row)}: {name} have the row {table[row].tolist()}; expected {expected}")
    return table


def _half_edges_between(topology: Topology, starts: IntArray, ends: IntArray) -> IntArray:
    """A half-edge between each pair of vertices, in either direction; -1 where there is none."""
    if not len(starts):
        return np.zeros(0, dtype=np.int64)
    n = topology.vertex_count
    half_edges = topology.edge_half_edge
    a, b = topology.face_vertices[half_edges], topology.face_vertices[topology.next[half_edges]]
    keys = np.minimum(a, b).astype(np.int64) * n + np.maximum(a, b)
    # Of several edges between the same vertices, the first is taken.
    order = np.argsort(keys, kind="stable")
    wanted = np.minimum(starts, ends) * n + np.maximum(starts, ends)
    index = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
    found = order[index]
    inside = (np.minimum(starts, ends) >= 0) & (np.maximum(starts, ends) < n)
    return np.where(inside & (keys[found] == wanted), half_edges[found], -1)


def _warn_of_ignored(
    is_there: NDArray[np.bool_], where: Callable[[int], str], problem: str, noun: str, source: CageSource
) -> None:
    missing = np.flatnonzero(~is_there)
    if len(missing):
        such = number_of_such(len(missing), noun)
        warn(f"{where(missing[0])}, which {problem}, is ignored ({such}; numbers count from {source.index_base})")


def require_sharpness(values: NDArray[np.float64], where: Callable[[int], str]) -> None:
    """Raise an error if a sharpness is negative or not a number; ``where`` is the beginning of its message by row."""
    for row in np.flatnonzero(~(values >= 0))[:1]:
        raise CageError(
            f"{where(row)} has sharpness {in_digits(values[row])}; expected 0 for smooth, up to {INFINITE:g} for "
            "semi-sharp, or more for infinitely sharp"
        )
