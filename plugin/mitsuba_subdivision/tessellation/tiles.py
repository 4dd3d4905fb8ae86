"""Tiles: the parts of patches that an adaptive tessellation has a grid for, each with rates of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IndexArray, IntArray
from ..schemes.domain import ParameterDomain

# Rings around extraordinary points are at most so deep: single precision tells nothing nearer apart.
DEEPEST = 24
# Parameters of patches in integers: corners of tiles lie at multiples of this part of a patch.
UNIT = 1 << DEEPEST


@dataclass(frozen=True, eq=False)
class Tiles:
    """Parts of patches, each with a grid of its own.

    A tile is a copy of its patch's domain, ``2^depth`` times smaller.
    """

    # (t,) int32: corner of its element that a tile's patch begins at, a half-edge of `PatchTable.elements`
    corner: IndexArray
    depth: NDArray[np.int8]  # (t,) int8
    # (t, 2) int32: where the tile lies in its patch's domain: its least u and v, in units of ``2^-depth``
    origin: IndexArray
    # (t,) bool: whether its parameters run backwards, as those of the middle copies of triangles do. Its corner (0,
    # 0) is then at ``origin + 1``.
    is_flipped: NDArray[np.bool_]
    # (t,) int8: how often an edge of the cage is halved to a tile's side; around extraordinary points, an edge of a
    # ring
    halvings: NDArray[np.int8]
    rates: IndexArray  # (t, 2) int32: segments along u and v; over triangles both are the same
    # (t, m) int16: least segments on each side: more than the rates where an outline may run along a border of the
    # mesh, which the boundary of the cage and the sides of creases are. 0 inside. Spans have them instead, see
    # `Spans`.
    sides: NDArray[np.int16]

    def __len__(self) -> int:
        return len(self.corner)

    def __getitem__(self, chosen: NDArray | slice) -> Tiles:
        return Tiles(*(each[chosen] for each in self._arrays))

    @property
    def _arrays(self) -> tuple[NDArray, ...]:
        return self.corner, self.depth, self.origin, self.is_flipped, self.halvings, self.rates, self.sides

    @property
    def size(self) -> IndexArray:
        """``(t,)`` length of each tile's sides in its patch, in parts of `UNIT`."""
        return np.int32(UNIT) >> self.depth.astype(np.int32)

    @classmethod
    def joined(cls, parts: list[Tiles]) -> Tiles:
        """All tiles of some lists."""
        return cls(*(np.concatenate(each) for each in zip(*(part._arrays for part in parts), strict=True)))

    def child(self, number: int, domain: ParameterDomain) -> Tiles:
        """One of the four copies of each tile, in the order of `ParameterDomain.children`."""
        is_middle = domain.corner_count == 3 and number == 3
        # Where the copy begins, in units of half a tile, from the tile's corner (0, 0).
        step = np.array(
            [(0, 0), (1, 0), (0, 1), (0, 0)] if domain.corner_count == 3 else [(0, 0), (1, 0), (1, 1), (0, 1)],
            dtype=np.int32,
        )
        step = np.where(self.is_flipped[:, None], 1 - step[number], step[number])
        # A copy at a corner shares the sides that meet there.
        corner, m = np.arange(domain.corner_count), domain.corner_count
        own_sides = ((corner == number) | (corner == (number - 1) % m)) & (not is_middle)
        return Tiles(
            self.corner,
            self.depth + 1,
            2 * self.origin + step,
            self.is_flipped ^ is_middle,
            self.halvings + 1,
            self.rates,
            np.where(own_sides, -(-self.sides // 2), 0),
        )

    @classmethod
    def whole(cls, corners: IntArray, is_border: NDArray[np.bool_]) -> Tiles:
        """One tile for each patch that begins at these corners; and which sides are borders."""
        count = len(corners)
        return cls(
            np.asarray(corners, dtype=np.int32),
            np.zeros(count, dtype=np.int8),
            np.zeros((count, 2), dtype=np.int32),
            np.zeros(count, dtype=bool),
            np.zeros(count, dtype=np.int8),
            np.ones((count, 2), dtype=np.int32),
            is_border.astype(np.int16),
        )
