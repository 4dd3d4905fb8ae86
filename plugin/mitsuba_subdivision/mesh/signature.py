"""Signatures: the shapes of one-rings, on which limit stencils depend.

An element is a part of the mesh with its own parameter domain: a face, or under Doo-Sabin a vertex. It is named by a
half-edge, which also determines the corner with parameters (0, 0). A face element is the face of the half-edge, and
(0, 0) is where the half-edge begins. A vertex element is the vertex where the half-edge begins, and (0, 0) is in the
half-edge's face. The one-ring of a face is all faces that share a vertex with it. The one-ring of a vertex is all faces
around it. The limit surface over an element depends on its one-ring only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from .connectivity import IntArray, Topology, VertexRule

ElementKind = Literal["face", "vertex"]
Number = TypeVar("Number", int, IntArray)

# Maximum number of faces of an open fan in a one-ring, see `Fan.near`.
NEAR_FACES = 64


class Fan(NamedTuple):
    """Faces around a vertex, in order from one face, the first, and the semi-sharp features there.

    It has no indices of vertices and edges, so that equal surroundings have equal fans.
    """

    ahead: tuple[int, ...]  # Sizes of the faces from the first on, counter-clockwise up to the border, or all around
    # Sizes of the other faces, clockwise from the first up to the border; None if the faces go all around
    behind: tuple[int, ...] | None = None
    rule: VertexRule = VertexRule.AUTOMATIC
    # (sharpness, refined sharpness of the half at the vertex, refined sharpness of the other half) of the first edge of
    # each face, from the most clockwise face on; empty where nothing is semi-sharp
    edges: tuple[tuple[float, float, float], ...] = ()
    vertex: float = 0.0  # Sharpness of the vertex
    # (sharpness, refined sharpness of the half at the vertex, whether the edge sharpens the vertex) of semi-sharp edges
    # across the cut, in increasing order
    across: tuple[tuple[float, float, bool], ...] = ()

    @property
    def is_closed(self) -> bool:
        """Whether the faces go all around the vertex."""
        return self.behind is None

    @property
    def is_open(self) -> bool:
        """Whether the faces lie between two borders. A dart is not open: faces on both sides of its crease interact."""
        return not self.is_closed and self.rule != VertexRule.DART

    @property
    def is_inside(self) -> bool:
        """Whether the vertex is smooth and inside the mesh."""
        return self.is_closed and self.rule == VertexRule.AUTOMATIC and not self.is_semi_sharp

    @property
    def is_semi_sharp(self) -> bool:
        return bool(self.edges)

    @property
    def face_count(self) -> int:
        return len(self.ahead) + len(self.behind or ())

    @property
    def turns(self) -> range:
        """Number of turns about the vertex from the first face to each face; positive counter-clockwise."""
        return range(-len(self.behind or ()), len(self.ahead))

    def size(self, turns: int) -> int:
        """Return the size of the face at a number of turns from the first face."""
        return self.ahead[turns] if turns >= 0 or self.behind is None else self.behind[-1 - turns]

    def near(self) -> Fan:
        """Return the fan without faces whose influence on the first face is negligible.

        The vertex of an open fan depends on its two border neighbours only. A face influences only its neighbours at
        each refinement, with a small weight. So a large fan is reduced to the `NEAR_FACES` around the first face; its
        outermost neighbours remain those on the borders (`OneRing.cut_fans`).
        """
        if not self.is_open or self.behind is None or self.is_semi_sharp or self.face_count <= NEAR_FACES:
            return self
        behind = near_behind(len(self.ahead), len(self.behind))
        return self._replace(ahead=self.ahead[: NEAR_FACES - behind], behind=self.behind[:behind])

    def smoothed(self) -> Fan:
        """Return the fan without semi-sharp features."""
        return Fan(self.ahead, self.behind, self.rule)


def near_behind(ahead: Number, behind: Number) -> Number:
    """Return how many of `NEAR_FACES` lie behind the first face, which is in their middle unless a border is near."""
    return np.minimum(behind, NEAR_FACES - np.minimum(ahead, NEAR_FACES // 2))


@dataclass(frozen=True)
class Signature:
    """Shape of a one-ring, in the order that the half-edge of the element determines.

    Elements with equal signatures have the same limit stencils over their one-rings.
    """

    kind: ElementKind
    # For a face, the fans at its corners, counter-clockwise, each with the element as the first face. For a vertex, its
    # one fan.
    fans: tuple[Fan, ...]

    @property
    def valences(self) -> tuple[int, ...]:
        """Number of faces at each corner."""
        return tuple(fan.face_count for fan in self.fans)

    @property
    def sharpness(self) -> float:
        """Largest sharpness of all semi-sharp features; 0 if there are none."""
        return max(max(fan.vertex, *(row[0] for row in (*fan.edges, *fan.across)), 0.0) for fan in self.fans)

    @cached_property
    def is_semi_sharp(self) -> bool:
        """Whether there are semi-sharp features."""
        return any(fan.edges for fan in self.fans)

    @cached_property
    def smoothed(self) -> Signature:
        """The signature without semi-sharp features."""
        return Signature(self.kind, tuple(fan.smoothed() for fan in self.fans)) if self.is_semi_sharp else self

    def near(self) -> Signature:
        """Return the signature without faces whose influence is negligible, see `Fan.near`."""
        return Signature(self.kind, tuple(fan.near() for fan in self.fans))

    def rotated(self, corner: int) -> Signature:
        """Return the signature of the same element, named by a later corner, or face of its vertex."""
        if self.kind == "face":
            return Signature("face", self.fans[corner:] + self.fans[:corner])
        fan = self.fans[0]
        if not fan.is_closed:
            raise TypeError("a vertex on a border; expected one amid faces, as another has a first and a last face")
        ahead = fan.ahead[corner:] + fan.ahead[:corner]
        return Signature("vertex", (fan._replace(ahead=ahead, edges=fan.edges[corner:] + fan.edges[:corner]),))


def signature_at(topology: Topology, half_edge: int, kind: ElementKind) -> Signature:
    """Return the signature of one element."""
    corners = [half_edge]
    if kind == "face":
        while (corner := int(topology.next[corners[-1]])) != half_edge:
            corners.append(corner)
    return Signature(kind, tuple(_fan_at(topology, corner) for corner in corners))


def _fan_at(topology: Topology, half_edge: int) -> Fan:
    """Return the fan around the vertex at which a half-edge begins, from the half-edge's face on."""
    t, semi = topology, topology.semi_sharpness
    ahead, behind = [half_edge], list[int]()
    while (current := int(t.turn[ahead[-1]])) not in (half_edge, -1):
        ahead.append(current)
    is_closed = current >= 0
    if not is_closed:
        current = half_edge
        while (current := int(t.turn_back[current])) >= 0:
            behind.append(current)
    # From the most clockwise half-edge on.
    around, vertex = behind[::-1] + ahead, int(t.face_vertices[half_edge])
    sizes = t.face_sizes[t.face[around]].tolist()
    fan = Fan(
        tuple(sizes[len(behind) :]),
        None if is_closed else tuple(sizes[: len(behind)][::-1]),
        VertexRule(int(t.vertex_rules[vertex])),
    )
    if semi is None or not t.is_semi_sharp_vertex[vertex]:
        return fan
    across = []
    if len(semi.across_vertex):
        here = semi.across_vertex == vertex
        columns = semi.across_sharpness[here], semi.across_refined[here], semi.across_sharpens[here]
        across = sorted(zip(*(column.tolist() for column in columns), strict=True))
    edges = tuple(map(tuple, t.edge_sharpness[around].tolist()))
    return fan._replace(edges=edges, vertex=float(semi.vertices[vertex]), across=tuple(across))
