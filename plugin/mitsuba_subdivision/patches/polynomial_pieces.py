"""The whole surface as polynomials in Bernstein form, for bounds, integrals and searches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache, partial
from operator import itemgetter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..evaluation.irregular_patch import IrregularPatch, level_at_size, level_domains, level_rows, rest_rows, transition
from ..evaluation.patch_tree import PatchTree, patch_trees
from ..evaluation.polynomials import BernsteinBasis, polynomial_basis, times
from ..mesh.connectivity import IntArray, Topology
from ..messages import counted
from ..schemes.domain import FloatArray, ParameterMap
from .patch_table import PatchTable

# Size, relative to the patch, down to which levels around extraordinary points are bounded by Bernstein coefficients,
# as they shrink by the second eigenvalue. The looser bound of the remaining levels is then small beside the element.
TIP_SIZE = 1 / 64
# Pieces per run when computing boxes, whose arrays stay in a processor's cache.
RUN = 1024
_Any = TypeVar("_Any")
_Parts = TypeVar("_Parts", bound="PartArrays")

# Halvings of an element, here into 8 by 8 parts, before the coefficients of the parts bound it. A box then exceeds the
# tight one by some percent of the deviation of a part from a plane, a 64th of that of the element.
HALVINGS = 3
# Error of evaluation in single precision, in units of the last place of the largest coordinate, and that unit. The
# largest measured error is seven units, around a face of 50 corners.
UNITS, UNIT = 16, 2.0**-24
# Pieces that are divided at once, which bounds temporary memory to some megabytes.
CHUNK = 128


class PartArrays:
    """Parts of a surface as a struct of arrays. The first field is common to all parts; arrays have a row per part."""

    @property
    def _fields(self) -> tuple[Any, ...]:
        return tuple(getattr(self, field.name) for field in fields(self))  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self._fields[1])

    def chosen(self: _Parts, which: NDArray) -> _Parts:
        """The parts selected by indices or a mask."""
        make: Callable[..., _Parts] = type(self)
        common, *arrays = self._fields
        return make(common, *(array[which] for array in arrays))

    @classmethod
    def joined(cls: type[_Parts], parts: Iterable[_Parts]) -> _Parts:
        """Concatenate parts, at least one, whose first field is the same."""
        make: Callable[..., _Parts] = cls
        (common, *_), *columns = zip(*(part._fields for part in parts), strict=True)
        return make(common, *map(np.concatenate, columns))


@dataclass(frozen=True, eq=False)
class PolynomialPieces(PartArrays):
    """Parts of a surface that are polynomials."""

    basis: BernsteinBasis
    # (n,) int64: the corner of the element at which its parameters start, a half-edge of `PatchTable.elements`
    half_edge: IntArray
    # (n, 2, 2), (n, 2) float64: affine maps from a piece's parameters, over the whole domain, to those of the element
    matrices: FloatArray
    offsets: FloatArray
    origins: FloatArray  # (n, 3) float64: points near the pieces, so that small pieces lose no digits
    coefficients: FloatArray  # (n, b, 3) float64: Bernstein coefficients relative to `origins`

    @cached_property
    def monomials(self) -> FloatArray:
        """``(n, b, 3)`` coefficients of monomials in u and v, whose exponents are `BernsteinBasis.indices`."""
        return self.basis.monomials @ self.coefficients

    def runs(self, length: int) -> Iterator[tuple[slice, FloatArray]]:
        """Iterate over runs of at most ``length`` pieces, at least one run, with their coefficients ``(b, 3, n)``.

        With the pieces along the last axis, products and extrema take a fraction of the time.
        """
        for begin in range(0, max(len(self), 1), length):
            run = slice(begin, begin + length)
            yield run, np.ascontiguousarray(self.coefficients[run].transpose(1, 2, 0))

    def box(self) -> tuple[FloatArray, FloatArray]:
        """``(n, 3)`` opposite corners of axis-aligned boxes around the coefficients, and so around the pieces."""
        lower, upper = self.origins.copy(), self.origins.copy()
        for run, columns in self.runs(RUN):
            lower[run] += columns.min(axis=0).T
            upper[run] += columns.max(axis=0).T
        return lower, upper

    def halved(self) -> PolynomialPieces:
        """The four quarters of each piece: the first quarters of all pieces, then the second ones, and so on."""
        places = places_below(self, [child.inverse() for child in self.basis.domain.children])
        coefficients = np.concatenate([half @ self.coefficients for half in self.basis.halves])
        return PolynomialPieces(self.basis, *places, np.tile(self.origins, (4, 1)), coefficients)

    def middles(self) -> tuple[FloatArray, IntArray, FloatArray]:
        """``(n, 3)`` points at the middle of the pieces' domains, and their locations: `half_edge` and parameters."""
        middle = self.basis.domain.centre
        points = self.origins + (self.basis.values(middle[None]) @ self.coefficients)[:, 0]
        return points, self.half_edge, self.matrices @ middle + self.offsets

    def parameters(self, uv: FloatArray) -> FloatArray:
        """``(n, 2)`` parameters in the elements, for one location in each piece, clamped to the domain."""
        return self.basis.domain.clamped((self.matrices @ uv[:, :, None])[:, :, 0] + self.offsets)


