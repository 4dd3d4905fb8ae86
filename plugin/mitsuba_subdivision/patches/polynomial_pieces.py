"""The surface over all elements as polynomials in Bernstein form: for bounds, integrals and searches over all of it."""

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

# Levels around extraordinary points are bounded by their coefficients until the second eigenvalue has shrunk them to
# this, in sizes of the patch. The bound of the rest allows weights of any sign, which is then small beside the element.
TIP_SIZE = 1 / 64
# Boxes are found in runs of this many pieces, whose arrays stay in a processor's cache.
RUN = 1024
# Elements of more pieces, which are those along semi-sharp creases, are at first divided only so often.
MOST_PIECES, DIVISIONS = 64, 3

_Any = TypeVar("_Any")
_Parts = TypeVar("_Parts", bound="PartArrays")

# Every element is divided this often, so into 8 by 8 parts, before the coefficients of the parts bound it. A box is
# then larger than the tight one by some percent of the bend of a part, which is a 64th of the element's.
HALVINGS = 3
# Single precision rounds control points, and sums relative to one of them: so many units of the last place of the
# largest coordinate. The most that was measured are seven, around a face of 50 corners.
UNITS, UNIT = 16, 2.0**-24
# Pieces are divided in runs of this many, which bounds temporary memory to some megabytes.
CHUNK = 128


class PartArrays:
    """Parts of a surface as a dataclass: first what they have in common, then arrays with a row for each."""

    @property
    def _fields(self) -> tuple[Any, ...]:
        return tuple(getattr(self, each.name) for each in fields(self))  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self._fields[1])

    def chosen(self: _Parts, which: NDArray) -> _Parts:
        """Some of the parts, by their numbers or a mask."""
        make: Callable[..., _Parts] = type(self)
        common, *arrays = self._fields
        return make(common, *(each[which] for each in arrays))

    @classmethod
    def joined(cls: type[_Parts], parts: Iterable[_Parts]) -> _Parts:
        """Parts that have the same in common, one after the other; at least one."""
        make: Callable[..., _Parts] = cls
        (common, *_), *columns = zip(*(part._fields for part in parts), strict=True)
        return make(common, *map(np.concatenate, columns))


@dataclass(frozen=True, eq=False)
class PolynomialPieces(PartArrays):
    """Parts of a surface that are polynomials."""

    basis: BernsteinBasis
    # (n,) int64: the corner of an element where parameters begin, a half-edge of `PatchTable.elements`
    half_edge: IntArray
    # (n, 2, 2), (n, 2) float64: from a piece's own parameters, over the whole domain, to those of the element
    matrices: FloatArray
    offsets: FloatArray
    origins: FloatArray  # (n, 3) float64: points near the pieces, so that small ones lose no digits
    coefficients: FloatArray  # (n, b, 3) float64: relative to these

    @cached_property
    def monomials(self) -> FloatArray:
        """``(n, b, 3)`` coefficients of products of powers of u and v; the powers are the basis's `indices`."""
        return self.basis.monomials @ self.coefficients

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

    def halved(self) -> PolynomialPieces:
        """The four copies of each piece at half the size, all first ones before all second ones and so on."""
        maps = [child.inverse() for child in self.basis.domain.children]
        return PolynomialPieces(
            self.basis,
            np.tile(self.half_edge, 4),
            np.concatenate([self.matrices @ each.matrix for each in maps]),
            np.concatenate([self.matrices @ each.offset + self.offsets for each in maps]),
            np.tile(self.origins, (4, 1)),
            np.concatenate([half @ self.coefficients for half in self.basis.halves]),
        )

    def middles(self) -> tuple[FloatArray, IntArray, FloatArray]:
        """``(n, 3)`` points in the middle of each piece's domain, and their locations: `half_edge` and parameters."""
        middle = self.basis.domain.centre
        points = self.origins + (self.basis.values(middle[None]) @ self.coefficients)[:, 0]
        return points, self.half_edge, self.matrices @ middle + self.offsets

    def parameters(self, uv: FloatArray) -> FloatArray:
        """``(n, 2)`` parameters of elements at one location in each piece, in the domain."""
        return self.basis.domain.clamped((self.matrices @ uv[:, :, None])[:, :, 0] + self.offsets)


