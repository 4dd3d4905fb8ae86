"""Tiles of an element as a tree, with the convex hulls of the surface over them: for bounds, before there are samples.

A *tile* is the domain of a patch, or one of the four copies of a tile's domain. Tiles are never turned: their
parameters run as those of the patch, but for the middle copies of triangles, whose run backwards.

A tile inside one polynomial piece has Bernstein coefficients. One that holds several pieces is divided: into the copies
that these lie in and, around an extraordinary point, ring by ring: three copies are pieces of a level, and the fourth
holds the point (`tip_levels`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.scheme import Scheme
from .bernstein import regular_bernstein
from .divided_element import DividedElement, ElementTip, PartKind, divided_elements
from .tip_levels import distinct_levels, level_rows, rest_rows, transition

# Rings around an extraordinary point whose coefficients are used one by one; those that follow are bounded together.
RINGS_IN_HULL = 4


@dataclass(frozen=True, eq=False)
class Tail:
    """A bound of the surface around an extraordinary point.

    With control points C, every point is ``(coordinates @ C)[0]`` plus at most, along any axis,
    ``reach @ |coordinates @ C|``.

    Attributes
    ----------
    coordinates : (J, K) float64
    reach : (J,) float64
    """

    coordinates: FloatArray
    reach: FloatArray


@dataclass(frozen=True, eq=False)
class TileTree:
    """Tiles of a patch that are divided, and pieces, which need not be.

    Attributes
    ----------
    pieces : (p, b, K) float64
        Bernstein coefficients over the one-ring, by the tile's own parameters. The pieces of a divided tile follow each
        other.
    children : (n, 4) int64
        Of each divided tile the copies, in the order of `ParameterDomain.children`: a divided tile; or a piece, by the
        complement ``~piece``. The first divided tile is the patch. There is none where the patch is a piece itself.
    hulls : list of slice
        Pieces that bound the surface over each divided tile, together with its tail.
    tails : list of Tail or None
        Around the extraordinary point of a divided tile, for what lies nearer to it than the pieces of its hull.
    corners : (n, m, K) float64
        Points at the corners of each divided tile.
    """

    pieces: FloatArray
    children: IntArray
    hulls: list[slice]
    tails: list[Tail | None]
    corners: FloatArray


@lru_cache(maxsize=128)
def tile_tree(scheme: Scheme, signature: Signature) -> TileTree:
    """Divide an element of a signature into tiles.

    Raises
    ------
    SchemeError
        As `divided_elements`.
    """
    (element,) = divided_elements(scheme, [signature])
    return _Builder(scheme, element).tree()


class _Builder:
    """Makes a tile tree of a divided element, depth first."""

    def __init__(self, scheme: Scheme, element: DividedElement) -> None:
        self._domain, self._element, self._form = scheme.domain, element, regular_bernstein(scheme)
        self._regular = element.coefficients(self._form.of_controls)
        self._pieces: list[FloatArray] = []
        self._children: list[list[int]] = []
        self._hulls: list[slice] = []
        self._tails: list[Tail | None] = []
        self._corners: list[FloatArray] = []
        basis, domain = self._form.basis, scheme.domain
        sites = basis.indices / basis.degree
        turns = range(domain.corner_count)
        self._turned = [basis.coefficients(basis.values(domain.rotation(turn)(sites))) for turn in turns]
        self._own = [_own_copies(domain, turn) for turn in turns]

    def tree(self) -> TileTree:
        self._added(0, 0)
        children = np.array(self._children, dtype=np.int64).reshape(-1, len(self._domain.children))
        corners = np.array(self._corners).reshape(-1, self._domain.corner_count, self._element.control_count)
        return TileTree(np.array(self._pieces), children, self._hulls, self._tails, corners)

    def _added(self, part: int, turn: int) -> int:
        """Add a part, and say where: as in `TileTree.children`.

        Parameters
        ----------
        part : int
            Its number.
        turn : int
            How the copy of the domain that the part covers is turned against its tile.
        """
        element, kind = self._element, self._element.kinds[part]
        turn = (turn + int(element.turns[part])) % self._domain.corner_count
        if kind == PartKind.REGULAR:
            return self._piece(self._regular[element.leaf[part]], turn)
        if kind == PartKind.TIP:
            return self._rings(element.tips[element.leaf[part]], turn, 0)
        first = int(element.children[part])
        if kind == PartKind.ONLY_CHILD:
            return self._added(first, turn)
        tile = self._divided()
        for number, own in enumerate(self._own[turn]):
            self._children[tile][number] = self._added(first + own, turn)
        self._finish(tile, len(self._pieces), None)
        return tile

    def _piece(self, rows: FloatArray, turn: int) -> int:
        self._pieces.append(self._turned[turn] @ rows)
        return ~(len(self._pieces) - 1)

    def _divided(self) -> int:
        """Add a tile whose children are not yet known."""
        self._children.append([0] * len(self._domain.children))
        self._hulls.append(slice(len(self._pieces), 0))
        self._tails.append(None)
        self._corners.append(np.empty(0))
        return len(self._children) - 1

    def _finish(self, tile: int, end: int, tail: Tail | None) -> None:
        """Complete a divided tile, whose children are known."""
        self._hulls[tile], self._tails[tile] = slice(self._hulls[tile].start, end), tail
        corners = []
        for corner in range(self._domain.corner_count):
            child = self._children[tile][corner]
            if child < 0:
                corners.append(self._pieces[~child][self._form.basis.corners[corner]])
            else:
                corners.append(self._corners[child][corner])
        self._corners[tile] = np.array(corners)

    def _rings(self, tip: ElementTip, turn: int, level: int) -> int:
        """Add the tile around an extraordinary point from a level on: three pieces, and the tile of the next level."""
        level_count = distinct_levels(tip.patch)
        tile = self._divided()
        rows = level_rows(tip.patch, level) @ tip.coordinates
        for number, own in enumerate(self._own[turn]):
            if own == 0:
                around = number
                continue
            self._children[tile][number] = self._piece(rows[own - 1], turn)
        if level + 1 < level_count:
            self._children[tile][around] = self._rings(tip, turn, level + 1)
        else:
            # Nothing so near to the point can be told from it. The tile is never divided again.
            self._children[tile][around] = self._piece(np.repeat(tip.coordinates[:1], rows.shape[1], axis=0), turn)
        rings = min(RINGS_IN_HULL, level_count - level)
        end = self._hulls[tile].start + rings * len(rows)
        coordinates = transition(tip.patch, level + rings) @ tip.coordinates
        self._finish(tile, end, Tail(coordinates, rest_rows(tip.patch).max(axis=0)))
        return tile


def _own_copies(domain: ParameterDomain, turn: int) -> list[int]:
    """For each copy of a domain, which one it is as a turned piece counts them."""
    rotation, copies = domain.rotation(turn), domain.children
    return [next(i for i, own in enumerate(copies) if (own @ rotation).is_same(rotation @ copy)) for copy in copies]