@dataclass(frozen=True, eq=False)
class Tips(PartArrays):
    """The surface around extraordinary points with the same irregular patch: three polynomials at every level."""

    patch: IrregularPatch
    # As in `PolynomialPieces`, but from the parameters of the tip
    half_edge: IntArray
    matrices: FloatArray
    offsets: FloatArray
    coordinates: FloatArray  # (t, K, 3) float64: eigen-coefficients; the first is the extraordinary point

    @property
    def points(self) -> FloatArray:
        """``(t, 3)`` extraordinary points."""
        return self.coordinates[:, 0]

    @property
    def bounded_levels(self) -> int:
        """Number of levels that are bounded by Bernstein coefficients, see `TIP_SIZE`."""
        return level_at_size(self.patch, TIP_SIZE)

    @property
    def tangents(self) -> FloatArray:
        """``(t, 2, 3)`` two tangents at the extraordinary points, whose cross product is along the normal."""
        return self.patch.limit_frame @ self.coordinates

    def level(self, level: int) -> PolynomialPieces:
        """The regular pieces of a level: the first children of all tips, then the second ones, and so on."""
        rows, places = level_rows(self.patch, level)[:, :, 1:], places_below(self, level_domains(self.patch, level))
        coefficients = rows.reshape(-1, rows.shape[2]) @ self.coordinates[:, 1:]
        by_child = coefficients.reshape(len(self), *rows.shape[:2], 3).swapaxes(0, 1)
        basis, origins = polynomial_basis(self.patch.scheme).bernstein, np.tile(self.points, (len(rows), 1))
        return PolynomialPieces(basis, *places, origins, by_child.reshape(-1, *by_child.shape[2:]))

    def reach(self, level: int) -> FloatArray:
        """``(t, 3)`` bounds along the axes of the distance from the point to the surface at this and deeper levels."""
        coordinates = np.ascontiguousarray(self.coordinates.transpose(1, 2, 0))
        return times(rest_rows(self.patch), np.abs(times(transition(self.patch, level), coordinates))).max(axis=0).T


_Placed = TypeVar("_Placed", PolynomialPieces, Tips)


def places_below(
    parts: PolynomialPieces | Tips, domains: Sequence[ParameterMap]
) -> tuple[IntArray, FloatArray, FloatArray]:
    """``half_edge``, ``matrices`` and ``offsets`` of the same parts of all parts, one after the other.

    ``domains`` map the parameters of each part of a part to those of the latter.
    """
    return (
        np.tile(parts.half_edge, len(domains)),
        np.concatenate([parts.matrices @ domain.matrix for domain in domains]),
        np.concatenate([parts.matrices @ domain.offset + parts.offsets for domain in domains]),
    )


