"""Validation of the creases and corners of a control cage."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..mesh.connectivity import IntArray, Topology
from ..mesh.cuts import Sharpness
from ..mesh.sharpness import INFINITE
from .errors import CageError, CageSource, in_digits, number_of_such, warn
from .validation import read_only

# float64 represents all integers up to this exactly.
_LARGEST_INDEX = 2**53


def validated_tags(
    topology: Topology,
    creases: Sequence[tuple[int, int, float]] | NDArray,
    corners: Sequence[tuple[int, float]] | NDArray,
    source: CageSource,
) -> Sharpness:
    """Check creases and corners. If an edge or vertex occurs more than once, its last sharpness is used.

    As in OpenSubdiv, creases and corners at edges and vertices that do not exist are ignored.

    Raises CageError if vertices are not integers, or a sharpness is negative or NaN. Warns if creases or corners are
    ignored.
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
    """Check edges, given as pairs of vertices, and return a half-edge of each.

    Raises CageError if a pair is not an edge of two faces, or occurs twice.
    """
    t, ends = topology, np.asarray(edges)
    if ends.size and (ends.dtype.kind not in "iu" or ends.shape != (len(ends), 2)):
        raise CageError(f"{source.name}: edges of shape {ends.shape} and type {ends.dtype}; expected integers, (n, 2)")
    ends = ends.astype(np.int64).reshape(-1, 2)
    half_edges = _half_edges_between(t, *ends.T).astype(np.int64)

    def where(row: int) -> str:
        return f"{source.name}: {source.edge(*ends[row])}"

    _require(half_edges >= 0, where, "is no edge of a face", "edges of two faces", source)
    _require(
        t.twin[half_edges] >= 0, where, "is infinitely sharp, as it has not two faces", "edges of two faces", source
    )
    is_first = np.zeros(len(half_edges), dtype=bool)
    is_first[np.unique(t.edge[half_edges], return_index=True)[1]] = True
    _require(is_first, where, "is given twice", "each edge once", source)
    return half_edges


def _require(
    holds: NDArray[np.bool_], where: Callable[[int], str], problem: str, expected: str, source: CageSource
) -> None:
    for row in np.flatnonzero(~holds)[:1]:
        raise CageError(f"{where(row)} {problem}; expected {expected} (numbers count from {source.index_base})")


def _sharpness(count: int, indices: IntArray, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a read-only array with values at ``indices``, clamped to `INFINITE`, and zero elsewhere."""
    if not len(indices):
        return _zeros(count)
    sharpness = np.zeros(count)
    sharpness[indices] = np.minimum(values, INFINITE)
    return read_only(sharpness)


def _zeros(count: int) -> NDArray[np.float64]:
    """Return read-only zeros. They take no memory, as in most cages nothing is sharp."""
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
    """Return a half-edge between each pair of vertices, in either direction; -1 if there is none."""
    if not len(starts):
        return np.zeros(0, dtype=np.int64)
    n = topology.vertex_count
    half_edges = topology.edge_half_edge
    a, b = topology.face_vertices[half_edges], topology.face_vertices[topology.next[half_edges]]
    keys = np.minimum(a, b).astype(np.int64) * n + np.maximum(a, b)
    # If several edges have the same vertices, the first is used.
    order = np.argsort(keys, kind="stable")
    pair_keys = np.minimum(starts, ends) * n + np.maximum(starts, ends)
    index = np.minimum(np.searchsorted(keys[order], pair_keys), len(keys) - 1)
    candidate = order[index]
    inside = (np.minimum(starts, ends) >= 0) & (np.maximum(starts, ends) < n)
    return np.where(inside & (keys[candidate] == pair_keys), half_edges[candidate], -1)


def _warn_of_ignored(
    is_there: NDArray[np.bool_], where: Callable[[int], str], problem: str, noun: str, source: CageSource
) -> None:
    missing = np.flatnonzero(~is_there)
    if len(missing):
        such = number_of_such(len(missing), noun)
        warn(f"{where(missing[0])}, which {problem}, is ignored ({such}; numbers count from {source.index_base})")


def require_sharpness(values: NDArray[np.float64], where: Callable[[int], str]) -> None:
    """Raise CageError if a sharpness is negative or NaN; ``where`` returns the beginning of the message for a row."""
    for row in np.flatnonzero(~(values >= 0))[:1]:
        raise CageError(
            f"{where(row)} has sharpness {in_digits(values[row])}; expected 0 for smooth, up to {INFINITE:g} for "
            "semi-sharp, or more for infinitely sharp"
        )
