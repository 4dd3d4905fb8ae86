"""Creases and corners of a control cage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .connectivity import IntArray, Topology
from .errors import CageError
from .source import CageSource

# From this sharpness on a feature is infinitely sharp, as in OpenSubdiv.
INFINITE = 10.0


@dataclass(frozen=True, eq=False)
class SharpTags:
    """Infinitely sharp edges and vertices of a cage.

    Attributes
    ----------
    is_sharp : (n_h,) bool
        Of half-edges; both of an edge are equal.
    is_corner : (n_v,) bool
    """

    is_sharp: NDArray[np.bool_]
    is_corner: NDArray[np.bool_]


def validated_tags(
    topology: Topology,
    creases: Sequence[tuple[int, int, float]],
    corners: Sequence[tuple[int, float]],
    source: CageSource,
) -> SharpTags:
    """Check creases and corners.

    Raises
    ------
    CageError
        If a crease is no edge of the mesh, a corner no vertex, or a sharpness is negative, not a number, or between 0
        and 10: semi-sharp features are not supported.
    """
    is_sharp = np.zeros(topology.half_edge_count, dtype=bool)
    is_corner = np.zeros(topology.vertex_count, dtype=bool)
    edges = _table(creases, 3, "creases", "(vertex, vertex, sharpness)", source)
    vertices = _table(corners, 2, "corners", "(vertex, sharpness)", source)

    starts, ends = edges[:, :2].astype(np.int64).T
    edge = _edges_between(topology, starts, ends)
    for row in np.flatnonzero(edge < 0)[:1]:
        raise CageError(
            f"{source.name}: crease along {source.edge(starts[row], ends[row])}, which is no edge of a face"
        )
    for row in np.flatnonzero(_is_refused(edges[:, 2]))[:1]:
        raise CageError(_refusal(source, f"crease along {source.edge(starts[row], ends[row])}", edges[row, 2]))
    if len(edge):
        is_sharp[:] = np.isin(topology.edge, edge[edges[:, 2] >= INFINITE])

    vertex = vertices[:, 0].astype(np.int64)
    for row in np.flatnonzero((vertex < 0) | (vertex >= topology.vertex_count))[:1]:
        raise CageError(
            f"{source.name}: corner at {source.vertex(vertex[row])}; expected one of {topology.vertex_count} vertices"
        )
    for row in np.flatnonzero(_is_refused(vertices[:, 1]))[:1]:
        raise CageError(_refusal(source, f"corner at {source.vertex(vertex[row])}", vertices[row, 1]))
    is_corner[vertex[vertices[:, 1] >= INFINITE]] = True
    return SharpTags(is_sharp, is_corner)


def _table(rows, columns: int, name: str, expected: str, source: CageSource) -> NDArray[np.float64]:
    try:
        table = np.array(rows, dtype=np.float64).reshape(len(rows), columns)
    except (TypeError, ValueError) as error:
        raise CageError(f"{source.name}: {name} are not a table ({error}); expected rows {expected}") from error
    return table


def _edges_between(topology: Topology, starts: IntArray, ends: IntArray) -> IntArray:
    """Edge between each pair of vertices, -1 where there is none."""
    if not len(starts):
        return np.empty(0, dtype=np.int64)
    n = topology.vertex_count
    half_edges = topology.edge_half_edge
    a, b = topology.face_vertices[half_edges], topology.face_vertices[topology.next[half_edges]]
    keys = np.minimum(a, b) * n + np.maximum(a, b)
    order = np.argsort(keys)
    wanted = np.minimum(starts, ends) * n + np.maximum(starts, ends)
    place = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
    found = order[place]
    inside = (np.minimum(starts, ends) >= 0) & (np.maximum(starts, ends) < n)
    return np.where(inside & (keys[found] == wanted), topology.edge[half_edges[found]], -1)


def _is_refused(sharpness: NDArray[np.float64]) -> NDArray[np.bool_]:
    return ~((sharpness == 0) | (sharpness >= INFINITE))


def _refusal(source: CageSource, place: str, sharpness: float) -> str:
    return (
        f"{source.name}: {place} has sharpness {sharpness:g}; expected 0, or {INFINITE:g} and more for infinitely "
        "sharp (semi-sharp features are not supported)"
    )