@dataclass(frozen=True, eq=False)
class Tips(PartArrays):
    """The surface around extraordinary points of the same patch: at every level, three polynomials."""

    patch: IrregularPatch
    # As in `PolynomialPieces`, from the tip's parameters
    half_edge: IntArray
    matrices: FloatArray
    offsets: FloatArray
    coordinates: FloatArray  # (t, K, 3) float64: eigen-coordinates; the first is the extraordinary point

    @property
    def points(self) -> FloatArray:
        """``(t, 3)`` extraordinary points."""
        return self.coordinates[:, 0]

    @property
    def bounded_levels(self) -> int:
        """Number of levels that are bounded by their coefficients."""
        return level_at_size(self.patch, TIP_SIZE)

    @property
    def tangents(self) -> FloatArray:
        """``(t, 2, 3)`` two tangents at the points, whose cross product is along the normal."""
        return self.patch.limit_frame @ self.coordinates

    def level(self, level: int) -> PolynomialPieces:
        """The regular pieces of a level: first those of all first children, and so on."""
        rows, maps = level_rows(self.patch, level)[:, :, 1:], level_domains(self.patch, level)
        coefficients = rows.reshape(-1, rows.shape[2]) @ self.coordinates[:, 1:]
        of_children = coefficients.reshape(len(self), *rows.shape[:2], 3).swapaxes(0, 1)
        return PolynomialPieces(
            regular_bernstein(self.patch.scheme).basis,
            np.tile(self.half_edge, len(rows)),
            np.concatenate([self.matrices @ each.matrix for each in maps]),
            np.concatenate([self.matrices @ each.offset + self.offsets for each in maps]),
            np.tile(self.points, (len(rows), 1)),
            of_children.reshape(-1, *of_children.shape[2:]),
        )

    def reach(self, level: int) -> FloatArray:
        """``(t, 3)`` bound of the distance from the point to the surface at a level and all later ones."""
        coordinates = np.ascontiguousarray(self.coordinates.transpose(1, 2, 0))
        return times(rest_rows(self.patch), np.abs(times(transition(self.patch, level), coordinates))).max(axis=0).T


@dataclass(frozen=True, eq=False)
class ElementParts(PartArrays):
    """Parts of a surface that are divided alike, not yet divided."""

    element: PatchTree
    # As in `PolynomialPieces`, from the part's parameters
    half_edge: IntArray
    matrices: FloatArray
    offsets: FloatArray
    # (n, K, 3) float64: control points of their one-rings. Where rules are convex, the parts lie within the hull of
    # these.
    controls: FloatArray

    def box(self) -> tuple[FloatArray, FloatArray]:
        """``(n, 3)`` opposite corners of boxes around the control points."""
        return self.controls.min(axis=1), self.controls.max(axis=1)

    def children(self) -> list[PolynomialPieces | Tips | ElementParts]:
        """Children of the parts: one child of all of them, the next of all, and so on."""
        found: list[PolynomialPieces | Tips | ElementParts] = []
        for domain, (child, stencils) in zip(self.element.domains, self.element.children, strict=True):
            outward, controls = domain.inverse(), stencils @ self.controls
            if child.piece is not None:
                outward = outward @ child.piece.domain.inverse()
            place = self.half_edge, self.matrices @ outward.matrix, self.matrices @ outward.offset + self.offsets
            if child.piece is None:
                found.append(ElementParts(child, *place, controls))
            elif child.piece.patch is not None:
                found.append(Tips(child.piece.patch, *place, child.piece.coordinates @ controls))
            else:
                form = regular_bernstein(child.scheme)
                origins, rows = controls[:, 0], form.of_controls @ child.piece.stencils
                relative = controls - origins[:, None]
                found.append(PolynomialPieces(form.basis, *place, origins, rows @ relative))
        return found


@dataclass(frozen=True, eq=False)
class SurfacePieces:
    """A whole surface."""

    scheme: Scheme
    regular: PolynomialPieces
    tips: tuple[Tips, ...]
    undivided: tuple[ElementParts, ...]  # The rest: parts along semi-sharp creases that have very many pieces
    # (n_e, 3) float64: largest absolute coordinates of the control points of each element's patches; zero where there
    # is no element
    sizes: FloatArray

    @classmethod
    def build(
        cls,
        patches: PatchTable,
        control_points: FloatArray,  # (n_v, 3) float64: at each mesh vertex
    ) -> SurfacePieces:
        """Divide all elements; those of very many pieces a few times only."""
        refined = patches.refined
        table = patches if refined is None else refined.table
        if refined is not None:
            control_points = refined.matrix @ control_points
        form = regular_bernstein(table.scheme)
        empty = [np.empty((0, *shape)) for shape in ((2, 2), (2,), (3,), (len(form.basis.indices), 3))]
        regular, tips, undivided = [PolynomialPieces(form.basis, np.empty(0, dtype=np.int64), *empty)], [], []
        sizes = np.zeros((len(patches.elements.face_sizes), 3))
        elements = patch_trees(table.scheme, [each.signature for each in table.classes])
        known: dict[PatchTree, FloatArray] = {}
        pairs = zip(table.classes, elements, strict=True)
        for patch_class, whole in counted(list(pairs), "Pieces of patch classes"):
            controls = control_points[patch_class.controls]
            corners = patch_class.corners if refined is None else refined.corners(patch_class)
            np.maximum.at(sizes, patches.elements.face[corners], np.abs(controls).max(axis=1))
            seen = partial(_seen, patches, corners)
            waiting = [(whole, IDENTITY, controls, 0)]
            while waiting:
                element, outward, controls, depth = waiting.pop()
                if element.regular_count > MOST_PIECES and depth == DIVISIONS:
                    undivided.append(ElementParts(element, *seen(outward, outward(form.basis.domain.centre)), controls))
                    continue
                if element.regular_count > MOST_PIECES:
                    for domain, (child, stencils) in zip(element.domains, element.children, strict=True):
                        waiting.append((child, outward @ domain.inverse(), stencils @ controls, depth + 1))
                    continue
                origins = controls[:, 0]
                relative = controls - origins[:, None]
                rows = element.coefficients(form.of_controls, known=known)
                for own_rows, *inner in zip(rows, *element.regular_domains, strict=True):
                    domain = outward @ AffineMap(*inner)
                    place = seen(domain, domain(form.basis.domain.centre))
                    regular.append(PolynomialPieces(form.basis, *place, origins, own_rows @ relative))
                for tip in element.tips:
                    domain = outward @ tip.domain.inverse()
                    place = seen(domain, domain.offset)
                    tips.append(Tips(tip.irregular_patch, *place, tip.coordinates @ controls))
        return cls(
            table.scheme,
            PolynomialPieces.joined(regular),
            tuple(map(Tips.joined, alike(tips, attrgetter("patch")))),
            tuple(map(ElementParts.joined, alike(undivided, attrgetter("element")))),
            sizes,
        )

    def divided(self) -> SurfacePieces:
        """The same surface without anything undivided."""
        if not self.undivided:
            return self
        regular, tips, undivided = [self.regular], [*self.tips], [*self.undivided]
        while undivided:
            children = [child for parts in undivided for child in parts.children()]
            regular += [each for each in children if isinstance(each, PolynomialPieces)]
            tips += [each for each in children if isinstance(each, Tips)]
            of_elements = [each for each in children if isinstance(each, ElementParts)]
            undivided = [ElementParts.joined(each) for each in alike(of_elements, attrgetter("element"))]
        all_tips = tuple(map(Tips.joined, alike(tips, attrgetter("patch"))))
        return SurfacePieces(self.scheme, PolynomialPieces.joined(regular), all_tips, (), self.sizes)


