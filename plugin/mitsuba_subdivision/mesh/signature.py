"""Signatures: the shapes of one-rings, on which limit stencils depend.

An element is a part of the mesh with its own parameter domain: a face, or under Doo-Sabin a vertex. It is named by a
half-edge, which also determines the corner with parameters (0, 0). A face element is the face of the half-edge, and
(0, 0) is where the half-edge begins. A vertex element is the vertex where the half-edge begins, and (0, 0) is in the
half-edge's face. The one-ring of a face is all faces that share a vertex with it. The one-ring of a vertex is all faces
around it. The limit surface over an element depends on its one-ring only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from .connectivity import HalfEdges, IndexArray, IntArray, Topology, VertexRule
from .sharpness import SMOOTH_EDGE, FanSharpness, SemiSharpness

ElementKind = Literal["face", "vertex"]
Number = TypeVar("Number", int, IntArray)

# Maximum number of faces of an open fan in a one-ring, see `TaggedFan.near`.
NEAR_FACES = 64

# The half-edges at which the faces of a `TaggedFan` begin: `behind`, then `ahead`.
FanHalfEdges = tuple[list[int], list[int]]


class TaggedFan(NamedTuple):
    """Faces around a vertex that is on a border, semi-sharp or has a rule, in order from one face, the first."""

    ahead: tuple[int, ...]  # Sizes of the faces from the first on, counter-clockwise up to the border, or all around
    behind: tuple[int, ...]  # Sizes of the other faces, clockwise from the first up to the border
    rule: VertexRule = VertexRule.AUTOMATIC
    is_closed: bool = False  # Whether the faces go all around
    sharpness: FanSharpness | None = None  # None where nothing is semi-sharp

    @property
    def is_open(self) -> bool:
        """Whether the faces lie between two borders. A dart is not open: faces on both sides of its crease interact."""
        return not self.is_closed and self.rule != VertexRule.DART

    def near(self) -> TaggedFan:
        """Return the fan without faces whose influence on the first face is negligible.

        The vertex of an open fan depends on its two border neighbours only. A face influences only its neighbours at
        each refinement, with a small weight. So a large fan is reduced to the `NEAR_FACES` around the first face; its
        outermost neighbours remain those on the borders (`OneRing.cut_fans`).
        """
        if not self.is_open or self.sharpness is not None or fan_face_count(self) <= NEAR_FACES:
            return self
        behind = near_behind(len(self.ahead), len(self.behind))
        return self._replace(ahead=self.ahead[: NEAR_FACES - behind], behind=self.behind[:behind])


def near_behind(ahead: Number, behind: Number) -> Number:
    """Return how many of `NEAR_FACES` lie behind the first face, which is in their middle unless a border is near."""
    return np.minimum(behind, NEAR_FACES - np.minimum(ahead, NEAR_FACES // 2))


# The faces around a vertex. For a smooth inner vertex, the tuple of their sizes, counter-clockwise from the first face.
Fan = tuple[int, ...] | TaggedFan


def fan_is_closed(fan: Fan) -> bool:
    """Return whether the faces go all around the vertex."""
    return fan.is_closed if isinstance(fan, TaggedFan) else True


def fan_face_count(fan: Fan) -> int:
    """Return the number of faces."""
    return len(fan.ahead) + len(fan.behind) if isinstance(fan, TaggedFan) else len(fan)


def fan_turns(fan: Fan) -> range:
    """Return the number of turns about the vertex from the first face to each face; positive counter-clockwise."""
    return range(-len(fan.behind), len(fan.ahead)) if isinstance(fan, TaggedFan) else range(len(fan))


def fan_size(fan: Fan, turns: int) -> int:
    """Return the size of the face at a number of turns from the first face."""
    if isinstance(fan, TaggedFan):
        return fan.ahead[turns] if turns >= 0 else fan.behind[-1 - turns]
    return fan[turns]


@dataclass(frozen=True, eq=False)
class Signature:
    """Shape of a one-ring, in the order that the half-edge of the element determines.

    Elements with equal signatures have the same limit stencils over their one-rings.
    """

    kind: ElementKind
    # For a face, the fans at its corners, counter-clockwise, each with the element as the first face. For a vertex, its
    # one fan.
    fans: tuple[Fan, ...]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Signature):
            return NotImplemented
        return self.kind == other.kind and self.fans == other.fans

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        # Cached, as fans may have very many faces.
        return hash((self.kind, self.fans))

    @property
    def valences(self) -> tuple[int, ...]:
        """Number of faces at each corner."""
        return tuple(fan_face_count(fan) for fan in self.fans)

    @property
    def sharpness(self) -> float:
        """Largest sharpness of all semi-sharp features; 0 if there are none."""
        tags = [fan.sharpness for fan in self.fans if isinstance(fan, TaggedFan) and fan.sharpness is not None]
        return max((max([tag.vertex, *(row[0] for row in tag.edges + tag.across)]) for tag in tags), default=0.0)

    def near(self) -> Signature:
        """Return the signature without faces whose influence is negligible, see `TaggedFan.near`."""
        return Signature(self.kind, tuple(fan.near() if isinstance(fan, TaggedFan) else fan for fan in self.fans))

    @cached_property
    def is_semi_sharp(self) -> bool:
        """Whether there are semi-sharp features."""
        return any(isinstance(fan, TaggedFan) and fan.sharpness is not None for fan in self.fans)

    @property
    def smoothed(self) -> Signature:
        """The signature without semi-sharp features."""
        return self._smoothed if self.is_semi_sharp else self

    @cached_property
    def _smoothed(self) -> Signature:
        return Signature(self.kind, tuple(_fan_with(fan, None) for fan in self.fans))

    def rotated(self, corner: int) -> Signature:
        """Return the signature of the same element, named by a later corner, or face of its vertex."""
        if self.kind == "face":
            return Signature("face", self.fans[corner:] + self.fans[:corner])
        fan = self.fans[0]
        if not isinstance(fan, TaggedFan):
            return Signature("vertex", (fan[corner:] + fan[:corner],))
        if not fan.is_closed:
            raise TypeError("a vertex on a border; expected one amid faces, as another has a first and a last face")
        sharpness = fan.sharpness
        if sharpness is not None:
            sharpness = sharpness._replace(edges=sharpness.edges[corner:] + sharpness.edges[:corner])
        return Signature("vertex", (fan._replace(ahead=fan.ahead[corner:] + fan.ahead[:corner], sharpness=sharpness),))


def signature_at(topology: Topology, half_edge: int, kind: ElementKind) -> Signature:
    """Return the signature of one element."""
    fans = fan_half_edges(topology, half_edge, kind)
    return with_sharpness(smooth_signature(topology, fans, kind), topology, half_edges_around(fans))


def fan_half_edges(topology: Topology, half_edge: int, kind: ElementKind) -> list[FanHalfEdges]:
    """Return the half-edges of the fan at each corner of the element named by ``half_edge``."""
    corners = [half_edge]
    if kind == "face":
        while (corner := int(topology.next[corners[-1]])) != half_edge:
            corners.append(corner)
    return [_fan_half_edges(topology, corner) for corner in corners]


def half_edges_around(fans: list[FanHalfEdges]) -> IndexArray:
    """Return the half-edges of all fans, fan by fan, each from its most clockwise half-edge on."""
    return np.concatenate([np.array(behind[::-1] + ahead, dtype=np.int32) for behind, ahead in fans])


def _fan_half_edges(topology: Topology, half_edge: int) -> FanHalfEdges:
    def half_edges(current: int, step: Callable[[int], HalfEdges]) -> list[int]:
        walked: list[int] = []
        while current >= 0 and not (walked and current == half_edge):
            walked.append(current)
            current = int(step(current))
        return walked

    ahead = half_edges(half_edge, topology.turn)
    is_closed = int(topology.turn(ahead[-1])) >= 0
    return [] if is_closed else half_edges(int(topology.turn_back(half_edge)), topology.turn_back), ahead


def smooth_signature(topology: Topology, fans: list[FanHalfEdges], kind: ElementKind) -> Signature:
    """Return the signature without semi-sharp features, given the half-edges of the fans at the element's corners."""
    return Signature(kind, tuple(_smooth_fan(topology, *fan) for fan in fans))


