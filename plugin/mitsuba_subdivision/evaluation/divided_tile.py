"""Division of tiles into polynomial pieces, for bounds of points and normals.

A *tile* is the domain of a patch, or one of the four children of a tile. Tiles are never turned: their parameters run
in the directions of the patch's, except in the middle children of triangles, where they run backwards.

The control points of a tile inside one polynomial piece are Bernstein coefficients, and so are those of its children. A
tile with several pieces is divided into its four children. Around an extraordinary point three children are the regular
pieces of a level, and the fourth, which contains the point, is divided in the same way. Tiles of different patches that
are divided in the same way share one `DividedTile` and its bounds; only their control points differ.
"""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np

from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.scheme import Scheme
from .irregular_patch import IrregularPatch, level_rows, rest_rows
from .patch_tree import PartKind, PatchTree
from .polynomials import polynomial_basis, times

# Number of divisions before a tile is bounded by its pieces and the parts that are still undivided. For surfaces it
# depends on `Scheme.has_convex_rules`: without convex rules the bound of undivided parts is some ten times looser.
# Curves along sides have few coefficients. Most flat tiles are flat by the fewer points of hulls after few divisions.
DIVISIONS, DIVISIONS_OF_SIDES, FEW_DIVISIONS = {True: 8, False: 32}, 32, (1, 4)
# Number of divisions before normals are bounded on the pieces.
DIVISIONS_OF_NORMALS = 4