@dataclass(frozen=True, eq=False)
class SurfacePieces:
    """A whole surface: polynomial pieces, and tips."""

    regular: PolynomialPieces
    tips: tuple[Tips, ...]
    # (n_e, 3) float64: largest absolute coordinates of the control points of each element's patches; zero for holes
    # and other faces of `PatchTable.elements` without corners
    sizes: FloatArray

    def parts(self, level_count: Callable[[Tips], int]) -> list[Callable[[], PolynomialPieces]]:
        """Functions that return the regular pieces, and those of each of the first levels of tips."""
        levels = [partial(tips.level, level) for tips in self.tips for level in range(level_count(tips))]
        return [lambda: self.regular, *levels]

    @classmethod
    def build(
        cls,
        patches: PatchTable,
        control_points: FloatArray,  # (n_v, 3) float64: at each mesh vertex
    ) -> SurfacePieces:
        """Divide all elements. Parts of all patches that have equal one-rings are divided together."""
        refined = patches.refined
        table = patches if refined is None else refined.table
        if refined is not None:
            control_points = refined.matrix @ control_points
        form, sizes = polynomial_basis(table.scheme), np.zeros((len(patches.elements.face_sizes), 3))
        trees = patch_trees(table.scheme, [patch_class.signature for patch_class in table.classes])
        # For each tree, arrays of parts: numbers by which pieces are sorted in the end, in the order of classes and
        # children; places as in `PolynomialPieces`; control points of the one-rings.
        parts: list[tuple[PatchTree, tuple[NDArray, ...]]] = []
        for number, (patch_class, tree) in enumerate(zip(table.classes, trees, strict=True)):
            controls = control_points[patch_class.controls]
            corners = patch_class.corners if refined is None else refined.corners(patch_class)
            np.maximum.at(sizes, patches.elements.face[corners], np.abs(controls).max(axis=1))
            # A patch of the refined cage is a quarter of a whole element of the cage.
            is_quarter = patches.is_whole[patches.elements.face[corners]] & (refined is not None)
            matrices = np.where(is_quarter, 0.5, 1.0)[:, None, None] * np.eye(2)
            order, offsets = np.full(len(corners), float(number)), np.zeros((len(corners), 2))
            parts.append((tree, (order, corners.astype(np.int64), matrices, offsets, controls)))
        empty = [np.empty((0, *shape)) for shape in ((2, 2), (2,), (3,), (len(form.bernstein.indices), 3))]
        regular = [(np.empty(0), PolynomialPieces(form.bernstein, np.empty(0, dtype=np.int64), *empty))]
        tips, child_order = [], 1.0
        while parts:
            children: list[tuple[PatchTree, tuple[NDArray, ...]]] = []
            child_order /= 4
            for group in counted(alike(parts, itemgetter(0)), "Parts of patches"):
                tree, columns = group[0][0], zip(*(arrays for _, arrays in group), strict=True)
                order, half_edge, matrices, offsets, controls = map(np.concatenate, columns)
                domains = tree.domains if tree.piece is None else [tree.piece.domain]
                places = [
                    (half_edge, matrices @ outward.matrix, matrices @ outward.offset + offsets)
                    for outward in (domain.inverse() for domain in domains)
                ]
                if tree.piece is None:
                    for number, ((child, stencils), place) in enumerate(zip(tree.children, places, strict=True)):
                        children.append((child, (order + number * child_order, *place, stencils @ controls)))
                elif tree.piece.patch is not None:
                    coordinates = tree.piece.coordinates @ controls
                    tips.append((order, Tips(tree.piece.patch, *places[0], coordinates)))
                else:
                    origins, rows = controls[:, 0], form.of_controls @ tree.piece.stencils
                    coefficients = rows @ (controls - origins[:, None])
                    regular.append((order, PolynomialPieces(form.bernstein, *places[0], origins, coefficients)))
            parts = children
        joined = [_sorted(group) for group in alike(tips, lambda pair: pair[1].patch)]
        joined.sort(key=lambda pair: pair[0][0])
        all_tips = tuple(_from_nearest_corner(patches, part, part.offsets) for _, part in joined)
        _, pieces = _sorted(regular)
        return cls(_from_nearest_corner(patches, pieces, pieces.middles()[2]), all_tips, sizes)


def _sorted(pairs: Sequence[tuple[FloatArray, _Parts]]) -> tuple[FloatArray, _Parts]:
    """Join parts, and sort them by the numbers that come with them."""
    numbers, parts = zip(*pairs, strict=True)
    order = np.concatenate(numbers)
    sort = np.argsort(order, kind="stable")
    return order[sort], type(parts[0]).joined(parts).chosen(sort)