def _smooth_fan(topology: Topology, behind: list[int], ahead: list[int]) -> Fan:
    """Return the fan of these half-edges, without semi-sharp features."""

    def sizes(half_edges: list[int]) -> tuple[int, ...]:
        if topology.common_size:
            return (topology.common_size,) * len(half_edges)
        return tuple(topology.face_sizes[topology.face[np.array(half_edges, dtype=np.int32)]].tolist())

    rule = VertexRule(int(topology.vertex_rules[topology.face_vertices[ahead[0]]]))
    is_closed = int(topology.turn(ahead[-1])) >= 0
    if is_closed and rule == VertexRule.AUTOMATIC:
        return sizes(ahead)
    return TaggedFan(sizes(ahead), sizes(behind), rule, is_closed)


def _fan_with(fan: Fan, sharpness: FanSharpness | None) -> Fan:
    """Return the fan with its semi-sharp features replaced."""
    if not isinstance(fan, TaggedFan):
        return fan if sharpness is None else TaggedFan(fan, (), is_closed=True, sharpness=sharpness)
    if sharpness is None and fan.is_closed and fan.rule == VertexRule.AUTOMATIC:
        return fan.ahead
    return TaggedFan(fan.ahead, fan.behind, fan.rule, fan.is_closed, sharpness)


def with_sharpness(
    smooth: Signature,  # Signature without semi-sharp features
    topology: Topology,
    around: IndexArray,  # (n,) int32: the result of `half_edges_around`
) -> Signature:
    """Return the signature of an element with its semi-sharp features."""
    semi = topology.semi_sharpness
    if semi is None:
        return smooth
    twins = topology.twin[around]
    far_half = np.where(twins < 0, 0, semi.edges_refined[twins])
    edges = list(zip(semi.edges[around].tolist(), semi.edges_refined[around].tolist(), far_half.tolist(), strict=True))
    vertices, fans, begin = topology.face_vertices[around].tolist(), [], 0
    for fan in smooth.fans:
        vertex, end = vertices[begin], begin + fan_face_count(fan)
        across = _across(semi, vertex) if len(semi.across_vertex) else ()
        sharpness = FanSharpness(tuple(edges[begin:end]), float(semi.vertices[vertex]), across)
        is_sharp = sharpness.vertex or across or any(edge != SMOOTH_EDGE for edge in sharpness.edges)
        fans.append(_fan_with(fan, sharpness) if is_sharp else fan)
        begin = end
    signature = Signature(smooth.kind, tuple(fans))
    # Cache the result of `smoothed`.
    vars(signature)["_smoothed"] = smooth
    return signature


def _across(semi: SemiSharpness, vertex: int) -> tuple[tuple[float, float, bool], ...]:
    """Return `FanSharpness.across` of a vertex."""
    is_at_vertex = semi.across_vertex == vertex
    columns = semi.across_sharpness, semi.across_refined, semi.across_sharpens
    return tuple(sorted(zip(*(values[is_at_vertex].tolist() for values in columns), strict=True)))