class DividedTile:
    """A tile of one or more polynomial pieces."""

    def __init__(
        self,
        scheme: Scheme,
        # The element that the tile covers; or the patch around an extraordinary point, at any level, with
        # eigen-coordinates as control points; or None for a polynomial piece
        source: PatchTree | IrregularPatch | None,
        # Argument of `ParameterDomain.rotation` that maps the tile's parameters to those of the patch around an
        # extraordinary point. 0 for elements.
        turn: int,
    ) -> None:
        self._scheme, self._source, self._turn = scheme, source, turn
        self._bernstein = polynomial_basis(scheme).bernstein
        self.is_piece = source is None
        # Whether the tile has an extraordinary point at a corner, so that one child equals the tile.
        self.is_self_similar = isinstance(source, IrregularPatch)
        # (n, K) stencils of the control points of the one-ring, or of a piece, over the tile's control points.
        if isinstance(source, IrregularPatch):
            self.control_points: FloatArray = source.basis.vectors
        else:
            self.control_points = np.eye(len(self._bernstein.indices) if source is None else source.control_count)

    @cached_property
    def children(self) -> tuple[tuple[DividedTile, FloatArray], ...]:
        """The children, in the order of `ParameterDomain.children`, as returned by `part_of_tile`."""
        scheme, source, turn = self._scheme, self._source, self._turn
        if source is None:
            return tuple((self, rows) for rows in self._bernstein.halves)
        if isinstance(source, PatchTree):
            return tuple(part_of_tile(child, stencils) for child, stencils in source.children)
        # The same tile at the next level, and three pieces.
        parts = [(self, source.basis.block_matrix())]
        parts += [(_tile(scheme, None, 0), _turned(scheme, turn) @ rows) for rows in level_rows(source, 0)]
        return tuple(parts[number] for number in _children_before_turn(scheme.domain, turn))

    @cached_property
    def corners(self) -> FloatArray:
        """``(m, K)`` stencils of the surface points at the tile's corners."""
        identity = np.eye(self.control_points.shape[1])
        if self.is_piece:
            return identity[self._bernstein.corners]
        corners = []
        for number, (tile, rows) in enumerate(self.children[: self._scheme.domain.corner_count]):
            # The first eigen-coordinate is the extraordinary point.
            corners.append(identity[0] if tile is self else (tile.corners @ rows)[number])
        return np.array(corners)

    @cached_property
    def control_faces(self) -> IntArray:
        """``(4, f)`` rows of `control_points`: ends of one diagonal, then of the other, of the one-ring's faces.

        For triangles, two sides in place of diagonals. At a dart one of two equal vertices of the ring is left out, and
        so are its faces. A piece has no faces.
        """
        if self._source is None:
            return np.empty((4, 0), dtype=np.int64)
        t = one_ring(self._source.signature).topology
        a, b, c, d = t.face_vertices[t.face_offsets[:-1] + np.arange(4)[:, None] * t.face_sizes // 4]
        vertices = np.stack([a, c, b, d])
        if isinstance(self._source, IrregularPatch):
            number = np.full(t.vertex_count, -1)
            number[self._source.slots] = np.arange(len(self._source.slots))
            vertices = number[vertices]
        return vertices[:, (vertices >= 0).all(axis=0)]

    def one_ring_points(self, points: FloatArray) -> FloatArray:
        """Return control points ``(n, d, t)`` of one-rings, from those of t tiles ``(K, d, t)``."""
        return times(self.control_points, points) if self.is_self_similar else points

    @cached_property
    def tangents(self) -> FloatArray | None:
        """``(2, b, p, K)`` Bernstein coefficients of derivatives by u and v, on pieces that cover nearly all normals.

        The undivided parts lie around extraordinary points, where normals vary less than on the pieces. None if other
        parts are undivided after `DIVISIONS_OF_NORMALS`.
        """
        pieces, rest = self._divided(DIVISIONS_OF_NORMALS)
        if not all(tile.is_self_similar for tile, _ in rest):
            return None
        tangents: FloatArray = np.tensordot(self._bernstein.derivatives, np.stack(pieces), (2, 1))
        return tangents

    @cached_property
    def hull(self) -> FloatArray | None:
        """``(h, K)`` stencils of points whose convex hull contains the surface, and is hardly larger.

        None where rules are not convex and parts are undivided that are not around one extraordinary point.
        """
        return self._hull(DIVISIONS[self._scheme.has_convex_rules])

    @cached_property
    def hulls(self) -> list[FloatArray]:
        """Stencils like `hull`, which is the last, of fewer points at first, whose hulls are larger."""
        rough = [self._hull(divisions) for divisions in FEW_DIVISIONS] if not self.is_piece else []
        return [stencils for stencils in [*rough, self.hull] if stencils is not None]

    @cached_property
    def side_hulls(self) -> list[FloatArray | None]:
        """Like `hull`, for the curve along each side of the tile."""
        return [self._hull(DIVISIONS_OF_SIDES, side) for side in range(self._scheme.domain.corner_count)]

    def _hull(self, divisions: int, side: int | None = None) -> FloatArray | None:
        pieces, rest = self._divided(divisions, side)
        if not self._scheme.has_convex_rules and not all(tile.is_self_similar for tile, _ in rest):
            return None
        return np.concatenate([*pieces, *(tile._reach @ rows for tile, rows in rest)])

    @cached_property
    def _reach(self) -> FloatArray:
        """``(n, K)`` stencils of points around an undivided tile: its one-ring, or a bound of `rest_rows`."""
        if self._scheme.has_convex_rules or not isinstance(self._source, IrregularPatch):
            return self.control_points
        # The sum of n vectors is the mean of n times each of them.
        bound = rest_rows(self._source).max(axis=0)
        away = np.diag((len(bound) - 1) * bound)[1:]
        return np.eye(1, len(bound)) + np.concatenate([away, -away])

    def _divided(
        self, divisions: int, side: int | None = None
    ) -> tuple[list[FloatArray], list[tuple[DividedTile, FloatArray]]]:
        """Divide the tile; with ``side``, only along one side.

        Returns the Bernstein coefficients ``(b, K)`` of pieces, or of their sides, and the undivided tiles with the
        stencils of their control points.
        """
        identity, m = np.eye(self.control_points.shape[1]), self._scheme.domain.corner_count
        if self.is_piece:
            return [identity if side is None else identity[self._bernstein.sides[side]]], []
        if not divisions:
            return [], [(self, identity)]
        # The children at the corners come first; those at the ends of a side cover it.
        numbers = range(4) if side is None else (side, (side + 1) % m)
        # A division leaves one undivided part around an extraordinary point, but many along a semi-sharp crease.
        remaining = divisions - 1 if self.is_self_similar else divisions // 2
        pieces: list[FloatArray] = []
        rest: list[tuple[DividedTile, FloatArray]] = []
        for tile, rows in (self.children[number] for number in numbers):
            child_pieces, child_rest = tile._divided(remaining, side)
            pieces += [coefficients @ rows for coefficients in child_pieces]
            rest += [(part, stencils @ rows) for part, stencils in child_rest]
        return pieces, rest


def part_of_tile(
    element: PatchTree,
    stencils: FloatArray,  # (K_element, K) float64: the element's control points over those of the parent tile
) -> tuple[DividedTile, FloatArray]:
    """Return the tile of an element that is a part of a parent tile; equal tiles are the same object.

    Also returns the tile's control points over those of the parent tile, (n, K) float64.
    """
    scheme, piece = element.scheme, element.piece
    if piece is None:
        if element.kind == PartKind.ONLY_CHILD:
            ((child, child_stencils),) = element.children
            return part_of_tile(child, child_stencils @ stencils)
        return _tile(scheme, element, 0), stencils
    if piece.patch is None:
        return _tile(scheme, None, 0), polynomial_basis(scheme).of_controls @ piece.stencils @ stencils
    return _tile(scheme, piece.patch, element.turn), piece.coordinates @ stencils


# A tile takes some 20 kB.
_tile = lru_cache(maxsize=4096)(DividedTile)


@lru_cache(maxsize=64)
def _turned(scheme: Scheme, turn: int) -> FloatArray:
    """Return the ``(b, b)`` map from Bernstein coefficients to those of the polynomial in turned parameters."""
    basis, domain = polynomial_basis(scheme).bernstein, scheme.domain
    return basis.coefficients(basis.values(domain.rotation(turn)(basis.indices / basis.degree)))


@lru_cache(maxsize=64)
def _children_before_turn(domain: ParameterDomain, turn: int) -> tuple[int, ...]:
    """Return, for each child of a domain, its number among the children of the turned domain."""
    rotation, children = domain.rotation(turn), domain.children
    return tuple(
        next(i for i, turned in enumerate(children) if (turned @ rotation).is_same(rotation @ child))
        for child in children
    )