def alike(parts: Iterable[_Any], key: Callable[[_Any], object]) -> list[list[_Any]]:
    """Group parts by their keys, in the order in which the keys first appear."""
    groups: dict[object, list[_Any]] = {}
    for part in parts:
        groups.setdefault(key(part), []).append(part)
    return list(groups.values())


def _from_nearest_corner(
    patches: PatchTable,
    parts: _Placed,
    near_uv: FloatArray,  # (n, 2) float64: parameters in the element of a point whose nearest corner is chosen
) -> _Placed:
    """Let parameters in whole elements start at the nearest corner, so that they lose no digits there."""
    if patches.refined is not None or not len(parts):
        return parts
    domain, elements = patches.scheme.domain, patches.elements
    half_edge, matrices, offsets = parts.half_edge, parts.matrices.copy(), parts.offsets.copy()
    turns = [domain.rotation(turn).inverse() for turn in range(domain.corner_count)]
    turn = np.argmin([domain.extent(turned(near_uv)) for turned in turns], axis=0)
    turn[~patches.is_whole[elements.face[half_edge]]] = 0
    for number in range(1, domain.corner_count):
        half_edge = np.where(turn >= number, elements.next[half_edge], half_edge)
        at, turned = turn == number, turns[number]
        matrices[at], offsets[at] = turned.matrix @ matrices[at], turned(offsets[at])
    return replace(parts, half_edge=half_edge, matrices=matrices, offsets=offsets)


@dataclass(frozen=True, eq=False)
class ElementBounds:
    """Axis-aligned bounding boxes of the surface over single elements.

    Attributes
    ----------
    element : (e,) int64
        0-based, as for `LimitSurface.evaluate`.
    lower, upper : (e, 3) float64
        Opposite corners of the boxes, in the cage's space.
    """

    element: IntArray
    lower: FloatArray
    upper: FloatArray


def element_bounds(
    pieces: SurfacePieces,
    elements: Topology,  # `PatchTable.elements`
) -> tuple[FloatArray, FloatArray]:
    """Corners ``(n_e, 3)`` of boxes around all elements; inverted and infinite for faces that are no elements."""
    lower, upper = np.full_like(pieces.sizes, np.inf), np.full_like(pieces.sizes, -np.inf)

    def widen(half_edge: IntArray, low: FloatArray, high: FloatArray) -> None:
        element = elements.face[half_edge]
        np.minimum.at(lower, element, low)
        np.maximum.at(upper, element, high)

    def widen_by(part: PolynomialPieces) -> None:
        # HALVINGS of the element, minus those that led to the piece.
        size = np.sqrt(np.abs(np.linalg.det(part.matrices)))
        halvings = np.maximum(HALVINGS - np.rint(-np.log2(size)).astype(np.int64), 0)
        for count in np.unique(halvings).tolist():
            matrix, pieces_of_size = _divided(part.basis, count), part.chosen(np.flatnonzero(halvings == count))
            for run, columns in pieces_of_size.runs(CHUNK):
                divided, origins = times(matrix, columns), pieces_of_size.origins[run]
                widen(pieces_of_size.half_edge[run], origins + divided.min(axis=0).T, origins + divided.max(axis=0).T)

    for part in pieces.parts(lambda tips: tips.bounded_levels):
        widen_by(part())
    for tips in pieces.tips:
        reach = tips.reach(tips.bounded_levels)
        widen(tips.half_edge, tips.points - reach, tips.points + reach)
    rounded = UNITS * UNIT * pieces.sizes
    return lower - rounded, upper + rounded


@lru_cache(maxsize=64)
def _divided(basis: BernsteinBasis, count: int) -> FloatArray:
    """``(c, b)`` matrix from a piece's coefficients to the distinct ones of its parts after ``count`` halvings."""
    matrices: FloatArray = np.eye(len(basis.indices))[None]
    for _ in range(count):
        matrices = np.concatenate([half @ matrices for half in basis.halves])
    # Neighbouring parts share coefficients.
    return np.unique(matrices.reshape(-1, matrices.shape[2]).round(14), axis=0)
