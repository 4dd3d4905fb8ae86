"""Tiles that hold several pieces, and how they are divided: for bounds, before there are samples.

A *tile* is the domain of a patch, or one of the four copies of a tile's domain. Tiles are never turned: their
parameters run as those of the patch, but for the middle copies of triangles, whose run backwards.

A tile inside one polynomial piece has Bernstein coefficients. One that holds several pieces is divided: into the copies
that these lie in and, around an extraordinary point, ring by ring: three copies are pieces of a level, and the fourth,
which holds the point, is divided alike (`tip_levels`). Tiles of different patches that are divided alike are the same
`DividedTile`, over control points of their own: so what is found out about one serves all.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.scheme import Scheme
from .bernstein import regular_bernstein, times
from .divided_element import DividedElement
from .irregular_patch import IrregularPatch
from .tip_levels import level_rows, transition

# After so many divisions normals are looked at: on the pieces there are then.
NORMAL_DEPTH = 3


class TileChild(NamedTuple):
    """What lies in a tile, or in a copy of it.

    Attributes
    ----------
    tile : DividedTile or None
        None for a piece.
    rows : (n, K) float64
        Over the control points of the tile: those of the child or, for a piece, Bernstein coefficients by the child's
        parameters.
    """

    tile: DividedTile | None
    rows: FloatArray


class DividedTile:
    """A tile that holds several pieces.

    Parameters
    ----------
    scheme : Scheme
    source : DividedElement or IrregularPatch
        The element that it covers; or the patch around an extraordinary point, from any level on, whose control points
        here are its eigen-coordinates.
    turn : int
        How the tile's copy of the domain is turned against that: `ParameterDomain.rotation` of this.
    """

    def __init__(self, scheme: Scheme, source: DividedElement | IrregularPatch, turn: int) -> None:
        self._scheme, self._source, self._turn = scheme, source, turn

    @property
    def control_count(self) -> int:
        """K."""
        if isinstance(self._source, IrregularPatch):
            return len(self._source.basis.eigenvalues)
        return self._source.control_count

    @property
    def is_self_similar(self) -> bool:
        """Whether it lies around an extraordinary point, so that one of the copies is like the tile."""
        return isinstance(self._source, IrregularPatch)

    @cached_property
    def children(self) -> tuple[TileChild, ...]:
        """The copies, in the order of `ParameterDomain.children`; elements have been divided before."""
        scheme, source, turn = self._scheme, self._source, self._turn
        if isinstance(source, IrregularPatch):
            found = [TileChild(None, _turned(scheme, turn) @ rows) for rows in level_rows(source, 0)]
            # The same tile, of the next level.
            found.insert(0, TileChild(self, transition(source, 1)))
        else:
            found = [
                part_of_tile(scheme, child.element, turn + copy.turn, child.stencils)
                for child, copy in source.children_below
            ]
        return tuple(found[own] for own in _own_copies(scheme.domain, turn))

    @cached_property
    def corners(self) -> FloatArray:
        """``(m, K)`` points of the surface at the tile's corners."""
        at, found = regular_bernstein(self._scheme).basis.corners, []
        for number, corner in enumerate(at):
            tile, rows = self.children[number]
            if tile is self:
                # The extraordinary point.
                found.append(np.eye(1, len(rows))[0])
            else:
                found.append((rows if tile is None else tile.corners @ rows)[corner if tile is None else number])
        return np.array(found)

    @property
    def control_points(self) -> FloatArray:
        """``(n, K)`` the control points of the one-ring."""
        if isinstance(self._source, IrregularPatch):
            return self._source.basis.vectors
        return np.eye(self.control_count)

    def one_ring_points(self, points: FloatArray) -> FloatArray:
        """Control points of one-rings ``(n, d, t)``, from those of tiles ``(K, d, t)``: the same but for tips."""
        return times(self.control_points, points) if self.is_self_similar else points

    @cached_property
    def pieces(self) -> FloatArray | None:
        """``(p, b, K)`` Bernstein coefficients of pieces on which all normals are, or nearly those.

        Nearer to extraordinary points than these, normals turn less than on them. None where parts are left after a few
        divisions that hold neither pieces nor one extraordinary point.
        """
        return self._pieces(NORMAL_DEPTH)

    def _pieces(self, depth: int) -> FloatArray | None:
        found = []
        for tile, rows in self.children:
            if tile is None:
                found.append(rows[None])
            elif depth > 1:
                below = tile._pieces(depth - 1)
                if below is None:
                    return None
                found.append(below @ rows)
            elif not tile.is_self_similar:
                return None
        return np.concatenate(found)


def part_of_tile(scheme: Scheme, element: DividedElement, turn: int, stencils: FloatArray) -> TileChild:
    """The part of a tile that an element covers; the same tile for equal ones.

    Parameters
    ----------
    scheme : Scheme
    element : DividedElement
        Which has been divided, if it is no piece.
    turn : int
        As for `DividedTile`; from 0 to twice as many as the domain has corners.
    stencils : (K_element, K) float64
        The element's control points.
    """
    turn %= scheme.domain.corner_count
    if element.piece is None:
        if len(element.copies) == 1:
            ((child, copy),) = element.children_below
            return part_of_tile(scheme, child.element, turn + copy.turn, child.stencils @ stencils)
        return TileChild(_tile(scheme, element, turn), stencils)
    if element.piece.irregular is None:
        rows = _turned(scheme, turn) @ regular_bernstein(scheme).of_controls @ element.piece.stencils
        return TileChild(None, rows @ stencils)
    (tip,), turn = element.tips, (turn + int(element.turns[0])) % scheme.domain.corner_count
    return TileChild(_tile(scheme, tip.patch, turn), tip.coordinates @ stencils)


# Tiles take some 20 kB each.
@lru_cache(maxsize=4096)
def _tile(scheme: Scheme, source: DividedElement | IrregularPatch, turn: int) -> DividedTile:
    return DividedTile(scheme, source, turn)


@lru_cache(maxsize=64)
def _turned(scheme: Scheme, turn: int) -> FloatArray:
    """``(b, b)`` map from Bernstein coefficients to those by parameters that are turned."""
    basis, domain = regular_bernstein(scheme).basis, scheme.domain
    return basis.coefficients(basis.values(domain.rotation(turn)(basis.indices / basis.degree)))


@lru_cache(maxsize=64)
def _own_copies(domain: ParameterDomain, turn: int) -> tuple[int, ...]:
    """For each copy of a domain, which one it is as a turned part counts them."""
    rotation, copies = domain.rotation(turn), domain.children
    return tuple(
        next(i for i, own in enumerate(copies) if (own @ rotation).is_same(rotation @ copy)) for copy in copies
    )
