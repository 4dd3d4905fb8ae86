"""One-rings at a fan of very many faces, refined as a window of near faces and as the fan, which faces share.

At the end of a crease, and where something around a vertex of a high valence n is semi-sharp, each of the n faces has a
signature of its own, over all points of the fan. But of the vertices of its refined one-ring, only the vertex itself
and those around it depend on more than near faces, and these are the same for all faces, turned. So the fan is refined
once; and for each face its *window*, the one-ring in which the fan is cut down to five faces, which is as small as
those elsewhere.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, Topology
from ..mesh.one_ring import LongRing, one_ring
from ..mesh.signature import (
    BESIDE,
    LARGE_FAN,
    Fan,
    Signature,
    TaggedFan,
    TurnedEdges,
    fan_face_count,
    fan_half_edges,
    fan_is_closed,
    fan_points,
    long_fan,
    signature_at,
    window_of,
)
from ..schemes.domain import AffineMap, FloatArray
from ..schemes.scheme import Scheme
from ..schemes.scheme_members import optional_member
from ..schemes.stencil_table import StencilTable
from .irregular_patch import SharedLimit
from .refined_rings import RefinedRing, RingPattern, refined_ring, ring_pattern

if TYPE_CHECKING:
    from scipy import sparse


def window(scheme: Scheme, signature: Signature) -> Signature | None:
    """The signature of a face with its large fan cut down to near faces.

    None if there is no large fan that all its faces see differently, or more than one, and under rules by which refined
    vertices may depend on faces further away.
    """
    if signature.kind != "face" or not optional_member(scheme, "has_local_borders"):
        return None
    large = _large_fans(signature)
    if len(large) != 1 or (fan_is_closed(signature.fans[large[0]]) and not signature.is_semi_sharp):
        return None
    # Chaikin's method takes the mean of all edges at a vertex.
    if signature.is_semi_sharp and optional_member(scheme, "crease_method") == "chaikin":
        return None
    return _window(signature, large[0])


def _large_fans(signature: Signature) -> list[int]:
    """Corners of a face at fans of very many faces, all of which matter."""
    closed = [
        corner for corner, fan in enumerate(signature.fans) if fan_is_closed(fan) and fan_face_count(fan) >= LARGE_FAN
    ]
    long = long_fan(signature)
    return closed if long is None else [*closed, long]


def _window(signature: Signature, corner: int) -> Signature:
    near = window_of(signature.fans[corner])
    return Signature("face", (*signature.fans[:corner], near, *signature.fans[corner + 1 :]))


class RefinedFace:
    """The refined one-ring of a face at a large fan, in place of `RefinedRings`.

    Parameters
    ----------
    scheme : Scheme
    signature : Signature
    near : RefinedRing
        The refined one-ring of the face's `window`.
    """

    def __init__(self, scheme: Scheme, signature: Signature, near: RefinedRing) -> None:
        (corner,) = _large_fans(signature)
        self._near = near
        fan, self._turn = _unturned(signature.fans[corner])
        self._fan = _refined_fan(scheme, fan)
        self._control_count = one_ring(signature.smoothed).vertex_count
        points = _fan_points(signature.smoothed, corner)
        self._ring, self._window = points.turned(self._fan.begins, self._turn), points.window
        self._pattern, self._vertex = _window_pattern(scheme, _window(signature.smoothed, corner), corner)

    def signature(self, number: int) -> Signature:
        """Signature of a child."""
        found, corner = self._near.signature(number), self._corner(number)
        if corner is None:
            return found
        fan = _turned(self._fan.refined, self._turn)
        return Signature("face", (*found.fans[:corner], fan, *found.fans[corner + 1 :]))

    def over_controls(self, rows: FloatArray, number: int) -> FloatArray:
        """Weights ``(n, s, K_child)`` over the control points of a child, as weights over those of the face."""
        stencils, corner = self._near.stencils(number), self._corner(number)
        # Control points come first in memory, so that their rows are picked and added up as wholes.
        by_control = rows.reshape(-1, rows.shape[2]).T
        found = np.zeros((self._control_count, by_control.shape[1]))
        if corner is None:
            is_vertex = self._pattern.child(number)[1] == self._vertex
            found[self._ring] = self._fan.vertex_weights[:, None] * by_control[is_vertex].sum(axis=0)
            found[self._window] += stencils[~is_vertex].T @ by_control[~is_vertex]
        else:
            points = _fan_points(self.signature(number).smoothed, corner)
            found[self._ring] = self._fan.matrix @ by_control[points.turned(self._fan.begins_refined, self._turn)]
            found[self._window] += stencils[points.is_outside].T @ by_control[points.window[points.is_outside]]
        return found.T.reshape(*rows.shape[:2], self._control_count)

    def stencils(self, number: int) -> FloatArray:
        """Control points of a child over those of the face, ``(K_child, K)``."""
        count = one_ring(self.signature(number).smoothed).vertex_count
        return self.over_controls(np.eye(count)[None], number)[0]

    def table(self, number: int) -> StencilTable:
        """`stencils` of a child at the fan, nearly all of which are zero."""
        child = self.signature(number).smoothed
        points, ring = _fan_points(child, self._corner(number) or 0), self._fan.matrix.tocoo()
        refined = points.turned(self._fan.begins_refined, self._turn)
        stencils, outside = self._near.stencils(number)[points.is_outside], points.window[points.is_outside]
        rows, columns = np.nonzero(stencils)
        return StencilTable.of(
            one_ring(child).vertex_count,
            self._control_count,
            (refined[ring.col], self._ring[ring.row], ring.data),
            (outside[rows], self._window[columns], stencils[rows, columns]),
        )

    @property
    def limit(self) -> SharedLimit:
        """The limit at the fan's vertex, for all its faces."""
        return self._fan.limit

    def _corner(self, number: int) -> int | None:
        """Corner of a child at which the refined fan is; None if it only has the vertex in its one-ring."""
        smooth, vertices, _ = self._pattern.child(number)
        corner = int(np.argmax(vertices == self._vertex))
        return corner if vertices[corner] == self._vertex and corner < len(smooth.fans) else None


