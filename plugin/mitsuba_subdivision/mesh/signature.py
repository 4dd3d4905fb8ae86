"""Signatures: the shapes of one-rings, on which limit stencils depend.

An element is what has a parameter domain of its own: a face, or under Doo-Sabin a vertex. A half-edge names it: the
half-edge's face, whose parameters (0, 0) are where the half-edge begins; or the vertex where it begins, whose
parameters (0, 0) are in the half-edge's face. The one-ring of a face is all faces that share a vertex with it; that of
a vertex is all faces around it. The limit surface over an element depends on nothing else.
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

# Faces of a fan between two borders that matter to any one of them, see `TaggedFan.near`.
NEAR_FACES = 64

# The half-edges at which the faces of a `TaggedFan` begin: those behind, then those ahead.
FanHalfEdges = tuple[list[int], list[int]]


class TaggedFan(NamedTuple):
    """Faces around a vertex on a border, with its own rule or semi-sharp features, as one of them sees the others."""

    ahead: tuple[int, ...]  # Sizes of the faces from this one on, counter-clockwise up to the border, or all around
    behind: tuple[int, ...]  # Sizes of the faces on its other side, clockwise up to the border, without this one
    rule: VertexRule = VertexRule.AUTOMATIC
    is_closed: bool = False  # Whether the faces go all around
    sharpness: FanSharpness | None = None  # None where nothing is semi-sharp

    @property
    def is_open(self) -> bool:
        """Whether the faces lie between two borders: those on both sides of the crease of a dart lie all around it."""
        return not self.is_closed and self.rule != VertexRule.DART

    def near(self) -> TaggedFan:
        """The fan without the faces that are too far away to matter.

        The vertex of an open fan moves by its two neighbours on the borders, and what happens in one face reaches the
        next ones with each refinement, by a small weight. So a large fan is cut down to a small one around the face,
        whose last neighbours are still those on the borders (`OneRing.cut_fans`).
        """
        if not self.is_open or self.sharpness is not None or fan_face_count(self) <= NEAR_FACES:
            return self
        behind = near_behind(len(self.ahead), len(self.behind))
        return self._replace(ahead=self.ahead[: NEAR_FACES - behind], behind=self.behind[:behind])


def near_behind(ahead: Number, behind: Number) -> Number:
    """How many of `NEAR_FACES` lie behind a face, in the middle of them but for borders: of numbers, or arrays."""
    return np.minimum(behind, NEAR_FACES - np.minimum(ahead, NEAR_FACES // 2))


# The faces around a vertex. Those of a smooth interior vertex are a tuple of their sizes, counter-clockwise from the
# face that sees them.
Fan = tuple[int, ...] | TaggedFan


def fan_is_closed(fan: Fan) -> bool:
    """Whether the faces go all around the vertex."""
    return fan.is_closed if isinstance(fan, TaggedFan) else True


def fan_face_count(fan: Fan) -> int:
    """Number of faces."""
    return len(fan.ahead) + len(fan.behind) if isinstance(fan, TaggedFan) else len(fan)


def fan_turns(fan: Fan) -> range:
    """Numbers of turns about a vertex that lead to the faces of its fan, one for each; positive counter-clockwise."""
    return range(-len(fan.behind), len(fan.ahead)) if isinstance(fan, TaggedFan) else range(len(fan))


def fan_size(fan: Fan, turns: int) -> int:
    """Size of the face that a number of turns leads to."""
    if isinstance(fan, TaggedFan):
        return fan.ahead[turns] if turns >= 0 else fan.behind[-1 - turns]
    return fan[turns]


@dataclass(frozen=True, eq=False)
class Signature:
    """Shape of a one-ring, as the half-edge that names the element sees it.

    Elements of equal signature have the same limit stencils over their one-rings.
    """

    kind: ElementKind
    # At each corner of the element, counter-clockwise, as the element sees it; of a vertex element, the faces around it
    fans: tuple[Fan, ...]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Signature):
            return NotImplemented
        return self.kind == other.kind and self.fans == other.fans

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        # Fans may have very many faces.
        return hash((self.kind, self.fans))

    @property
    def valences(self) -> tuple[int, ...]:
        """Number of faces at each corner."""
        return tuple(fan_face_count(fan) for fan in self.fans)

    @property
    def sharpness(self) -> float:
        """The greatest sharpness of all semi-sharp features; 0 if there are none."""
        tags = [fan.sharpness for fan in self.fans if isinstance(fan, TaggedFan) and fan.sharpness is not None]
        return max((max([tag.vertex, *(row[0] for row in tag.edges + tag.across)]) for tag in tags), default=0.0)

    def near(self) -> Signature:
        """The same without faces that are too far away to matter, see `TaggedFan.near`."""
        return Signature(self.kind, tuple(fan.near() if isinstance(fan, TaggedFan) else fan for fan in self.fans))

    @cached_property
    def is_semi_sharp(self) -> bool:
        """Whether it has semi-sharp features."""
        return any(isinstance(fan, TaggedFan) and fan.sharpness is not None for fan in self.fans)

    @property
    def smoothed(self) -> Signature:
        """The same without semi-sharp features."""
        return self._smoothed if self.is_semi_sharp else self

    @cached_property
    def _smoothed(self) -> Signature:
        return Signature(self.kind, tuple(_fan_with(fan, None) for fan in self.fans))

    def rotated(self, corner: int) -> Signature:
        """Return the signature of the same element, named by a later one of its corners, or of its vertex's faces."""
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
    """Read off the signature of one element."""
    fans = fan_half_edges(topology, half_edge, kind)
    return with_sharpness(smooth_signature(topology, fans, kind), topology, half_edges_around(fans))