def alike(parts: Iterable[_Any], key: Callable[[_Any], object]) -> list[list[_Any]]:
    """Lists of parts that have equal keys, in the order of the first ones."""
    found: dict[object, list[_Any]] = {}
    for each in parts:
        found.setdefault(key(each), []).append(each)
    return list(found.values())


def _seen(
    patches: PatchTable,
    corners: IntArray,  # (p,) int: corners of elements where the patches begin
    domain: AffineMap,  # From the part's parameters to the patch's
    near: FloatArray,  # (2,) float64: parameters of the patch to which the corner shall be near
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Of a part of each patch of a class, `half_edge`, `matrices` and `offsets` in its element.

    A part of a whole element is seen from the corner that is nearest, so that parameters lose no digits there.
    """
    half_edge, shape = corners, patches.scheme.domain
    is_whole = patches.is_whole[patches.elements.face[corners]]
    # A patch of the refined cage is a quarter of a whole element of the cage.
    scale = np.where(is_whole, 0.5, 1.0) if patches.refined is not None else np.ones(len(corners))
    if patches.refined is None and is_whole.all():
        extents = [shape.extent(shape.rotation(turn).inverse()(near)) for turn in range(shape.corner_count)]
        turn = int(np.argmin(extents))
        domain = shape.rotation(turn).inverse() @ domain
        for _ in range(turn):
            half_edge = patches.elements.next[half_edge]
    return half_edge.astype(np.int64), scale[:, None, None] * domain.matrix, scale[:, None] * domain.offset


@dataclass(frozen=True, eq=False)
class ElementBounds:
    """Boxes with sides along the axes, each around the surface over one element.

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
    """Corners ``(n_e, 3)`` of boxes around all elements; inverted and infinite where there is no element."""
    lower, upper = np.full_like(pieces.sizes, np.inf), np.full_like(pieces.sizes, -np.inf)

    def widen(half_edge: IntArray, low: FloatArray, high: FloatArray) -> None:
        element = elements.face[half_edge]
        np.minimum.at(lower, element, low)
        np.maximum.at(upper, element, high)

    def widen_by(part: PolynomialPieces) -> None:
        # Less the halvings of the element that have made each piece.
        size = np.sqrt(np.abs(np.linalg.det(part.matrices)))
        halvings = np.maximum(HALVINGS - np.rint(-np.log2(size)).astype(np.int64), 0)
        for count in np.unique(halvings).tolist():
            which = np.flatnonzero(halvings == count)
            divide, chosen = _divided(part.basis, count), part.chosen(which)
            for at, columns in chosen.runs(CHUNK):
                divided, origins = times(divide, columns), chosen.origins[at]
                widen(chosen.half_edge[at], origins + divided.min(axis=0).T, origins + divided.max(axis=0).T)

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
    """``(c, b)`` map from coefficients to all different ones of the parts after so many halvings."""
    found: FloatArray = np.eye(len(basis.indices))[None]
    for _ in range(count):
        found = np.concatenate([half @ found for half in basis.halves])
    # Neighbouring parts share coefficients.
    return np.unique(found.reshape(-1, found.shape[2]).round(14), axis=0)
