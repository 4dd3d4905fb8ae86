"""Tiles that hold one piece or several, and how they are divided: for bounds, before there are samples.

A *tile* is the domain of a patch, or one of the four copies of a tile's domain. Tiles are never turned: their
parameters run as those of the patch, but for the middle copies of triangles, whose run backwards.

A tile inside one polynomial piece has Bernstein coefficients as its control points, and so have its copies. One that
holds several pieces is divided: into the copies that these lie in and, around an extraordinary point, ring by ring:
three copies are pieces of a level, and the fourth, which holds the point, is divided alike. Tiles of different patches
that are divided alike are the same `DividedTile`, over control points of their own, and share its bounds.
"""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np

from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.scheme import Scheme
from .irregular_patch import IrregularPatch, level_rows, rest_rows, transition
from .patch_tree import PartKind, PatchTree
from .polynomials import regular_bernstein, times

# Divisions after which a tile is bounded by its pieces and by what is left: of surfaces, by whether rules are convex,
# as others bound what is left some ten times worse; and of the curves along sides, which have few coefficients.
DIVISIONS, DIVISIONS_OF_SIDES = {True: 8, False: 32}, 32
# Normals are bounded on the pieces after this many divisions.
DIVISIONS_OF_NORMALS = 4


class DividedTile:
    """A tile of one piece or several."""

    def __init__(
        self,
        scheme: Scheme,
        # The element that it covers; or the patch around an extraordinary point, from any level on, whose
        # control points here are its eigen-coordinates; None for a piece
        source: PatchTree | IrregularPatch | None,
        # How a patch around an extraordinary point is turned in the tile: `ParameterDomain.rotation` of this.
        # Elements are not turned.
        turn: int,
    ) -> None:
        self._scheme, self._source, self._turn = scheme, source, turn

    @property
    def control_count(self) -> int:
        """K."""
        if self._source is None:
            return len(regular_bernstein(self._scheme).basis.indices)
        if isinstance(self._source, IrregularPatch):
            return len(self._source.basis.eigenvalues)
        return self._source.control_count

    @property
    def is_piece(self) -> bool:
        """Whether it lies inside one polynomial piece."""
        return self._source is None

    @property
    def is_self_similar(self) -> bool:
        """Whether it lies around an extraordinary point, so that one of the copies is like the tile."""
        return isinstance(self._source, IrregularPatch)

    @cached_property
    def children(self) -> tuple[tuple[DividedTile, FloatArray], ...]:
        """The parts in the copies of the tile, in the order of `ParameterDomain.children`; see `part_of_tile`."""
        scheme, source, turn = self._scheme, self._source, self._turn
        if source is None:
            return tuple((self, rows) for rows in regular_bernstein(scheme).basis.halves)
        if isinstance(source, PatchTree):
            return tuple(part_of_tile(child, stencils) for child, stencils in source.children)
        # The same tile, of the next level, and three pieces.
        found = [(self, transition(source, 1))]
        found += [(_tile(scheme, None, 0), _turned(scheme, turn) @ rows) for rows in level_rows(source, 0)]
        return tuple(found[own] for own in _own_copies(scheme.domain, turn))

    @cached_property
    def corners(self) -> FloatArray:
        """``(m, K)`` points of the surface at the tile's corners."""
        found, every = [], np.eye(self.control_count)
        if self.is_piece:
            return every[regular_bernstein(self._scheme).basis.corners]
        for number in range(self._scheme.domain.corner_count):
            tile, rows = self.children[number]
            # Eigen-coordinates begin with the extraordinary point.
            found.append(every[0] if tile is self else (tile.corners @ rows)[number])
        return np.array(found)

    @property
    def control_points(self) -> FloatArray:
        """``(n, K)`` the control points of the one-ring."""
        if isinstance(self._source, IrregularPatch):
            return self._source.basis.vectors
        return np.eye(self.control_count)

    @cached_property
    def control_faces(self) -> IntArray:
        """``(4, f)`` rows of `control_points` at the ends of one diagonal, then of the other, of the one-ring's faces.

        Of triangles, two sides. At a dart, where one vertex of the ring is left out as it equals another, so are its
        faces. None of a piece.
        """
        if self._source is None:
            return np.empty((4, 0), dtype=np.int64)
        structure = self._source.structure if isinstance(self._source, IrregularPatch) else self._source
        t = one_ring(structure.signature.smoothed).topology
        a, b, c, d = t.face_vertices[t.face_offsets[:-1] + np.arange(4)[:, None] * t.face_sizes // 4]
        vertices = np.stack([a, c, b, d])
        if isinstance(self._source, IrregularPatch) and self._source.structure.slots is not None:
            number = np.full(t.vertex_count, -1)
            number[self._source.structure.slots] = np.arange(len(self._source.structure.slots))
            vertices = number[vertices]
        return vertices[:, (vertices >= 0).all(axis=0)]

    def one_ring_points(self, points: FloatArray) -> FloatArray:
        """Control points of one-rings ``(n, d, t)``, from those of tiles ``(K, d, t)``: the same but for tips."""
        return times(self.control_points, points) if self.is_self_similar else points

    @cached_property
    def tangents(self) -> FloatArray | None:
        """``(2, b, p, K)`` Bernstein coefficients of derivatives by u and v, on pieces with all normals, or nearly all.

        Nearer to extraordinary points than these, normals turn less than on them. None where parts are left after some
        divisions that hold neither pieces nor one extraordinary point.
        """
        pieces, rest = self._divided(DIVISIONS_OF_NORMALS)
        if not all(tile.is_self_similar for tile, _ in rest):
            return None
        found: FloatArray = np.tensordot(regular_bernstein(self._scheme).basis.derivatives, np.stack(pieces), (2, 1))
        return found

    @cached_property
    def hull(self) -> FloatArray | None:
        """``(h, K)`` points around the surface: it lies in their convex hull, which is hardly larger.

        None where rules are not convex and parts are left that hold neither pieces nor one extraordinary point.
        """
        return self._hull(DIVISIONS[self._scheme.has_convex_rules])

    @cached_property
    def side_hulls(self) -> list[FloatArray | None]:
        """Likewise around the curve along each side of the tile."""
        return [self._hull(DIVISIONS_OF_SIDES, side) for side in range(self._scheme.domain.corner_count)]

    def _hull(self, divisions: int, side: int | None = None) -> FloatArray | None:
        pieces, rest = self._divided(divisions, side)
        if not self._scheme.has_convex_rules and not all(tile.is_self_similar for tile, _ in rest):
            return None
        return np.concatenate([*pieces, *(tile._reach @ rows for tile, rows in rest)])

    @cached_property
    def _reach(self) -> FloatArray:
        """``(n, K)`` points around the tile: its one-ring or, if rules are not convex, far enough from its tip."""
        if self._scheme.has_convex_rules or not isinstance(self._source, IrregularPatch):
            return self.control_points
        # The sum of n vectors is the mean of n times each of them.
        away = np.diag((self.control_count - 1) * rest_rows(self._source).max(axis=0))[1:]
        return np.eye(1, self.control_count) + np.concatenate([away, -away])

    def _divided(
        self, divisions: int, side: int | None = None
    ) -> tuple[list[FloatArray], list[tuple[DividedTile, FloatArray]]]:
        """The tile after some divisions, or what of it lies along one side.

        Returns the Bernstein coefficients ``(b, K)`` of pieces, or of their sides, and the tiles that are left, with
        their control points.
        """
        every, m = np.eye(self.control_count), self._scheme.domain.corner_count
        if self.is_piece:
            return [every if side is None else every[regular_bernstein(self._scheme).basis.sides[side]]], []
        if not divisions:
            return [], [(self, every)]
        # Copies of a domain at its corners come first, and share the sides that meet there.
        copies = range(4) if side is None else (side, (side + 1) % m)
        # Around an extraordinary point, one part is left, but along a semi-sharp crease many.
        fewer = divisions - 1 if self.is_self_similar else divisions // 2
        pieces: list[FloatArray] = []
        rest: list[tuple[DividedTile, FloatArray]] = []
        for tile, rows in (self.children[number] for number in copies):
            inner, left = tile._divided(fewer, side)
            pieces += [own @ rows for own in inner]
            rest += [(each, own @ rows) for each, own in left]
        return pieces, rest


def part_of_tile(
    element: PatchTree,
    stencils: FloatArray,  # (K_element, K) float64: the element's control points over those of the tile
) -> tuple[DividedTile, FloatArray]:
    """The part of a tile that an element covers; the same tile for equal ones.

    Returns
    -------
    tile : DividedTile
    rows : (n, K) float64
        Its control points over those of the tile that it is part of.
    """
    scheme, piece = element.scheme, element.piece
    if piece is None:
        if element.kind == PartKind.ONLY_CHILD:
            child, of_child = element.child(0)
            return part_of_tile(child, of_child @ stencils)
        return _tile(scheme, element, 0), stencils
    if piece.patch is None:
        return _tile(scheme, None, 0), regular_bernstein(scheme).of_controls @ piece.stencils @ stencils
    return _tile(scheme, piece.patch, element.turn), piece.coordinates @ stencils


# Tiles take some 20 kB each.
@lru_cache(maxsize=4096)
def _tile(scheme: Scheme, source: PatchTree | IrregularPatch | None, turn: int) -> DividedTile:
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