@lru_cache(maxsize=1024)
def _window_pattern(scheme: Scheme, smooth: Signature, corner: int) -> tuple[RingPattern, int]:
    """How a window is refined, and the vertex of the fan at one of its corners in the refined mesh."""
    pattern, before, half_edge = ring_pattern(scheme, smooth), one_ring(smooth).topology, 0
    for _ in range(corner):
        half_edge = int(before.next[half_edge])
    after = pattern.refinement.topology
    _, refined_half_edge = scheme.children(before, after, half_edge)[0]
    return pattern, int(after.face_vertices[refined_half_edge])


class _RefinedFan:
    """The fan around a vertex, refined once. Its ring is that of `fan_points`.

    Parameters
    ----------
    scheme : Scheme
    fan : Signature
        Of the vertex, with its semi-sharp features.

    Attributes
    ----------
    refined : Signature
        Of the vertex after the refinement.
    begins, begins_refined : (n,) int64
        The first point of each face in the ring before the refinement, and after it.
    matrix : (r, r_refined) sparse array
        Weights over the refined ring, multiplied by this, are weights over the ring.
    vertex_weights : (r,) float64
        The refined vertex over the ring.
    limit : SharedLimit
        At the vertex, if a crease ends there.
    """

    def __init__(self, scheme: Scheme, fan: Signature) -> None:
        before = one_ring(fan).topology
        after, stencils = scheme.refine(before)
        _, half_edge = scheme.children(before, after, 0)[0]
        self.refined = signature_at(after, half_edge, "vertex")
        ring, self.begins = _ring_points(before, 0)
        ring_refined, self.begins_refined = _ring_points(after, half_edge)
        table, order = stencils.chosen(ring_refined), np.argsort(ring)
        matrix = StencilTable(len(ring), len(ring_refined), order[table.columns], table.rows, table.weights).matrix
        self.matrix: sparse.csr_array = matrix
        self.vertex_weights: FloatArray = matrix[:, [0]].toarray()[:, 0]
        self.limit = SharedLimit()


