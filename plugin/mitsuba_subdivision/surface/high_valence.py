"""Vertices and faces of so high a valence that their weights take too much memory."""

from __future__ import annotations

import numpy as np

from ..cage import ControlCage
from ..mesh.connectivity import VertexRule
from ..schemes.scheme import Scheme
from ..tessellation.memory import SMALL, available_memory

# Bytes for each pair of control points of a one-ring: its subdivision matrix, its eigenbasis, and what makes these.
# Measured at valences of 200 to 1,600 under all schemes; Doo-Sabin's rules are matrices themselves.
PAIR_BYTES = {"face": 83, "vertex": 290}
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
    at_vertices = pair * (width * t.vertex_face_count.astype(np.float64)) ** 2
    if scheme.element == "face":
        # The faces beside a crease or a boundary all have weights of their own, as each lies elsewhere in the fan.
        is_uneven = t.is_border_vertex | (t.vertex_rules == VertexRule.DART)
        at_vertices[is_uneven] *= t.vertex_face_count[is_uneven]
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
        if is_uneven[vertex]:
            what += " beside a crease or boundary"
    raise MemoryError(
        f"{what}; the limit surface around it needs about {needed / 1e9:.3g} GB, and at most {available / 1e9:.3g} GB "
        f"are used; {advice}"
    )
