"""The faces of a one-ring: faces around the corners of an element, glued where they are the same."""

from __future__ import annotations

import numpy as np

from . import ragged
from .signature import Signature, fan_is_closed, fan_size, fan_turns


class GluedFaces:
    """The faces around an element, glued along the edges that walks about its corners cross.

    A walk starts in the element, turns about one of its corners by a number of faces, and arrives at a face. Walks
    about neighbouring corners may arrive at the same one. Around a quadrilateral amid others, (corner, turns) are::

        +-----------+-----------+-----------+
        |    3,2    | 2,3 = 3,1 |    2,2    |
        +-----------3-----------2-----------+
        |           | 0,0 = 1,0 |           |
        | 0,1 = 3,3 | 2,0 = 3,0 | 1,3 = 2,1 |
        +-----------0-----------1-----------+
        |    0,2    | 0,3 = 1,1 |    1,2    |
        +-----------+-----------+-----------+

    Walks without turns stay in the element. Every other walk at first has a face of its own, with half-edges numbered
    from the one that begins at the walk's corner. Then faces are glued along the edges that the walks cross. If a
    half-edge is to be glued to a second one, the two that it is glued to are the same half-edge, and their faces the
    same face. Sets of half-edges that are the same are named by the first one, which belongs to the first walk that
    arrives at the face.
    """

    def __init__(self, signature: Signature) -> None:
        fans = signature.fans
        walks = [(corner, turns) for corner, fan in enumerate(fans) for turns in fan_turns(fan)]
        # (corner, turns): the element first, and walks with few turns before those with many
        self.walks = sorted(walks, key=lambda walk: (walk[0], abs(walk[1]), walk[1]))
        is_element = [signature.kind == "face" and turns == 0 for _, turns in self.walks]
        sizes = [
            0 if is_known and corner else fan_size(fans[corner], turns)
            for (corner, turns), is_known in zip(self.walks, is_element, strict=True)
        ]
        self._begins = ragged.offsets(sizes).tolist()
        self._walk_of = np.repeat(np.arange(len(sizes)), sizes).tolist()
        # The half-edge that each one is glued to, -1 if none; for half-edges that name their sets
        self.twin = [-1] * self._begins[-1]
        # A half-edge that is the same, lower but for the first of all that are the same.
        self._lower = list(range(len(self.twin)))

        # The half-edge of each walk's face that begins at the walk's corner.
        first = {
            walk: walk[0] if is_known else begin
            for walk, is_known, begin in zip(self.walks, is_element, self._begins[:-1], strict=True)
        }
        for corner, fan in enumerate(fans):
            turns = fan_turns(fan)
            ahead = [*turns[1:], turns[0]] if fan_is_closed(fan) else turns[1:]
            for here, beyond in zip(turns, ahead, strict=False):
                # A turn counter-clockwise crosses the last edge of the face, which is the first one of the next face.
                self._glue(self._preceding(first[corner, here]), first[corner, beyond])

    @property
    def faces(self) -> list[int]:
        """One face of all that are the same: the number of the first walk that arrives there."""
        return [
            face
            for face, begin in enumerate(self._begins[:-1])
            if begin < self._begins[face + 1] and self._lower[begin] == begin
        ]

    def half_edges(self, face: int) -> range:
        return range(self._begins[face], self._begins[face + 1])

    def _preceding(self, half_edge: int) -> int:
        own = self.half_edges(self._walk_of[half_edge])
        return half_edge - 1 if half_edge > own.start else own.stop - 1

    def _around(self, half_edge: int) -> list[int]:
        """All half-edges of the same face, from this one on."""
        half_edges = self.half_edges(self._walk_of[half_edge])
        return [*half_edges[half_edge - half_edges.start :], *half_edges[: half_edge - half_edges.start]]

    def _glue(self, one: int, other: int) -> None:
        """Make two half-edges twins."""
        for here, there in ((one, other), (other, one)):
            present = self.twin[_first(self._lower, here)]
            if present >= 0:
                self._make_same(present, there)
        one, other = _first(self._lower, one), _first(self._lower, other)
        self.twin[one], self.twin[other] = other, one

    def _make_same(self, one: int, other: int) -> None:
        """Make two half-edges, and so their faces, the same."""
        kept, dropped = sorted((_first(self._lower, one), _first(self._lower, other)))
        if self._walk_of[kept] == self._walk_of[dropped]:
            return
        for here, there in zip(self._around(kept), self._around(dropped), strict=True):
            # Make one set of those of the two.
            one, other = _first(self._lower, here), _first(self._lower, there)
            self._lower[max(one, other)] = min(one, other)
        for half_edge in self._around(dropped):
            twin, self.twin[half_edge] = self.twin[half_edge], -1
            if twin >= 0:
                self._glue(half_edge, twin)


def _first(lower: list[int], member: int) -> int:
    """The least member of a set of integers, each of which leads to a lower one, the least to itself."""
    while (other := lower[member]) != member:
        member = other
    return member
