"""Limit stencils of a vertex: its limit point and tangents as weights over its one-ring."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..mesh.connectivity import Topology
from ..mesh.one_ring import one_ring
from ..schemes import SchemeError, scheme_named
from ..schemes.domain import FloatArray
from .eigenbasis import eigenbasis
from .patch_pieces import isolated_signature
from .refined_rings import refined_children


class LimitStencil(NamedTuple):
    """Weights over the one-ring of an extraordinary point amid regular faces and vertices.

    For a vertex, over the centre, the edge ring and the face ring, counter-clockwise; the face ring's vertex i lies
    between the edge ring's i and i + 1, and it is empty where faces are triangles. For a face of a vertex-based scheme,
    over its vertices, counter-clockwise.
    """

    position: FloatArray  # (m,) float64: sums to one
    # (2, m) float64: sum to zero. Weights on the edge ring, or the face's vertices, are ``cos(2 pi i / n)`` and
    # ``sin(2 pi i / n)``; the cross product of the two tangents points outward.
    tangents: FloatArray


def limit_stencil(scheme: str, valence: int) -> LimitStencil:
    """Weights over a one-ring that make its limit point and two tangents: left eigenvectors of its subdivision matrix.

    Parameters
    ----------
    scheme : str
    valence : int
        Of a vertex amid regular faces (true after one refinement of any cage); for Doo-Sabin, corners of a face amid
        regular vertices. At least 3.

    Returns
    -------
    LimitStencil

    Raises
    ------
    SchemeError
        If the scheme is unknown, or the valence no integer or below 3.
    """
    rules = scheme_named(scheme)
    if not isinstance(valence, (int, np.integer)):
        raise SchemeError(f"limit stencil of valence {valence!r}: expected an integer")
    if valence < 3:
        raise SchemeError(f"limit stencil of valence {valence}: expected 3 or more")
    signature = isolated_signature(rules, valence)
    topology = one_ring(signature).topology
    if rules.element == "face":
        slots, ring = _vertex_ring(topology, valence)
    else:
        slots = ring = topology.face_vertices[:valence].tolist()
    basis = eigenbasis(refined_children(rules, signature)[0][2])

    angles = 2 * np.pi * np.arange(valence) / valence
    target = np.stack([np.cos(angles), np.sin(angles)])
    plane = basis.inverse[1:3]
    # The eigenvectors span the plane of the first Fourier mode; take the pair that is cosine and sine on the ring.
    combination = target @ plane[:, ring].T @ np.linalg.inv(plane[:, ring] @ plane[:, ring].T)
    return LimitStencil(basis.inverse[0, slots], (combination @ plane)[:, slots])


def _vertex_ring(topology: Topology, valence: int) -> tuple[list[int], list[int]]:
    """Vertices of the stencil at vertex 0 of a one-ring, and those of them that are its edge ring."""
    half_edge, edge_ring, face_ring = 0, [], []
    for _ in range(valence):
        ahead = topology.next[half_edge]
        edge_ring.append(int(topology.face_vertices[ahead]))
        if topology.face_sizes[0] > 3:
            face_ring.append(int(topology.face_vertices[topology.next[ahead]]))
        half_edge = int(topology.turn(half_edge))
    return [0, *edge_ring, *face_ring], edge_ring
