"""The shape of an element's one-ring: what its limit stencils depend on.

An element is named by one half-edge: the face, or the vertex, that it starts from, with parameter (0, 0) at its
beginning (for a vertex element, in its face). The one-ring of a face is every face that shares a vertex with it; the
one-ring of a vertex is every face around it. The limit surface over an element depends on nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from .connectivity import Topology, VertexRule

ElementKind = Literal["face", "vertex"]


@dataclass(frozen=True)
class FanSharpness:
    """Semi-sharp features at a vertex, as `SemiSharpness` has them.

    Parameters
    ----------
    edges : tuple of (sharpness, after, after at the other end)
        Of the edges at which the faces of the fan begin, clockwise ones first.
    vertex : float
    beyond : tuple of (sharpness, after, whether it acts)
        Of edges on other sides of a crease, in increasing order.
    """

    edges: tuple[tuple[float, float, float], ...]
    vertex: float
    beyond: tuple[tuple[float, float, bool], ...]

    @property
    def least_after(self) -> float:
        """The least that one refinement leaves of what is sharp; infinite where nothing is."""
        left = [after for sharpness, *ends in self.edges if sharpness for after in ends]
        left += [after for sharpness, after, _ in self.beyond if sharpness]
        if self.vertex:
            left.append(max(self.vertex - 1, 0.0))
        return min(left, default=math.inf)

    def sharpened(self, by: int) -> FanSharpness:
        """The same with more sharpness of all that is sharp."""
        return FanSharpness(
            tuple((row[0] + by, row[1] + by, row[2] + by) if row[0] else row for row in self.edges),
            self.vertex and self.vertex + by,
            tuple((row[0] + by, row[1] + by, row[2]) if row[0] else row for row in self.beyond),
        )


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

    @property
    def steady_refinements(self) -> int:
        """Number of refinements that lower all sharpness by one and do nothing else to the one-ring's rules.

        So long all that is sharp stays sharp, however sharp it is: refined parts are as those of the same signature
        `sharpened` by as much less, but for their own sharpness.
        """
        left = min((sharp.least_after for sharp in self._sharpness), default=math.inf)
        # What is left by each of them is more than one, so that the next leaves something as well.
        return max(math.ceil(left) - 2, 0) if left < math.inf else 0

    def sharpened(self, by: int) -> Signature:
        """The same with more sharpness, or less, of all that is sharp; exact, as sharpness is below 10."""
        if by == 0:
            return self
        fans = (
            replace(fan, sharpness=fan.sharpness.sharpened(by))
            if isinstance(fan, TaggedFan) and fan.sharpness is not None
            else fan
            for fan in self.fans
        )
        return Signature(self.kind, tuple(fans))

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
    corners = [half_edge]
    if kind == "face":
        while (following := int(topology.after(corners[-1]))) != half_edge:
            corners.append(following)
    return Signature(kind, tuple(_fan_at(topology, corner) for corner in corners))


def _fan_at(topology: Topology, half_edge: int) -> Fan:
    def half_edges(current: int, turn) -> list[int]:
        found: list[int] = []
        while current >= 0 and not (found and current == half_edge):
            found.append(current)
            current = int(turn(current))
        return found

    vertex = topology.face_vertices[half_edge]
    rule = VertexRule(int(topology.vertex_rules[vertex]))
    ahead = half_edges(half_edge, topology.turn)
    closed = int(topology.turn(ahead[-1])) >= 0
    behind = [] if closed else half_edges(int(topology.turn_back(half_edge)), topology.turn_back)
    faces = (topology.face_of(np.array(found, dtype=np.int32)) for found in (ahead, behind))
    sizes = [tuple(topology.face_sizes[found].tolist()) for found in faces]
    sharpness = _fan_sharpness(topology, int(vertex), behind[::-1] + ahead)
    if closed and rule == VertexRule.AUTOMATIC and sharpness is None:
        return sizes[0]
    return TaggedFan(*sizes, rule, closed, sharpness)


def _fan_sharpness(topology: Topology, vertex: int, half_edges: list[int]) -> FanSharpness | None:
    """Semi-sharp features around a vertex, if there are any."""
    semi = topology.semi_sharpness
    if semi is None:
        return None
    twins = topology.twin[half_edges]
    other = np.where(twins < 0, 0, semi.after[twins])
    edges = np.stack([semi.edges[half_edges], semi.after[half_edges], other], axis=1)
    at = semi.beyond_vertex == vertex
    rows = (values[at].tolist() for values in (semi.beyond, semi.beyond_after, semi.beyond_acts))
    beyond = sorted(zip(*rows, strict=True))
    if not (edges.any() or semi.vertices[vertex] or beyond):
        return None
    return FanSharpness(tuple(map(tuple, edges.tolist())), float(semi.vertices[vertex]), tuple(beyond))
