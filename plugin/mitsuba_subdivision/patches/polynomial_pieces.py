"""The surface over all elements as polynomials in Bernstein form: for bounds, integrals and searches over all of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..evaluation.bernstein import BernsteinBasis, regular_bernstein, times
from ..evaluation.divided_element import divided_elements
from ..evaluation.irregular_patch import (
    IrregularPatch,
    level_at_size,
    level_domains,
    level_rows,
    rest_rows,
    transition,
)
from ..mesh.connectivity import IntArray
from ..progress import counted
from ..schemes.domain import AffineMap, FloatArray, ParameterDomain
from .patch_table import PatchTable

# Levels around extraordinary points are bounded by their coefficients until the second eigenvalue has shrunk them to
# this, in sizes of the patch. The bound of the rest allows weights of any sign, which is then small beside the element.
TIP_SIZE = 1 / 64
# Boxes are found in runs of this many pieces, whose arrays stay in a processor's cache.
RUN = 1024


@dataclass(frozen=True, eq=False)
class PolynomialPieces:
    """Parts of a surface that are polynomials.

    Attributes
    ----------
    basis : BernsteinBasis
    start : (n,) int64
        The corner of an element that parameters are counted from, a half-edge of `PatchTable.elements`.
    matrices, offsets : (n, 2, 2), (n, 2) float64
        From a piece's own parameters, over the whole domain, to those of the element.
    origins : (n, 3) float64
        Points near the pieces, so that small ones lose no digits.
    coefficients : (n, b, 3) float64
        Relative to these.
    """

    basis: BernsteinBasis
    start: IntArray
    matrices: FloatArray
    offsets: FloatArray
    origins: FloatArray
    coefficients: FloatArray

    def __len__(self) -> int:
        return len(self.start)

    @cached_property
    def monomials(self) -> FloatArray:
        """``(n, b, 3)`` coefficients of products of powers of u and v; the powers are the basis's `indices`."""
        return self.basis.monomials @ self.coefficients

    def chosen(self, which: NDArray) -> PolynomialPieces:
        """Some of the pieces, by their numbers or a mask."""
        return PolynomialPieces(self.basis, *(each[which] for each in self._arrays))

    @property
    def _arrays(self) -> tuple[NDArray, ...]:
        return self.start, self.matrices, self.offsets, self.origins, self.coefficients

    def runs(self, length: int) -> Iterator[tuple[slice, FloatArray]]:
        """Runs of pieces, at least one, and their coefficients ``(b, 3, n)``.

        With the pieces along the last axis, products and extremes take a fraction of the time.
        """
        for begin in range(0, max(len(self), 1), length):
            at = slice(begin, begin + length)
            yield at, np.ascontiguousarray(self.coefficients[at].transpose(1, 2, 0))

    def box(self) -> tuple[FloatArray, FloatArray]:
        """``(n, 3)`` opposite corners of boxes around the coefficients, and so around the pieces."""
        lower, upper = self.origins.copy(), self.origins.copy()
        for at, columns in self.runs(RUN):
            lower[at] += columns.min(axis=0).T
            upper[at] += columns.max(axis=0).T
        return lower, upper

    @classmethod
    def joined(cls, parts: Iterable[PolynomialPieces]) -> PolynomialPieces:
        """Pieces one after the other; at least one part."""
        parts = list(parts)
        columns = zip(*(part._arrays for part in parts), strict=True)
        return cls(parts[0].basis, *(np.concatenate(column) for column in columns))

    def halved(self) -> PolynomialPieces:
        """The four copies of each piece at half the size, all first ones before all second ones and so on."""
        maps = [child.inverse() for child in self.basis.domain.children]
        return PolynomialPieces(
            self.basis,
            np.tile(self.start, 4),
            np.concatenate([self.matrices @ each.matrix for each in maps]),
            np.concatenate([self.matrices @ each.offset + self.offsets for each in maps]),
            np.tile(self.origins, (4, 1)),
            np.concatenate([half @ self.coefficients for half in self.basis.halves]),
        )

    def middles(self) -> tuple[FloatArray, IntArray, FloatArray]:
        """``(n, 3)`` points in the middle of each piece's domain, and where they are: `start` and parameters."""
        middle = self.basis.domain.centre
        points = self.origins + (self.basis.values(middle[None]) @ self.coefficients)[:, 0]
        return points, self.start, self.matrices @ middle + self.offsets

    def parameters(self, uv: FloatArray) -> FloatArray:
        """``(n, 2)`` parameters of elements at one place of each piece, in the domain."""
        return self.basis.domain.clamped((self.matrices @ uv[:, :, None])[:, :, 0] + self.offsets)


