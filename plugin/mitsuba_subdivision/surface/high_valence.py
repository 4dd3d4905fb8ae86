"""Vertices and faces of so high a valence that their weights take too much memory."""

from __future__ import annotations

import numpy as np

from ..cage import ControlCage
from ..evaluation.divided_element import divided_elements
from ..evaluation.polynomial_basis import polynomial_basis
from ..mesh.connectivity import VertexRule
from ..mesh.signature import NEAR_FACES
from ..patches import PatchTable
from ..schemes.scheme import Scheme
from ..schemes.scheme_members import optional_member
from ..tessellation.memory import exceeded_limit

# Bytes for each pair of control points of a one-ring: its subdivision matrix, its eigenbasis, and what makes these.
# Measured at valences of 200 to 1,600 under all schemes, those below of 200 to 800; Doo-Sabin's rules are matrices
# themselves.
PAIR_BYTES = {"face": 65, "vertex": 300}
# The same in all where every face has stencils of its own, and the fan is refined for all of them: at the end of a
# crease, and where edges or the vertex are semi-sharp. Measured: 210 to 470.
OWN_STENCIL_BYTES = 350
# Where the faces do not share the fan's refinement, as by Chaikin's method.
UNSHARED_STENCIL_BYTES = 1200
# Where every face has an eigenbasis of its own: on borders that are semi-sharp, on all of them under schemes without
# `has_local_borders`, and at the end of a crease, where all pieces are needed. Measured: 3,300 to 4,300; more, as the
# time grows faster, to minutes from 500 faces on.
OWN_BASES_BYTES = 6000
# Pieces and blocks of a tip, in regular pieces: three at each level down to single precision around vertices of high
# valence. And how many copies of the polynomials of all pieces there are while a kernel is made. Measured.
PIECES_OF_TIP = 3 * 37
PIECE_COPIES = 2.7
# Eigenbases that need more take minutes.
MOST_BYTES = 8 << 30


def require_moderate_valences(cage: ControlCage, scheme: Scheme, *, needs_bases: bool = False) -> None:
    """Check that the weights around every vertex and every face fit into memory.

    Parameters
    ----------
    cage : ControlCage
    scheme : Scheme
    needs_bases : bool
        Whether an eigenbasis is needed for every face, also where samples need none, at the end of a crease.

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
        is_dart, is_shared = t.vertex_rules == VertexRule.DART, np.zeros(t.vertex_count, dtype=bool)
        if optional_member(scheme, "has_local_borders"):
            is_near = is_border & ~is_dart & ~is_semi_sharp
            face_count[is_near] = np.minimum(face_count[is_near], NEAR_FACES)
            is_shared = ~is_border if needs_bases else is_dart | ~is_border
            if optional_member(scheme, "crease_method") == "chaikin":
                is_shared &= ~is_semi_sharp
        unshared_bytes = OWN_BASES_BYTES * is_border + UNSHARED_STENCIL_BYTES * is_semi_sharp
        own_bytes = np.where(is_shared, OWN_STENCIL_BYTES * (is_border | is_semi_sharp), unshared_bytes)
    at_vertices = (pair + own_bytes) * (width * face_count) ** 2
    # The centre of a polygon becomes a vertex.
    at_faces = pair * (width * t.face_sizes.astype(np.float64)) ** 2
    needed = max(at_vertices.max(initial=0), at_faces.max(initial=0))
    available = exceeded_limit(needed, MOST_BYTES)
    if available is None:
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


def require_memory_for_pieces(cage: ControlCage, patches: PatchTable) -> None:
    """Check that the polynomials of all pieces fit into memory; those of each class are over all of its one-ring.

    Parameters
    ----------
    cage : ControlCage
    patches : PatchTable
        Of this cage.

    Raises
    ------
    MemoryError
        If not; names the vertex in whose fan most of the memory is needed.
    """
    refined = patches.refined
    table = patches if refined is None else refined.table
    elements = divided_elements(table.scheme, [each.signature for each in table.classes])
    counts = np.array([each.regular_count + PIECES_OF_TIP * each.tip_count for each in elements])
    weights = counts * table.control_counts * len(polynomial_basis(table.scheme).powers)
    needed = PIECE_COPIES * weights.sum() * np.float64().itemsize
    available = exceeded_limit(needed, MOST_BYTES)
    if available is None:
        return
    largest = table.classes[int(weights.argmax())]
    corner = largest.corners[:1] if refined is None else refined.corners(largest)[:1]
    t, half_edge = patches.topology, int(patches.half_edges(corner)[0])
    around = t.face_vertices[t.face_offsets[t.face[half_edge]] : t.face_offsets[t.face[half_edge] + 1]]
    vertex = int(around[t.vertex_face_count[around].argmax()])
    where = cage.source.at_vertex(int(cage.cut_mesh.vertex[vertex]))
    raise MemoryError(
        f"{where} has {t.vertex_face_count[vertex]} faces, and pieces of {len(elements)} classes of faces need about "
        f"{needed / 1e9:.3g} GB in a kernel, of which at most {available / 1e9:.3g} GB are used; divide it into "
        "several vertices, or do without exact shading"
    )
