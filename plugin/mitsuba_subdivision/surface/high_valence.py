"""Vertices and faces of so high a valence that their weights take too much memory."""

from __future__ import annotations

import numpy as np

from ..cage import ControlCage
from ..mesh.connectivity import VertexRule
from ..mesh.signature import NEAR_FACES
from ..schemes.scheme import Scheme
from ..schemes.scheme_members import optional_member
from ..tessellation.memory import SMALL, available_memory

# Bytes for each pair of control points of a one-ring: its subdivision matrix, its eigenbasis, and what makes these.
# Measured at valences of 200 to 1,600 under all schemes, those below of 200 to 800; Doo-Sabin's rules are matrices
# themselves.
PAIR_BYTES = {"face": 65, "vertex": 300}
# The same in all where every face has an eigenbasis of its own: at the end of a crease, and on borders under schemes
# without `has_local_borders`. Measured: 3,300 to 4,300; more, as the time grows faster, to minutes from 500 faces on.
OWN_BASES_BYTES = 6000
# The same in all where edges or the vertex are semi-sharp, so that every face has stencils of its own.
OWN_STENCIL_BYTES = 1500
# Eigenbases that need more take minutes.
MOST_BYTES = 8 << 30


def require_moderate_valences(cage: ControlCage, scheme: Scheme) -> None:
    """Check that the weights around every vertex and every face fit into memory.

    Parameters
    ----------
    cage : ControlCage
    scheme : Scheme

    Raises
    ------
    MemoryError
        If not; names the vertex or the face.
    """
    t, pair = cage.cut_mesh.topology, PAIR_BYTES[scheme.element]
    # Control points around a vertex, for each of its faces.
    width = scheme.regular_face_size - 2 if scheme.element == "face" else 1
    face_count, own_bytes = t.vertex_face_count.astype(np.float64), np.zeros(t.vertex_count)
    if scheme.element == "face":
        is_border, is_semi_sharp = t.is_border_vertex, t.is_semi_sharp_vertex
        if optional_member(scheme, "has_local_borders"):
            is_near = is_border & (t.vertex_rules != VertexRule.DART) & ~is_semi_sharp
            face_count[is_near] = np.minimum(face_count[is_near], NEAR_FACES)
        own_bytes = OWN_BASES_BYTES * is_border + OWN_STENCIL_BYTES * is_semi_sharp
    at_vertices = (pair + own_bytes) * (width * face_count) ** 2
    # The centre of a polygon becomes a vertex.
    at_faces = pair * (width * t.face_sizes.astype(np.float64)) ** 2
    needed = max(at_vertices.max(initial=0), at_faces.max(initial=0))
    if needed <= SMALL:
        return
    available = min(MOST_BYTES, available_memory() or MOST_BYTES)
    if needed <= available:
        return
    if needed == at_faces.max(initial=0):
        face = int(at_faces.argmax())
        what, advice = f"{cage.source.at_face(face)} has {t.face_sizes[face]} corners", "divide it into smaller faces"
    else:
        vertex = int(at_vertices.argmax())
        count = t.vertex_face_count[vertex]
        where = cage.source.at_vertex(int(cage.cut_mesh.vertex[vertex]))
        what, advice = f"{where} has {count} faces", "divide it into several vertices"
        if t.is_border_vertex[vertex]:
            what += (
                " at the end of a crease" if t.vertex_rules[vertex] == VertexRule.DART else " on a crease or boundary"
            )
        if t.is_semi_sharp_vertex[vertex]:
            what += " and something semi-sharp"
    raise MemoryError(
        f"{what}; the limit surface around it needs about {needed / 1e9:.3g} GB, and at most {available / 1e9:.3g} GB "
        f"are used; {advice}"
    )