def fan_half_edges(topology: Topology, half_edge: int, kind: ElementKind) -> list[FanHalfEdges]:
    """Half-edges of the fan at each corner of the element that a half-edge names."""
    corners = [half_edge]
    if kind == "face":
        while (corner := int(topology.next[corners[-1]])) != half_edge:
            corners.append(corner)
    return [_fan_half_edges(topology, corner) for corner in corners]


def half_edges_around(fans: list[FanHalfEdges]) -> IndexArray:
    """Half-edges of all fans, one fan after the other, each from its most clockwise half-edge on."""
    return np.concatenate([np.array(behind[::-1] + ahead, dtype=np.int32) for behind, ahead in fans])


def _fan_half_edges(topology: Topology, half_edge: int) -> FanHalfEdges:
    def half_edges(current: int, step: Callable[[int], HalfEdges]) -> list[int]:
        found: list[int] = []
        while current >= 0 and not (found and current == half_edge):
            found.append(current)
            current = int(step(current))
        return found

    ahead = half_edges(half_edge, topology.turn)
    is_closed = int(topology.turn(ahead[-1])) >= 0
    return [] if is_closed else half_edges(int(topology.turn_back(half_edge)), topology.turn_back), ahead


def smooth_signature(topology: Topology, fans: list[FanHalfEdges], kind: ElementKind) -> Signature:
    """Signature of an element without its semi-sharp features, given the half-edges of the fans at its corners."""
    return Signature(kind, tuple(_smooth_fan(topology, *fan) for fan in fans))


def _smooth_fan(topology: Topology, behind: list[int], ahead: list[int]) -> Fan:
    """The fan of some half-edges, without semi-sharp features."""

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
    """The same fan with other semi-sharp features."""
    if not isinstance(fan, TaggedFan):
        return fan if sharpness is None else TaggedFan(fan, (), is_closed=True, sharpness=sharpness)
    if sharpness is None and fan.is_closed and fan.rule == VertexRule.AUTOMATIC:
        return fan.ahead
    return TaggedFan(fan.ahead, fan.behind, fan.rule, fan.is_closed, sharpness)


def with_sharpness(
    smooth: Signature,  # Without them
    topology: Topology,
    around: IndexArray,  # (n,) int32: the result of `half_edges_around`
) -> Signature:
    """Signature of an element with its semi-sharp features."""
    semi = topology.semi_sharpness
    if semi is None:
        return smooth
    twins = topology.twin[around]
    there = np.where(twins < 0, 0, semi.edges_refined[twins])
    edges = list(zip(semi.edges[around].tolist(), semi.edges_refined[around].tolist(), there.tolist(), strict=True))
    vertices, fans, begin = topology.face_vertices[around].tolist(), [], 0
    for fan in smooth.fans:
        vertex, end = vertices[begin], begin + fan_face_count(fan)
        across = _across(semi, vertex) if len(semi.across_vertex) else ()
        sharpness = FanSharpness(tuple(edges[begin:end]), float(semi.vertices[vertex]), across)
        is_sharp = sharpness.vertex or across or any(edge != SMOOTH_EDGE for edge in sharpness.edges)
        fans.append(_fan_with(fan, sharpness) if is_sharp else fan)
        begin = end
    found = Signature(smooth.kind, tuple(fans))
    # Caches the result of `smoothed`.
    vars(found)["_smoothed"] = smooth
    return found


def _across(semi: SemiSharpness, vertex: int) -> tuple[tuple[float, float, bool], ...]:
    """Semi-sharp edges across the cut at a vertex, as `FanSharpness` has them."""
    at = semi.across_vertex == vertex
    columns = semi.across_sharpness, semi.across_refined, semi.across_sharpens
    return tuple(sorted(zip(*(values[at].tolist() for values in columns), strict=True)))