@lru_cache(maxsize=64)
def _refined_fan(scheme: Scheme, fan: Signature) -> _RefinedFan:
    return _RefinedFan(scheme, fan)


def _ring_points(topology: Topology, half_edge: int) -> tuple[IntArray, IntArray]:
    """`fan_points` of the vertex at which a half-edge begins, from its face on."""
    ((_, ahead),) = fan_half_edges(topology, half_edge, "vertex")
    return fan_points(topology, ahead)


class _FanPoints(NamedTuple):
    """Vertices of the one-ring of a face at a large fan.

    Attributes
    ----------
    ring : (r,) int
        The fan's ring, as the face sees it.
    window : (w,) int
        Those of the face's window.
    is_outside : (w,) bool
        Which of these are not in the ring.
    is_closed : bool
        Whether the fan is; if not, its ring is the same for all its faces.
    """

    ring: IntArray
    window: IntArray
    is_outside: NDArray[np.bool_]
    is_closed: bool

    def turned(self, begins: IntArray, turn: int) -> IntArray:
        """The ring as seen by the first face of the fan, from which so many turns lead to this face."""
        if not self.is_closed:
            return self.ring
        first = len(self.ring) - begins[turn] + 1
        return np.concatenate([self.ring[:1], self.ring[first:], self.ring[1:first]])


@lru_cache(maxsize=4096)
def _fan_points(smooth: Signature, corner: int) -> _FanPoints:
    """Find them in a one-ring without semi-sharp features."""
    whole = one_ring(smooth)
    if isinstance(whole, LongRing):
        is_outside = np.ones(whole.vertex_count, dtype=bool)
        is_outside[whole.ring] = False
        window = np.arange(whole.near.vertex_count)
        return _FanPoints(whole.ring, window, is_outside[: len(window)], False)
    topology = whole.topology
    around = fan_half_edges(topology, 0, "face")
    _, ahead = around[corner]
    around[corner] = ahead[: -1 - BESIDE : -1], ahead[: 1 + BESIDE]
    near = one_ring(_window(smooth, corner)).vertices_around(topology, around)
    ring, _ = _ring_points(topology, ahead[0])
    return _FanPoints(ring, near, ~np.isin(near, ring), True)


def _unturned(fan: Fan) -> tuple[Signature, int]:
    """The signature of the vertex that a fan is around, the same for all its faces; and the turns from there to this.

    Faces whose fan is closed and smooth, and has faces of different sizes, have one for each.
    """
    if isinstance(fan, TaggedFan) and not fan.is_closed:
        return Signature("vertex", (fan._replace(ahead=fan.behind[::-1] + fan.ahead, behind=()),)), len(fan.behind)
    edges = fan.sharpness.edges if isinstance(fan, TaggedFan) and fan.sharpness is not None else ()
    if isinstance(edges, TurnedEdges):
        return edges.vertex, edges.turn
    return Signature("vertex", (fan,)), 0


def _turned(vertex: Signature, turn: int) -> Fan:
    """The fan around a vertex, as the face sees it that so many turns lead to from the first one."""
    fan = vertex.fans[0]
    if isinstance(fan, TaggedFan) and not fan.is_closed:
        return fan._replace(ahead=fan.ahead[turn:], behind=fan.ahead[:turn][::-1])
    return vertex.rotated(turn).fans[0]


def refined_element(scheme: Scheme, signature: Signature) -> RefinedRing | RefinedFace:
    """The refined one-ring of an element, refined alone."""
    near = window(scheme, signature)
    alone = RefinedRing(refined_ring(scheme, near or signature), 0)
    return alone if near is None else RefinedFace(scheme, signature, alone)


def child_domains(scheme: Scheme, signature: Signature) -> tuple[AffineMap, ...]:
    """From the element's parameters to those of each child."""
    return ring_pattern(scheme, (window(scheme, signature) or signature).smoothed).domains
