"""Tiles of an element as a tree, with the convex hulls of the surface over them: for bounds, before there are samples.

A *tile* is the domain of a patch, or one of the four copies of a tile's domain. Tiles are never turned: their
parameters run as those of the patch, but for the middle copies of triangles, whose run backwards.

A tile inside one polynomial piece has Bernstein coefficients. One that holds several pieces is divided: into the copies
that these lie in and, around an extraordinary point, ring by ring: three copies are pieces, and the fourth holds the
point. The surface over all rings from one on is bounded in closed form, as eigen-coordinates shrink by powers of the
eigenvalues.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.scheme import Scheme
from .bernstein import RegularBernstein, regular_bernstein
from .irregular_patch import IrregularPatch
from .piece_tree import NodeKind, PieceTree, piece_tree
from .polynomial_basis import polynomial_basis

# Rings around an extraordinary point whose coefficients are used one by one; those that follow are bounded together.
RINGS_IN_HULL = 4
# Further rings of which the bound of all that follow is the largest: terms shrink from ring to ring, but for those of
# Jordan blocks, which grow at first.
RINGS_IN_REACH = 64


@dataclass(frozen=True, eq=False)
class Tail:
    """A bound of the surface around an extraordinary point.

    With control points C, every point is ``limit @ C`` plus at most, along each axis, ``reach @ |coordinates @ C|``.

    Attributes
    ----------
    limit : (K,) float64
    coordinates : (J, K) float64
        Of the eigenvectors after the first.
    reach : (J,) float64
    """

    limit: FloatArray
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
        As `piece_tree`.
    """
    return _Builder(scheme, piece_tree(scheme, signature)).tree()


class _Builder:
    """Makes a tile tree of a piece tree, depth first."""

    def __init__(self, scheme: Scheme, tree: PieceTree) -> None:
        self._domain, self._tree = scheme.domain, tree
        self._form: RegularBernstein = regular_bernstein(scheme)
        self._control_count = tree.blocks.shape[1] if len(tree.blocks) else tree.orders.shape[1]
        self._powers = polynomial_basis(scheme).powers
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
        corner_count = self._domain.corner_count
        children = np.array(self._children, dtype=np.int64).reshape(-1, len(self._domain.children))
        corners = np.array(self._corners).reshape(-1, corner_count, self._control_count)
        return TileTree(np.array(self._pieces), children, self._hulls, self._tails, corners)

    def _added(self, node: int, turn: int) -> int:
        """Add a node of the piece tree, and say where: as in `TileTree.children`.

        Parameters
        ----------
        turn : int
            How the copy of the domain that the node covers is turned against its tile.
        """
        tree, domain = self._tree, self._domain
        turn = (turn + int(tree.turns[node])) % domain.corner_count
        kind, first = NodeKind(tree.kinds[node]), int(tree.first[node])
        if kind is NodeKind.ONLY_CHILD:
            return self._added(first, turn)
        if kind is NodeKind.OWN_POINTS:
            rows = np.zeros((len(self._form.of_controls), self._control_count))
            rows[:, tree.orders[first]] = self._form.of_controls
            return self._piece(rows, turn)
        if kind is NodeKind.REGULAR:
            return self._piece(self._form.of_monomials @ tree.blocks[first].T, turn)
        if kind is NodeKind.IRREGULAR:
            return self._rings(node, turn, 0)
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

    def _rings(self, node: int, turn: int, level: int) -> int:
        """Add the tile around an extraordinary point from a level on: three pieces, and the tile of the next level."""
        tree, domain = self._tree, self._domain
        level_count, shrinking = int(tree.levels[node]), float(tree.shrinking[node])
        patch, stencils = tree.irregular[node]
        tile = self._divided()
        for number, own in enumerate(self._own[turn]):
            if own == 0:
                around = number
                continue
            block = tree.blocks[int(tree.first[node]) + level * (len(domain.children) - 1) + own - 1]
            scale = np.where(self._powers.any(axis=1), shrinking**level, 1)
            self._children[tile][number] = self._piece(self._form.of_monomials @ (block * scale).T, turn)
        if level + 1 < level_count:
            self._children[tile][around] = self._rings(node, turn, level + 1)
        else:
            # Nothing so near to the point can be told from it. The tile is never divided again.
            self._children[tile][around] = self._tip(node)
        rings = min(RINGS_IN_HULL, level_count - level)
        end = self._hulls[tile].start + rings * (len(domain.children) - 1)
        self._finish(tile, end, self._tail(patch, stencils, level + rings))
        return tile

    def _tip(self, node: int) -> int:
        """A piece that is the extraordinary point only."""
        patch, stencils = self._tree.irregular[node]
        limit = patch.basis.inverse[0] @ stencils
        self._pieces.append(np.repeat(limit[None], len(self._form.basis.indices), axis=0))
        return ~(len(self._pieces) - 1)

    def _tail(self, patch: IrregularPatch, stencils: FloatArray, level: int) -> Tail:
        basis = patch.basis
        coordinates = basis.inverse @ stencils
        limit, coordinates = coordinates[0], np.linalg.matrix_power(basis.block_matrix(), level) @ coordinates
        return Tail(limit, coordinates[1:], _reach(patch, self._form)[1:])


def _own_copies(domain: ParameterDomain, turn: int) -> list[int]:
    """For each copy of a domain, which one it is as a turned piece counts them."""
    rotation, copies = domain.rotation(turn), domain.children
    return [next(i for i, own in enumerate(copies) if (own @ rotation).is_same(rotation @ copy)) for copy in copies]


@lru_cache(maxsize=256)
def _reach(patch: IrregularPatch, form: RegularBernstein) -> FloatArray:
    """``(K,)`` the largest coefficient of each eigenvector over any ring."""
    rows = (form.of_controls @ patch.eigen_children).reshape(-1, len(patch.basis.eigenvalues))
    transition = patch.basis.block_matrix()
    reach = np.zeros(rows.shape[1])
    for _ in range(RINGS_IN_REACH):
        reach = np.maximum(reach, np.abs(rows).max(axis=0))
        rows = rows @ transition
    return reach
