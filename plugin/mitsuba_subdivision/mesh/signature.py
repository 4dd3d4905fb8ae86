"""The shape of an element's one-ring: what its limit stencils depend on.

An element is named by one half-edge: the face, or the vertex, that it starts from, with parameter (0, 0) at its
beginning (for a vertex element, in its face). The one-ring of a face is every face that shares a vertex with it; the
one-ring of a vertex is every face around it. The limit surface over an element depends on nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Literal

import numpy as np

from .connectivity import IndexArray, Topology, VertexRule
from .sharpness import FanSharpness, SemiSharpness

ElementKind = Literal["face", "vertex"]


@dataclass(frozen=True)
class TaggedFan:
    """Faces around a vertex on a border, with a rule of its own or semi-sharp features, seen from one of them.

    Parameters
    ----------
    ahead : tuple of int
        Sizes of the faces from this one counter-clockwise to the border, or all around.
    behind : tuple of int
        Sizes of those clockwise from it to the border, without this one.
    rule : VertexRule
    is_closed : bool
        Whether the faces go all around.
    sharpness : FanSharpness or None
        None where nothing is semi-sharp.
    """

    ahead: tuple[int, ...]
    behind: tuple[int, ...]
    rule: VertexRule = VertexRule.AUTOMATIC
    is_closed: bool = False
    sharpness: FanSharpness | None = None

    def __len__(self) -> int:
        return len(self.ahead) + len(self.behind)


# Faces around a vertex: of a smooth interior one, their sizes counter-clockwise from the face it is seen from.
Fan = tuple[int, ...] | TaggedFan


def fan_is_closed(fan: Fan) -> bool:
    """Whether the faces go all around the vertex."""
    return fan.is_closed if isinstance(fan, TaggedFan) else True


def fan_turns(fan: Fan) -> range:
    """Turns about a vertex, counter-clockwise positive, that lead to each face of its fan once."""
    return range(-len(fan.behind), len(fan.ahead)) if isinstance(fan, TaggedFan) else range(len(fan))


def fan_size(fan: Fan, turns: int) -> int:
    """Size of the face that some turns lead to."""
    if isinstance(fan, TaggedFan):
        return fan.ahead[turns] if turns >= 0 else fan.behind[-1 - turns]
    return fan[turns]


@dataclass(frozen=True)
class Signature:
    """Shape of a one-ring, seen from the half-edge that names the element.

    Two elements of equal signature have the same limit stencils over their one-rings.

    Parameters
    ----------
    kind : "face" or "vertex"
    fans : tuple of Fan
        Of each corner of the element, counter-clockwise, seen from the element. A vertex element has the one fan around
        it.
    """

    kind: ElementKind
    fans: tuple[Fan, ...]

    @property
    def valences(self) -> tuple[int, ...]:
        """Number of faces at each corner."""
        return tuple(len(fan) for fan in self.fans)

    @property
    def sharpness(self) -> float:
        """The greatest sharpness of its semi-sharp features; 0 if there are none."""
        return max((max([s.vertex, *(row[0] for row in s.edges + s.beyond)]) for s in self._sharpness), default=0.0)

    @cached_property
    def steady_refinements(self) -> int:
        """Number of refinements that lower all sharpness by one and do nothing else to the one-ring's rules.

        So long all that is sharp stays sharp, however sharp it is: refined parts are as those of the same signature
        `sharpened` by as much less, but for their own sharpness.
        """
        left = min((sharp.least_left for sharp in self._sharpness), default=math.inf)
        # What is left by each of them is more than one, so that the next leaves something as well.
        return max(math.ceil(left) - 2, 0) if left < math.inf else 0

    def sharpened(self, by: int) -> Signature:
        """The same with more sharpness, or less, of all that is sharp; exact, as sharpness is below 10."""
        if by == 0:
            return self
        fans = (
            _fan_with(fan, fan.sharpness.sharpened(by))
            if isinstance(fan, TaggedFan) and fan.sharpness is not None
            else fan
            for fan in self.fans
        )
        return Signature(self.kind, tuple(fans))

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

    @property
    def _sharpness(self) -> list[FanSharpness]:
        return [fan.sharpness for fan in self.fans if isinstance(fan, TaggedFan) and fan.sharpness is not None]

    def rotated(self, corner: int) -> Signature:
        """Return the signature of the same element named by a later corner (or, for a vertex, a later face)."""
        if self.kind == "face":
            return Signature("face", self.fans[corner:] + self.fans[:corner])
        fan = self.fans[0]
        return Signature("vertex", (fan[corner:] + fan[:corner],))


def signature_at(topology: Topology, half_edge: int, kind: ElementKind) -> Signature:
    """Read off the signature of one element."""
    fans = fan_half_edges(topology, half_edge, kind)
    smooth = smooth_signature(topology, fans, kind)
    semi = topology.semi_sharpness
    if semi is None:
        return smooth
    return with_sharpness(smooth, FanSharpnessRows(topology, half_edges_around(fans)[None], semi), 0)


# Half-edges at which the faces around a vertex begin: those clockwise from the one it is seen from, up to the border,
# and those counter-clockwise, with this one.
FanHalfEdges = tuple[list[int], list[int]]


def fan_half_edges(topology: Topology, half_edge: int, kind: ElementKind) -> list[FanHalfEdges]:
    """Half-edges of the fan at each corner of an element."""
    corners = [half_edge]
    if kind == "face":
        while (following := int(topology.following(corners[-1]))) != half_edge:
            corners.append(following)
    return [_fan_half_edges(topology, corner) for corner in corners]


def half_edges_around(fans: list[FanHalfEdges]) -> IndexArray:
    """Half-edges of all fans, one after the other, clockwise ones first."""
    return np.array([half_edge for behind, ahead in fans for half_edge in behind[::-1] + ahead], dtype=np.int32)


def _fan_half_edges(topology: Topology, half_edge: int) -> FanHalfEdges:
    def half_edges(current: int, turn) -> list[int]:
        found: list[int] = []
        while current >= 0 and not (found and current == half_edge):
            found.append(current)
            current = int(turn(current))
        return found

    ahead = half_edges(half_edge, topology.turn)
    closed = int(topology.turn(ahead[-1])) >= 0
    return [] if closed else half_edges(int(topology.turn_back(half_edge)), topology.turn_back), ahead


def smooth_signature(topology: Topology, fans: list[FanHalfEdges], kind: ElementKind) -> Signature:
    """Signature of the element that has fans of these half-edges, without semi-sharp features."""
    return Signature(kind, tuple(_smooth_fan(topology, *fan) for fan in fans))


def _smooth_fan(topology: Topology, behind: list[int], ahead: list[int]) -> Fan:
    """The fan of some half-edges, without semi-sharp features."""
    sizes = (
        tuple(topology.face_sizes[topology.face_of(np.array(h, dtype=np.int32))].tolist()) for h in (ahead, behind)
    )
    rule = VertexRule(int(topology.vertex_rules[topology.face_vertices[ahead[0]]]))
    closed = int(topology.turn(ahead[-1])) >= 0
    return _fan_with(TaggedFan(*sizes, rule, closed), None)


def _fan_with(fan: Fan, sharpness: FanSharpness | None) -> Fan:
    """The same fan with other semi-sharp features."""
    if not isinstance(fan, TaggedFan):
        return fan if sharpness is None else TaggedFan(fan, (), is_closed=True, sharpness=sharpness)
    if sharpness is None and fan.is_closed and fan.rule == VertexRule.AUTOMATIC:
        return fan.ahead
    return TaggedFan(fan.ahead, fan.behind, fan.rule, fan.is_closed, sharpness)


class FanSharpnessRows:
    """Semi-sharp features at the corners of elements of the same signature, but for these features.

    Parameters
    ----------
    topology : Topology
    around : (e, n) int
        Half-edges of the fans at all corners, one after the other, clockwise ones first.
    semi : SemiSharpness
        Of this mesh, in place of its own.
    """

    def __init__(self, topology: Topology, around: IndexArray, semi: SemiSharpness) -> None:
        twins = topology.twin[around]
        there = np.where(twins < 0, 0, semi.edges_left[twins])
        self._edges = semi.edges[around], semi.edges_left[around], there
        self._vertices = topology.face_vertices[around]
        self._semi = semi

    def at(self, element: int, smooth: Signature) -> list[FanSharpness | None]:
        """Features at each corner of an element; ``smooth`` is its signature without them."""
        semi = self._semi
        rows = zip(*(values[element].tolist() for values in self._edges), strict=True)
        vertices = self._vertices[element]
        found: list[FanSharpness | None] = []
        begin = 0
        for fan in smooth.fans:
            vertex = vertices[begin]
            begin += len(fan)
            edges, sharpness = tuple(islice(rows, len(fan))), float(semi.vertices[vertex])
            beyond = _beyond(semi, vertex) if len(semi.beyond.vertex) else ()
            is_sharp = sharpness or beyond or any(map(any, edges))
            found.append(FanSharpness(edges, sharpness, beyond) if is_sharp else None)
        return found


def with_sharpness(smooth: Signature, rows: FanSharpnessRows, element: int) -> Signature:
    """Signature of one of some elements; ``smooth`` is without semi-sharp features."""
    fans = zip(smooth.fans, rows.at(element, smooth), strict=True)
    return Signature(
        smooth.kind, tuple(fan if sharpness is None else _fan_with(fan, sharpness) for fan, sharpness in fans)
    )


def _beyond(semi: SemiSharpness, vertex: int) -> tuple[tuple[float, float, bool], ...]:
    """Semi-sharp edges beyond the cut at a vertex, as `FanSharpness` has them."""
    at = semi.beyond.vertex == vertex
    columns = semi.beyond.sharpness, semi.beyond_left, semi.beyond.sharpens
    return tuple(sorted(zip(*(values[at].tolist() for values in columns), strict=True)))
