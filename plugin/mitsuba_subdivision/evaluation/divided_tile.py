"""Division of tiles into polynomial pieces, for bounds of points and normals.

A *tile* is the domain of a patch, or one of the four children of a tile. Tiles are never turned: their parameters run
in the directions of the patch's, except in the middle children of triangles, where they run backwards.

The control points of a tile inside one polynomial piece are Bernstein coefficients, and so are those of its children. A
tile with several pieces is divided into its four children, and its control points are those of its one-ring. Around an
extraordinary point three children are pieces, and the fourth, which contains the point, is a tile of the same kind.
Tiles of different patches that are divided in the same way share one `DividedTile` and its bounds.
"""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np

from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .irregular_patch import rest_rows
from .patch_tree import PartKind, PatchTree, refine
from .polynomials import polynomial_basis

# Number of divisions before a tile is bounded by its pieces and the parts that are still undivided. For surfaces it
# depends on `Scheme.has_convex_rules`: without convex rules the bound of undivided parts is some ten times looser.
# Curves along sides have few coefficients. Most flat tiles are flat by the fewer points of hulls after few divisions.
DIVISIONS, DIVISIONS_OF_SIDES, FEW_DIVISIONS = {True: 8, False: 32}, 32, (1, 4)
DIVISIONS_OF_NORMALS = 4  # Number of divisions before normals are bounded on the pieces


class DividedTile:
    """A tile of one or more polynomial pieces."""

    def __init__(
        self,
        scheme: Scheme,
        element: PatchTree | None,  # That the tile covers; None for a polynomial piece
    ) -> None:
        self._scheme, self._element = scheme, element
        self._bernstein = polynomial_basis(scheme).bernstein
        self.is_piece = element is None
        # Whether the tile has an extraordinary point at a corner, so that one child equals the tile.
        self.is_self_similar = element is not None and element.kind == PartKind.TIP
        self._control_points = np.eye(len(self._bernstein.indices) if element is None else element.control_count)

    @cached_property
    def children(self) -> tuple[tuple[DividedTile, FloatArray], ...]:
        """The children, in the order of `ParameterDomain.children`, as returned by `part_of_tile`."""
        if self._element is None:
            return tuple((self, rows) for rows in self._bernstein.halves)
        refine([self._element])
        return tuple(part_of_tile(child, stencils) for child, stencils in self._element.refined)

    @cached_property
    def corners(self) -> FloatArray:
        """``(m, K)`` stencils of the surface points at the tile's corners."""
        if self._element is None:
            return self._control_points[self._bernstein.corners]
        corners, tip = [], self._element.piece
        for number, (tile, rows) in enumerate(self.children[: self._scheme.domain.corner_count]):
            # The first eigen-coordinate is the extraordinary point.
            corners.append((tile.corners @ rows)[number] if tip is None or tile is not self else tip.coordinates[0])
        return np.array(corners)

    @cached_property
    def control_faces(self) -> IntArray:
        """``(4, f)`` control points of the one-ring's faces: ends of both diagonals; of two sides of triangles."""
        if self._element is None:
            return np.empty((4, 0), dtype=np.int64)
        t = one_ring(self._element.signature).topology
        a, b, c, d = t.face_vertices[t.face_offsets[:-1] + np.arange(4)[:, None] * t.face_sizes // 4]
        return np.stack([a, c, b, d])

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
        tip = None if self._element is None else self._element.piece
        if self._scheme.has_convex_rules or tip is None:
            return self._control_points
        # The sum of n vectors is the mean of n times each of them.
        bound = rest_rows(tip.irregular_patch).max(axis=0)
        away = np.diag((len(bound) - 1) * bound)[1:]
        return (np.eye(1, len(bound)) + np.concatenate([away, -away])) @ tip.coordinates

    def _divided(
        self, divisions: int, side: int | None = None
    ) -> tuple[list[FloatArray], list[tuple[DividedTile, FloatArray]]]:
        """Divide the tile; with ``side``, only along one side.

        Returns Bernstein coefficients ``(b, K)`` of pieces, or of their sides, and undivided tiles with their stencils.
        """
        identity, m = self._control_points, self._scheme.domain.corner_count
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
    """Return the tile of a part of a parent tile, the same for equal parts, and its control points over the parent."""
    if element.kind == PartKind.ONLY_CHILD:
        ((child, child_stencils),) = element.children
        return part_of_tile(child, child_stencils @ stencils)
    if element.kind == PartKind.REGULAR and element.piece is not None:
        of_controls = polynomial_basis(element.scheme).of_controls
        return _tile(element.scheme, None), of_controls @ element.piece.stencils @ stencils
    return _tile(element.scheme, element), stencils


_tile = lru_cache(maxsize=4096)(DividedTile)  # A tile takes some 20 kB
