"""The whole surface as polynomials in Bernstein form, for bounds, integrals and searches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..evaluation.irregular_patch import IrregularPatch, level_at_size, level_domains, level_rows, rest_rows
from ..evaluation.patch_tree import PatchTree
from ..evaluation.polynomials import BernsteinBasis, polynomial_basis, times
from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..messages import counted
from ..schemes.domain import FloatArray, ParameterMap
from .patch_table import PatchTable

# Size, relative to the patch, down to which levels around extraordinary points are bounded by Bernstein coefficients.
# The looser bound of the remaining levels is then small beside the element.
TIP_SIZE = 1 / 64
# Pieces per run when computing boxes, whose arrays stay in a processor's cache.
RUN = 1024
Parts = TypeVar("Parts", bound="PartArrays")

# Halvings of an element, here into 8 by 8 parts, before the coefficients of the parts bound it. A box then exceeds the
# tight one by some percent of the deviation of a part from a plane, a 64th of that of the element.
HALVINGS = 3
# Error of evaluation in single precision, in units of the last place of the largest coordinate, and that unit. Seven
# units were measured, around a face of 50 corners.
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

    def chosen(self: Parts, which: NDArray) -> Parts:
        """The parts selected by indices or a mask."""
        make: Callable[..., Parts] = type(self)
        common, *arrays = self._fields
        return make(common, *(array[which] for array in arrays))

    @classmethod
    def joined(cls: type[Parts], parts: Iterable[Parts]) -> Parts:
        """Concatenate parts, at least one, whose first field is the same."""
        make: Callable[..., Parts] = cls
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

    def runs(self, length: int) -> Iterator[tuple[slice, FloatArray]]:
        """Iterate over runs of at most ``length`` pieces, at least one run, with their coefficients ``(b, 3, n)``."""
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
        """Number of levels that are bounded as pieces, see `TIP_SIZE`."""
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
        at_level = np.abs(times(self.patch.basis.block_matrix(level), coordinates))
        return times(rest_rows(self.patch), at_level).max(axis=0).T


def places_below(
    parts: PolynomialPieces | Tips, domains: Sequence[ParameterMap]
) -> tuple[IntArray, FloatArray, FloatArray]:
    """``half_edge``, ``matrices`` and ``offsets`` of parts of all parts; ``domains`` map from their parameters."""
    return (
        np.tile(parts.half_edge, len(domains)),
        np.concatenate([parts.matrices @ domain.matrix for domain in domains]),
        np.concatenate([parts.matrices @ domain.offset + parts.offsets for domain in domains]),
    )


@dataclass(frozen=True, eq=False)
class SurfacePieces:
    """A whole surface: polynomial pieces, and tips."""

    elements: Topology  # `PatchTable.elements`
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
        table, points = patches.evaluated, patches.evaluated_points(control_points)
        form, sizes = polynomial_basis(table.scheme), np.zeros((len(patches.elements.face_sizes), 3))
        regular, tips, known = [], dict[IrregularPatch, list[Tips]](), dict[PatchTree, FloatArray]()
        for patch_class, tree in counted(list(zip(table.classes, table.trees, strict=True)), "Pieces of patch classes"):
            controls, corners = points[table.controls_of(patch_class)], patches.places(patch_class)
            np.maximum.at(sizes, patches.elements.face[corners], np.abs(controls).max(axis=1))
            half_edge, matrices, offsets = _places(patches, corners, tree)
            rows = tree.coefficients(form.of_controls, known)
            count, coefficients = len(rows), rows[:, None] @ (controls - controls[:, :1])
            regular.append(
                PolynomialPieces(
                    form.bernstein,
                    half_edge[:count].ravel(),
                    matrices[:count].reshape(-1, 2, 2),
                    offsets[:count].reshape(-1, 2),
                    np.tile(controls[:, 0], (count, 1)),
                    coefficients.reshape(-1, *coefficients.shape[2:]),
                )
            )
            for number, tip in enumerate(tree.tips, count):
                place = half_edge[number], matrices[number], offsets[number]
                part = Tips(tip.irregular_patch, *place, tip.coordinates @ controls)
                tips.setdefault(part.patch, []).append(part)
        every_tip = tuple(Tips.joined(alike) for alike in tips.values())
        return cls(patches.elements, PolynomialPieces.joined(regular), every_tip, sizes)

    @cached_property
    def element_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Corners ``(n_e, 3)`` of boxes around all elements; inverted and infinite for faces that are no elements."""
        lower, upper = np.full_like(self.sizes, np.inf), np.full_like(self.sizes, -np.inf)

        def widen(half_edge: IntArray, low: FloatArray, high: FloatArray) -> None:
            element = self.elements.face[half_edge]
            np.minimum.at(lower, element, low)
            np.maximum.at(upper, element, high)

        for make_part in self.parts(lambda tips: tips.bounded_levels):
            part = make_part()
            # HALVINGS of the element, minus those that led to the piece.
            size = np.sqrt(np.abs(np.linalg.det(part.matrices)))
            halvings = np.maximum(HALVINGS - np.rint(-np.log2(size)).astype(np.int64), 0)
            for count in np.unique(halvings).tolist():
                matrix, of_size = _divided(part.basis, count), part.chosen(np.flatnonzero(halvings == count))
                for run, columns in of_size.runs(CHUNK):
                    divided, origins = times(matrix, columns), of_size.origins[run]
                    widen(of_size.half_edge[run], origins + divided.min(axis=0).T, origins + divided.max(axis=0).T)
        for tips in self.tips:
            reach = tips.reach(tips.bounded_levels)
            widen(tips.half_edge, tips.points - reach, tips.points + reach)
        rounded = UNITS * UNIT * self.sizes
        return lower - rounded, upper + rounded


