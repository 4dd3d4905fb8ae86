"""Outlines of meshes: of the two triangles at an edge of an outline, the one that is seen.

Projective integrators take the radiance at an outline from an interaction with the triangle of a sample, and Mitsuba
samples either triangle. Exact shading needs the one that is seen: at the other one, rays come from inside the surface.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..kernels.array_types import Index, Mask, Vector3


def seen_edges(
    mesh: mi.Mesh,
    edges: Index,  # Half-edges of an outline
    d: Vector3,  # Directions of rays to any points of their triangles
    active: Mask = True,
) -> Index:
    """Half-edges at the same edges, in the triangles that the rays meet first."""
    opposite = mesh.opposite_dedge(edges, active)
    active = active & (opposite < 3 * mesh.face_count())
    a, b, c = (mesh.vertex_position(vertex, active) for vertex in mesh.face_indices(edges // 3, active))
    others = [mesh.vertex_position(vertex, active) for vertex in mesh.face_indices(opposite // 3, active)]
    n = dr.cross(b - a, c - a)
    # A triangle is hidden if the other one is on the side of its plane that the rays come from.
    side = dr.dot(n, sum(corner - a for corner in others))
    return dr.select(active & (dr.dot(n, d) * side < 0), opposite, edges)


def turn_to_seen(mesh: mi.Mesh, ss: mi.SilhouetteSample3f, active: Mask) -> None:
    """Move a sample of an outline to the triangle that is seen, in place."""
    edges, u, v = 3 * ss.prim_index + ss.projection_index, *ss.uv
    along = dr.select(ss.projection_index == 0, u, dr.select(ss.projection_index == 1, v, 1 - v))
    seen = seen_edges(mesh, edges, ss.d, active & (ss.pdf > 0))
    along = dr.select(seen == edges, along, 1 - along)
    p: Any = ss.p  # Mitsuba's stub lacks the subtraction.
    turned = mesh.sample_precomputed_silhouette(p - ss.d, seen, along, active)
    ss.prim_index, ss.uv, ss.projection_index = turned.prim_index, turned.uv, seen % 3
