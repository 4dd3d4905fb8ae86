"""The whole surface as polynomials in Bernstein form, for bounds, integrals and searches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache, partial
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..evaluation.irregular_patch import IrregularPatch, level_at_size, level_domains, level_rows, rest_rows, transition
from ..evaluation.patch_tree import PatchTree, patch_trees
from ..evaluation.polynomials import BernsteinBasis, regular_bernstein, times
from ..mesh.connectivity import IntArray, Topology
from ..progress import counted
from ..schemes.domain import IDENTITY, AffineMap, FloatArray
from ..schemes.scheme import Scheme
from .patch_table import PatchTable

# Size, relative to the patch, down to which levels around extraordinary points are bounded by Bernstein coefficients,
# as they shrink by the second eigenvalue. The looser bound of the remaining levels is then small beside the element.
TIP_SIZE = 1 / 64
# Pieces per run when computing boxes, whose arrays stay in a processor's cache.
RUN = 1024
# Elements of more than MOST_PIECES pieces, along semi-sharp creases, are at first divided only DIVISIONS times.
MOST_PIECES, DIVISIONS = 64, 3

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
        maps = [child.inverse() for child in self.basis.domain.children]
        return PolynomialPieces(
            self.basis,
            np.tile(self.half_edge, 4),
            np.concatenate([self.matrices @ from_child.matrix for from_child in maps]),
            np.concatenate([self.matrices @ from_child.offset + self.offsets for from_child in maps]),
            np.tile(self.origins, (4, 1)),
            np.concatenate([half @ self.coefficients for half in self.basis.halves]),
        )

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
        rows, maps = level_rows(self.patch, level)[:, :, 1:], level_domains(self.patch, level)
        coefficients = rows.reshape(-1, rows.shape[2]) @ self.coordinates[:, 1:]
        by_child = coefficients.reshape(len(self), *rows.shape[:2], 3).swapaxes(0, 1)
        return PolynomialPieces(
            regular_bernstein(self.patch.scheme).basis,
            np.tile(self.half_edge, len(rows)),
            np.concatenate([self.matrices @ from_child.matrix for from_child in maps]),
            np.concatenate([self.matrices @ from_child.offset + self.offsets for from_child in maps]),
            np.tile(self.points, (len(rows), 1)),
            by_child.reshape(-1, *by_child.shape[2:]),
        )

    def reach(self, level: int) -> FloatArray:
        """``(t, 3)`` bounds along the axes of the distance from the point to the surface at this and deeper levels."""
        coordinates = np.ascontiguousarray(self.coordinates.transpose(1, 2, 0))
        return times(rest_rows(self.patch), np.abs(times(transition(self.patch, level), coordinates))).max(axis=0).T


@dataclass(frozen=True, eq=False)
class ElementParts(PartArrays):
    """Parts of a surface with the same patch tree, not yet divided."""

    element: PatchTree
    # As in `PolynomialPieces`, but from the parameters of the part
    half_edge: IntArray
    matrices: FloatArray
    offsets: FloatArray
    # (n, K, 3) float64: control points of the one-rings. Under convex rules, a part lies within their convex hull.
    controls: FloatArray

    def box(self) -> tuple[FloatArray, FloatArray]:
        """``(n, 3)`` opposite corners of axis-aligned boxes around the control points."""
        return self.controls.min(axis=1), self.controls.max(axis=1)

    def children(self) -> list[PolynomialPieces | Tips | ElementParts]:
        """Children of the parts: an entry for the first children of all parts, one for the second, and so on."""
        children: list[PolynomialPieces | Tips | ElementParts] = []
        for domain, (child, stencils) in zip(self.element.domains, self.element.children, strict=True):
            outward, controls = domain.inverse(), stencils @ self.controls
            if child.piece is not None:
                outward = outward @ child.piece.domain.inverse()
            place = self.half_edge, self.matrices @ outward.matrix, self.matrices @ outward.offset + self.offsets
            if child.piece is None:
                children.append(ElementParts(child, *place, controls))
            elif child.piece.patch is not None:
                children.append(Tips(child.piece.patch, *place, child.piece.coordinates @ controls))
            else:
                form = regular_bernstein(child.scheme)
                origins, rows = controls[:, 0], form.of_controls @ child.piece.stencils
                relative = controls - origins[:, None]
                children.append(PolynomialPieces(form.basis, *place, origins, rows @ relative))
        return children


@dataclass(frozen=True, eq=False)
class SurfacePieces:
    """A whole surface: polynomial pieces, tips and undivided parts."""

    scheme: Scheme
    regular: PolynomialPieces
    tips: tuple[Tips, ...]
    undivided: tuple[ElementParts, ...]  # Parts along semi-sharp creases that would have very many pieces
    # (n_e, 3) float64: largest absolute coordinates of the control points of each element's patches; zero for holes
    # and other faces of `PatchTable.elements` without corners
    sizes: FloatArray

    @classmethod
    def build(
        cls,
        patches: PatchTable,
        control_points: FloatArray,  # (n_v, 3) float64: at each mesh vertex
    ) -> SurfacePieces:
        """Divide all elements into pieces; elements of more than `MOST_PIECES` pieces only `DIVISIONS` times."""
        refined = patches.refined
        table = patches if refined is None else refined.table
        if refined is not None:
            control_points = refined.matrix @ control_points
        form = regular_bernstein(table.scheme)
        empty = [np.empty((0, *shape)) for shape in ((2, 2), (2,), (3,), (len(form.basis.indices), 3))]
        regular, tips, undivided = [PolynomialPieces(form.basis, np.empty(0, dtype=np.int64), *empty)], [], []
        sizes = np.zeros((len(patches.elements.face_sizes), 3))
        elements = patch_trees(table.scheme, [patch_class.signature for patch_class in table.classes])
        known: dict[PatchTree, FloatArray] = {}
        pairs = zip(table.classes, elements, strict=True)
        for patch_class, whole in counted(list(pairs), "Pieces of patch classes"):
            controls = control_points[patch_class.controls]
            corners = patch_class.corners if refined is None else refined.corners(patch_class)
            np.maximum.at(sizes, patches.elements.face[corners], np.abs(controls).max(axis=1))
            place_of = partial(_seen, patches, corners)
            waiting = [(whole, IDENTITY, controls, 0)]
            while waiting:
                element, outward, controls, depth = waiting.pop()
                if element.regular_count > MOST_PIECES and depth == DIVISIONS:
                    place = place_of(outward, outward(form.basis.domain.centre))
                    undivided.append(ElementParts(element, *place, controls))
                    continue
                if element.regular_count > MOST_PIECES:
                    for domain, (child, stencils) in zip(element.domains, element.children, strict=True):
                        waiting.append((child, outward @ domain.inverse(), stencils @ controls, depth + 1))
                    continue
                origins = controls[:, 0]
                relative = controls - origins[:, None]
                rows = element.coefficients(form.of_controls, known=known)
                for piece_rows, *piece_domain in zip(rows, *element.regular_domains, strict=True):
                    domain = outward @ AffineMap(*piece_domain)
                    place = place_of(domain, domain(form.basis.domain.centre))
                    regular.append(PolynomialPieces(form.basis, *place, origins, piece_rows @ relative))
                for tip in element.tips:
                    domain = outward @ tip.domain.inverse()
                    place = place_of(domain, domain.offset)
                    tips.append(Tips(tip.irregular_patch, *place, tip.coordinates @ controls))
        return cls(
            table.scheme,
            PolynomialPieces.joined(regular),
            tuple(map(Tips.joined, alike(tips, attrgetter("patch")))),
            tuple(map(ElementParts.joined, alike(undivided, attrgetter("element")))),
            sizes,
        )

    def divided(self) -> SurfacePieces:
        """The same surface without undivided parts."""
        if not self.undivided:
            return self
        regular, tips, undivided = [self.regular], [*self.tips], [*self.undivided]
        while undivided:
            children = [child for parts in undivided for child in parts.children()]
            regular += [child for child in children if isinstance(child, PolynomialPieces)]
            tips += [child for child in children if isinstance(child, Tips)]
            element_parts = [child for child in children if isinstance(child, ElementParts)]
            undivided = [ElementParts.joined(parts) for parts in alike(element_parts, attrgetter("element"))]
        all_tips = tuple(map(Tips.joined, alike(tips, attrgetter("patch"))))
        return SurfacePieces(self.scheme, PolynomialPieces.joined(regular), all_tips, (), self.sizes)


def alike(parts: Iterable[_Any], key: Callable[[_Any], object]) -> list[list[_Any]]:
    """Group parts by their keys, in the order in which the keys first appear."""
    groups: dict[object, list[_Any]] = {}
    for part in parts:
        groups.setdefault(key(part), []).append(part)
    return list(groups.values())


def _seen(
    patches: PatchTable,
    corners: IntArray,  # (p,) int: corners of elements at which the patches begin
    domain: AffineMap,  # From the part's parameters to the patch's
    near_uv: FloatArray,  # (2,) float64: parameters in the patch of a point whose nearest corner is chosen
) -> tuple[IntArray, FloatArray, FloatArray]:
    """`half_edge`, `matrices` and `offsets` of the same part of all patches of a class.

    In a whole element, parameters start at the nearest corner, so that they lose no digits there.
    """
    half_edge, shape = corners, patches.scheme.domain
    is_whole = patches.is_whole[patches.elements.face[corners]]
    # A patch of the refined cage is a quarter of a whole element of the cage.
    scale = np.where(is_whole, 0.5, 1.0) if patches.refined is not None else np.ones(len(corners))
    if patches.refined is None and is_whole.all():
        extents = [shape.extent(shape.rotation(turn).inverse()(near_uv)) for turn in range(shape.corner_count)]
        turn = int(np.argmin(extents))
        domain = shape.rotation(turn).inverse() @ domain
        for _ in range(turn):
            half_edge = patches.elements.next[half_edge]
    return half_edge.astype(np.int64), scale[:, None, None] * domain.matrix, scale[:, None] * domain.offset


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

    widen_by(pieces.regular)
    for tips in pieces.tips:
        for level in range(tips.bounded_levels):
            widen_by(tips.level(level))
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