def _places(
    patches: PatchTable,
    corners: IndexArray,  # (p,) int32: the corner of the element at which each patch begins
    tree: PatchTree,  # Of the patches
) -> tuple[IntArray, FloatArray, FloatArray]:
    """``half_edge``, ``matrices`` and ``offsets`` of all patches' regular pieces and tips: ``(r + t, p, ...)``.

    In whole elements, parameters start at the corner nearest to the piece, so that they lose no digits there.
    """
    domain, elements = patches.scheme.domain, patches.elements
    (matrices, offsets), of_tips = tree.regular_domains, [tip.domain.inverse() for tip in tree.tips]
    near_uv = np.concatenate([matrices @ domain.centre + offsets, *(of_tip.offset[None] for of_tip in of_tips)])
    matrices = np.concatenate([matrices, *(of_tip.matrix[None] for of_tip in of_tips)])
    offsets = np.concatenate([offsets, near_uv[len(offsets) :]])
    is_whole, half_edge = patches.is_whole[elements.face[corners]], corners[None].astype(np.int64)
    scale, turn = np.ones(len(corners)), np.zeros(len(matrices), dtype=np.int64)
    if patches.refined is not None:
        # A patch of the refined cage is a quarter of a whole element of the cage.
        scale[is_whole] = 0.5
    elif is_whole.all():
        turns = [domain.rotation(turn).inverse() for turn in range(domain.corner_count)]
        turn = np.argmin([domain.extent(turned(near_uv)) for turned in turns], axis=0)
        half_edge = np.stack(elements.around_faces(half_edge[0], domain.corner_count))
        to_corner, starts = (np.array(part)[turn] for part in zip(*turns, strict=True))
        matrices, offsets = to_corner @ matrices, (to_corner @ offsets[:, :, None])[:, :, 0] + starts
    return half_edge[turn], scale[:, None, None] * matrices[:, None], scale[:, None] * offsets[:, None]


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


@lru_cache(maxsize=64)
def _divided(basis: BernsteinBasis, count: int) -> FloatArray:
    """``(c, b)`` matrix from a piece's coefficients to the distinct ones of its parts after ``count`` halvings."""
    matrices: FloatArray = np.eye(len(basis.indices))[None]
    for _ in range(count):
        matrices = np.concatenate([half @ matrices for half in basis.halves])
    # Neighbouring parts share coefficients.
    return np.unique(matrices.reshape(-1, matrices.shape[2]).round(14), axis=0)