@dataclass(frozen=True, eq=False)
class Tips:
    """The surface around extraordinary points of the same patch: at every level, three polynomials.

    Attributes
    ----------
    patch : IrregularPatch
    start, matrices, offsets
        As in `PolynomialPieces`, from the tip's parameters.
    coordinates : (t, K, 3) float64
        Eigen-coordinates; the first is the extraordinary point.
    """

    patch: IrregularPatch
    start: IntArray
    matrices: FloatArray
    offsets: FloatArray
    coordinates: FloatArray

    def __len__(self) -> int:
        return len(self.start)

    @property
    def points(self) -> FloatArray:
        """``(t, 3)`` extraordinary points."""
        return self.coordinates[:, 0]

    @property
    def bounded_levels(self) -> int:
        """How many levels are bounded by their coefficients."""
        return level_at_size(self.patch, TIP_SIZE)

    @property
    def tangents(self) -> FloatArray:
        """``(t, 2, 3)`` two tangents at the points, whose cross product is along the normal."""
        return self.patch.limit_frame @ self.coordinates

    def chosen(self, which: NDArray) -> Tips:
        """Some of the tips, by their numbers or a mask."""
        return Tips(self.patch, self.start[which], self.matrices[which], self.offsets[which], self.coordinates[which])

    def level(self, level: int) -> PolynomialPieces:
        """The regular pieces of a level: first those of all first children, and so on."""
        rows, maps = level_rows(self.patch, level)[:, :, 1:], level_domains(self.patch, level)
        coefficients = rows.reshape(-1, rows.shape[2]) @ self.coordinates[:, 1:]
        of_children = coefficients.reshape(len(self), *rows.shape[:2], 3).swapaxes(0, 1)
        return PolynomialPieces(
            regular_bernstein(self.patch.scheme).basis,
            np.tile(self.start, len(rows)),
            np.concatenate([self.matrices @ each.matrix for each in maps]),
            np.concatenate([self.matrices @ each.offset + self.offsets for each in maps]),
            np.tile(self.points, (len(rows), 1)),
            of_children.reshape(-1, *of_children.shape[2:]),
        )

    def reach(self, level: int) -> FloatArray:
        """``(t, 3)`` how far from the point the surface is at a level and all later ones, at most."""
        coordinates = np.ascontiguousarray(self.coordinates.transpose(1, 2, 0))
        return times(rest_rows(self.patch), np.abs(times(transition(self.patch, level), coordinates))).max(axis=0).T


@dataclass(frozen=True, eq=False)
class SurfacePieces:
    """A whole surface.

    Attributes
    ----------
    regular : PolynomialPieces
    tips : tuple of Tips
        The rest.
    sizes : (n_e, 3) float64
        Largest absolute coordinates of the control points of each element's patches; zero where there is no element.
    """

    regular: PolynomialPieces
    tips: tuple[Tips, ...]
    sizes: FloatArray

    @classmethod
    def build(cls, patches: PatchTable, control_points: FloatArray) -> SurfacePieces:
        """Divide all elements.

        Parameters
        ----------
        patches : PatchTable
        control_points : (n_v, 3) float64
            At each mesh vertex.

        Raises
        ------
        SchemeError
            As `divided_elements`.
        """
        refined = patches.refined
        table = patches if refined is None else refined.table
        if refined is not None:
            control_points = refined.matrix @ control_points
        form = regular_bernstein(table.scheme)
        basis = form.basis
        regular: list[PolynomialPieces] = []
        tips: dict[IrregularPatch, list[Tips]] = {}
        sizes = np.zeros((len(patches.elements.face_sizes), 3))
        elements = divided_elements(table.scheme, [each.signature for each in table.classes])
        pairs = zip(table.classes, elements, strict=True)
        for patch_class, divided in counted(list(pairs), "Pieces of patch classes"):
            controls = control_points[patch_class.controls]
            corners = patch_class.corners if refined is None else refined.corners(patch_class)
            element, origins = patches.elements.face_of(corners), controls[:, 0]
            np.maximum.at(sizes, element, np.abs(controls).max(axis=1))
            places = _Places(patches, corners, refined is not None)
            relative, rows = controls - origins[:, None], divided.coefficients(form.of_controls)
            for own_rows, *outward in zip(rows, *divided.regular_domains, strict=True):
                domain = AffineMap(*outward)
                place = places.seen(domain, domain(basis.domain.centre))
                regular.append(PolynomialPieces(basis, *place, origins, own_rows @ relative))
            for tip in divided.tips:
                domain = tip.domain.inverse()
                place = places.seen(domain, domain.offset)
                found = Tips(tip.irregular_patch, *place, tip.coordinates @ controls)
                tips.setdefault(found.patch, []).append(found)
        empty = [np.empty((0, *shape)) for shape in ((2, 2), (2,), (3,), (len(basis.indices), 3))]
        none = PolynomialPieces(basis, np.empty(0, dtype=np.int64), *empty)
        joined = tuple(_joined_tips(each) for each in tips.values())
        return cls(PolynomialPieces.joined([none, *regular]), joined, sizes)


class _Places:
    """Where the patches of a class lie in their elements.

    A piece of a whole element is seen from the corner that it is nearest to, so that parameters lose no digits there.
    """

    def __init__(self, patches: PatchTable, corners: IntArray, is_refined: bool) -> None:
        self._elements, self._domain = patches.elements, patches.scheme.domain
        self._corners = corners
        is_whole = patches.is_whole[patches.elements.face_of(corners)]
        # A patch of the refined cage is a quarter of a whole element of the cage.
        self._scale = np.where(is_whole, 0.5, 1.0) if is_refined else np.ones(len(corners))
        self._may_turn = not is_refined and bool(is_whole.all())

    def seen(self, domain: AffineMap, place: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """`start`, `matrices` and `offsets` of a piece of each patch, about a place in the patch's parameters."""
        start, turn = self._corners, 0
        if self._may_turn:
            turn = _nearest_corner(self._domain, place)
            domain = self._domain.rotation(turn).inverse() @ domain
        for _ in range(turn):
            start = self._elements.following(start)
        scale = self._scale[:, None]
        return start.astype(np.int64), scale[:, :, None] * domain.matrix, scale * domain.offset


def _nearest_corner(domain: ParameterDomain, place: FloatArray) -> int:
    """The corner of a domain that a place is nearest to, in parameters seen from there."""
    extents = [domain.extent(domain.rotation(turn).inverse()(place)) for turn in range(domain.corner_count)]
    return int(np.argmin(extents))


def _joined_tips(parts: list[Tips]) -> Tips:
    columns = zip(*((each.start, each.matrices, each.offsets, each.coordinates) for each in parts), strict=True)
    return Tips(parts[0].patch, *(np.concatenate(column) for column in columns))
