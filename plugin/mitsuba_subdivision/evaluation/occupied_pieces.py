"""Divide elements into pieces, but only where there are samples.

Words, in this module and in `patch_pieces`:

- A *child* is what one refinement makes of an element: one of four copies of its domain, or the whole of it.
- A *part* is what several refinements make of an element: a child of a child, and so on.
- A *piece* is a part that needs no further division: a regular patch, or one with a single extraordinary point.

An element without semi-sharp features has few pieces. A crease of sharpness s has 2^s parts along it, most of them
without a sample, and parts in which no samples lie are not divided. Whatever has been divided is kept, so that later
samples find their pieces by going down the parts, all at once. Two things save more:

- Parts of many elements are divided together, and those of the same signature as one.
- *Steady* refinements are made once. An element with creases of sharpness 4.7 and 6.2 is refined by the same rules as
  one with 2.7 and 4.2: all of them are sharp before and after, and how sharp makes no difference. Its children have 3.7
  and 5.2, those of the other have 1.7 and 3.2, and that is all that differs. So the signature is lowered by 2, the
  number of its `Signature.steady_refinements`, and refined; the children's sharpness is raised by 2 again. The children
  of 3.7 and 5.2 are lowered in turn, by 1, to 2.7 and 4.2: what is asked for then is known already.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import RLock
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import IntArray
from ..mesh.sharpness import INFINITE
from ..mesh.signature import Signature
from ..schemes.domain import IDENTITY, AffineMap, FloatArray
from ..schemes.members import optional_member
from ..schemes.scheme import Scheme, SchemeError
from .equations import Evaluator
from .irregular_patch import IrregularPatch, irregular_patch
from .patch_pieces import MAX_REFINEMENTS, Piece, whole_piece
from .refined_element import RefinedElement, refined_element

if TYPE_CHECKING:
    from .ring_mesh import RingMesh

# After these nothing is semi-sharp: every refinement takes one from a sharpness, which is below `INFINITE`.
MOST_SEMI_SHARP_REFINEMENTS = int(INFINITE)
# Weights of control points are sums over eigen-coordinates, in which large terms may cancel. What cancels leaves
# rounding errors. So this part of it counts as weight: times `COLLAPSED` that is one rounding error, or more.
CANCELLED = 1 / 16
# Of a part that is no piece, and of a child in which no sample has lain.
NONE = -1


class GrownRows:
    """Rows of an array that grows at its end."""

    def __init__(self, shape: tuple[int, ...], dtype: DTypeLike = np.float64) -> None:
        self._room: NDArray = np.empty((4, *shape), dtype=dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> NDArray:
        return self._room[: self._count]

    def append(self, row: NDArray | float) -> None:
        if self._count == len(self._room):
            self._room = np.concatenate([self._room, np.empty_like(self._room)])
        self._room[self._count] = row
        self._count += 1


class PieceGroup:
    """Pieces of the same structure, over one-rings of as many control points.

    Parameters
    ----------
    patch : IrregularPatch or None
        None for regular pieces.
    shape : (int, int)
        Of the stencils of a piece.
    order : tuple of int, optional
        Regular pieces whose control points are those of the element in this order: there is one.

    Attributes
    ----------
    patch : IrregularPatch or None
    stencils : GrownRows of (K_piece, K) float64
        Control points of each piece over the element's one-ring.
    coordinates : GrownRows of (K_piece, K) float64
        Eigen-coordinates of each irregular piece, likewise; of regular pieces the ``stencils``.
    column_count : int
        K.
    """

    def __init__(self, patch: IrregularPatch | None, shape: tuple[int, ...], order: tuple[int, ...] | None = None):
        self.patch, self.stencils, self._order = patch, GrownRows(shape), order
        self.coordinates = self.stencils if patch is None else GrownRows(shape)
        self.column_count = shape[1]

    def take(self, stencils: FloatArray) -> float:
        """Add a piece, and return `OccupiedPieces.gains` of it."""
        self.stencils.append(stencils)
        if self.patch is not None:
            self.coordinates.append(self.patch.basis.inverse @ stencils)
        return float(self.absolute_sums(np.array([len(self.stencils) - 1])).max())

    def coordinates_of(
        self, which: IntArray, controls: FloatArray, evaluator: Evaluator, room: FloatArray
    ) -> FloatArray:
        """What `IrregularPatch.rows`, or rows of the regular basis, are multiplied by: ``(s, K_piece, x)``.

        Parameters
        ----------
        which : (s,) int64
            Piece of each sample.
        controls : (K, s, x)
            Control points. Sums are double precision, and rounded once.
        evaluator : "power" | "stam" | "stabilized" | "limit"
        room : (n,) float64
            To gather weights in: fresh memory takes several times as long.
        """
        if self._order is not None:
            return controls.take(self._order, axis=0).swapaxes(0, 1)
        rows = (self.stencils if evaluator == "power" else self.coordinates).rows
        weights = room[: len(which) * rows[0].size].reshape(len(which), *rows.shape[1:])
        # Without checks of the indices, which would go by way of fresh memory.
        rows.take(which, axis=0, out=weights, mode="clip")
        return (weights @ controls.swapaxes(0, 1)).astype(controls.dtype, copy=False)

    def absolute_sums(self, which: IntArray) -> FloatArray:
        """Of some pieces ``(s, K_piece)``: bounds of the absolute weights of control points in each coordinate.

        Sums of the absolute weights, and for irregular pieces a part of what cancels in them (`CANCELLED`).
        """
        sums = np.abs(self.stencils.rows[which]).sum(axis=2)
        if self.patch is None:
            return sums
        cancelled = CANCELLED * (sums @ np.abs(self.patch.basis.inverse).T)
        return cancelled + np.abs(self.coordinates.rows[which]).sum(axis=2)

    def absolute_weights(self, frame: FloatArray, which: IntArray) -> FloatArray:
        """For each tangent of a frame, the sum ``(2, s)`` of the absolute weights of control points in it.

        Parameters
        ----------
        frame : (2, s, K_piece)
            Rows over the pieces' coordinates.
        which : (s,) int64
            Piece of each sample.
        """
        sums = np.abs(self.stencils.rows[which]).sum(axis=2).astype(frame.dtype)
        if self.patch is None:
            return np.einsum("dsk,sk->ds", np.abs(frame), sums)
        sums = sums @ np.abs(self.patch.basis.inverse).T.astype(frame.dtype)
        own = self.coordinates.rows[which].astype(frame.dtype)
        found = np.abs(frame.swapaxes(0, 1) @ own).sum(axis=2).T
        return CANCELLED * np.einsum("dsk,sk->ds", np.abs(frame), sums) + found


@dataclass(frozen=True, eq=False)
class _Part:
    """A part that is no piece.

    Attributes
    ----------
    signature : Signature
    over : (K_part, K) float64, or None
        Its control points over the element's one-ring; None for the element itself.
    depth : int
        How many refinements have made it: of the element, or of the first part without anything semi-sharp.
    """

    signature: Signature
    over: FloatArray | None
    depth: int

    @property
    def byte_count(self) -> int:
        return 0 if self.over is None else self.over.nbytes


@dataclass(frozen=True, eq=False)
class _Tip:
    """The surface around an extraordinary point from a level on that is divided into regular pieces.

    Attributes
    ----------
    stencils : (K_piece, K) float64
        Control points over the element's one-ring, of the irregular piece.
    patch : IrregularPatch
    coordinates : (K_piece, K) float64
        Eigen-coordinates of the piece that child 0 is after so many refinements.
    level : int
    domain, inner : AffineMap
        From the element's parameters to those of the irregular piece, and of that child.
    """

    stencils: FloatArray
    patch: IrregularPatch
    coordinates: FloatArray
    level: int
    domain: AffineMap
    inner: AffineMap

    @property
    def byte_count(self) -> int:
        return self.stencils.nbytes + self.coordinates.nbytes


class OccupiedPieces:
    """Parts of elements in which samples have lain, down to pieces.

    Parameters
    ----------
    scheme : Scheme
    piece_levels : int
        How many levels around an extraordinary point are regular pieces. That takes less time than eigen-coordinates,
        and a few bits of derivatives.
    column_step : int
        Weights get columns of zeros, up to a multiple of this, so that there are fewer groups.

    Attributes
    ----------
    scheme : Scheme
    groups : list of PieceGroup
    """

    def __init__(self, scheme: Scheme, piece_levels: int = 0, column_step: int = 1) -> None:
        self.scheme, self._piece_levels, self._column_step = scheme, piece_levels, column_step
        self._corner_maps = [scheme.domain.rotation(corner) for corner in range(scheme.domain.corner_count)]
        # Those that have children to be made; None for others.
        self._divided: list[_Part | _Tip | None] = []
        self._mesh: RingMesh | None = None
        self.groups: list[PieceGroup] = []
        self._group_numbers: dict[tuple[IrregularPatch | None, tuple[int, ...], tuple[int, ...] | None], int] = {}
        # Of each group where it comes if those of a structure follow each other.
        self._group_ranks = np.empty(0, dtype=np.int16)
        # Only one thread at a time adds parts. What others read of those that are there stays.
        self.lock = RLock()
        # How parts are turned before they are divided, and maps to their children.
        self._divisions = [(IDENTITY, scheme.domain.children)]
        # Of each part: which of the divisions it has; its children; and maps to its own parameters from the element's,
        # as counted from each corner: matrix and offset. Maps are composed before they are applied, so a tiny (u, v) at
        # any corner stays exact.
        self._division = GrownRows((), np.int16)
        self._children = GrownRows((4,), np.int32)
        self._maps = GrownRows((len(self._corner_maps), 6))
        # Of pieces.
        self._group = GrownRows((), np.int16)
        self._place = GrownRows((), np.int32)
        self._level = GrownRows((), np.int64)
        self._gain = GrownRows(())

    @classmethod
    def of(cls, scheme: Scheme, signature: Signature) -> OccupiedPieces:
        """Of one element, whose number is 0."""
        found = cls(scheme)
        found.add([signature])
        return found

    @property
    def gains(self) -> FloatArray:
        """Largest of `PieceGroup.absolute_sums` of each part that is a piece."""
        return self._gain.rows

    @property
    def group_of(self) -> NDArray[np.int16]:
        """Number of each part's group, for those that are pieces."""
        return self._group.rows

    @property
    def ranks(self) -> NDArray[np.int16]:
        """Of each part's group, where groups of the same structure follow each other."""
        return self._group_ranks[self._group.rows]

    @property
    def place_of(self) -> NDArray[np.int32]:
        """Which piece of its group each part is."""
        return self._place.rows

    @property
    def level_of(self) -> NDArray[np.int64]:
        """Of regular pieces, the level around an extraordinary point; else 0."""
        return self._level.rows

    @property
    def byte_count(self) -> int:
        """About how much memory weights take."""
        arrays = [rows for group in self.groups for rows in (group.stencils, group.coordinates)]
        return sum(rows.rows.nbytes for rows in arrays) + sum(part.byte_count for part in self._divided if part)

    def add(self, signatures: Iterable[Signature]) -> list[int]:
        """Take elements of some signatures, and return their numbers among the parts."""
        with self.lock:
            return self._add([(_Part(signature, None, 0), IDENTITY) for signature in signatures])

    def piece(self, part: int) -> Piece:
        """A part that is a piece."""
        group = self.groups[self.group_of[part]]
        structure = None if group.patch is None else group.patch.structure
        return Piece(self._domain(part), group.stencils.rows[self.place_of[part]], structure)

    def locate(self, part: IntArray, uv: FloatArray, corner: IntArray) -> IntArray:
        """Find the piece ``(s,)`` that each sample lies in.

        Parameters
        ----------
        part : (s,) int64
            Numbers of the elements, as `add` returned them.
        uv : (s, 2) float64
            With (0, 0) at the sample's corner.
        corner : (s,) int64

        Raises
        ------
        SchemeError
            If refinement does not separate the irregularities of a one-ring, or something stays semi-sharp for ever.
        """
        part = part.copy()
        divided = np.flatnonzero(self._division.rows.take(part) != NONE)
        # In the part's own parameters, which are not exact near corners other than (0, 0).
        inner, _ = self.mapped(part.take(divided), uv.take(divided, axis=0).T, corner.take(divided))
        while len(divided):
            parent = part.take(divided)
            child, inner = self._first_inside(parent, inner)
            found = self._children.rows.ravel().take(4 * parent + child)
            if found.min() == NONE:
                with self.lock:
                    self._divide(parent, child)
                found = self._children.rows.ravel().take(4 * parent + child)
            part[divided] = found
            left = np.flatnonzero(self._division.rows.take(found) != NONE)
            divided, inner = divided.take(left), inner.take(left, axis=1)
        return part

    def mapped(self, part: IntArray, uv: FloatArray, corner: IntArray) -> tuple[FloatArray, FloatArray]:
        """Parameters ``(2, s)`` in parts, and their derivatives ``(2, 2, s)`` by those of the elements ``(2, s)``."""
        maps = self._maps.rows
        a, b, c, d, x, y = found = maps.reshape(-1, 6).take(part * maps.shape[1] + corner, axis=0).T.copy()
        u, v = uv
        # Products and sums one by one, as in `AffineMap`.
        return np.stack([a * u + b * v + x, c * u + d * v + y]), found[:4].reshape(2, 2, -1)

    def _first_inside(self, part: IntArray, local: FloatArray) -> tuple[IntArray, FloatArray]:
        """The first child that each sample lies in, as it may lie on the border of several, and parameters there."""
        divisions = self._division.rows.take(part)
        numbers = np.flatnonzero(np.bincount(divisions)).tolist()
        if len(numbers) == 1:
            return self._inside(numbers[0], local)
        child, inner = np.empty(len(part), dtype=np.int64), np.empty_like(local)
        for number in numbers:
            own = np.flatnonzero(divisions == number)
            child[own], inner[:, own] = self._inside(number, local.take(own, axis=1))
        return child, inner

    def _inside(self, division: int, local: FloatArray) -> tuple[IntArray, FloatArray]:
        turn, maps = self._divisions[division]
        if turn is not IDENTITY:
            local = turn(local.T).T
        if maps is self.scheme.domain.children:
            return self.scheme.domain.first_child(local)
        found = np.stack([into(local.T).T for into in maps])
        child = self.scheme.domain.inside(found.swapaxes(1, 2)).argmax(axis=0)
        return child, found[child, :, np.arange(len(child))].T

    def _divide(self, parent: IntArray, child: IntArray) -> None:
        """Make children that are missing."""
        pairs = np.unique(4 * parent + child)
        missing = pairs[self._children.rows[pairs // 4, pairs % 4] == NONE].tolist()
        new: list[tuple[_Part, AffineMap]] = []
        refined_pairs = []
        for pair in missing:
            part = self._divided[pair // 4]
            if isinstance(part, _Part):
                steady = steady_refinements(self.scheme, part.signature)
                refined = refined_element(self.scheme, part.signature.sharpened(-steady))
                signature, stencils = refined.child(pair % 4)
                signature, over = signature.sharpened(steady), stencils if part.over is None else stencils @ part.over
                is_less_sharp = part.signature.is_semi_sharp and not signature.is_semi_sharp
                depth = 0 if is_less_sharp else part.depth + 1
                new.append((_Part(signature, over, depth), refined.domains[pair % 4] @ self._domain(pair // 4)))
                refined_pairs.append(pair)
            elif part is not None:
                self._children.rows[pair // 4, pair % 4] = self._add_to_tip(part, pair % 4)
        for pair, number in zip(refined_pairs, self._add(new), strict=True):
            self._children.rows[pair // 4, pair % 4] = number
        for part in {pair // 4 for pair in missing}:
            count = len(self._divisions[self._division.rows[part]][1])
            if (self._children.rows[part, :count] != NONE).all():
                self._divided[part] = None

    def _add(self, parts: list[tuple[_Part, AffineMap]]) -> list[int]:
        """Add parts, with maps from the elements' parameters to theirs."""
        begin = len(self._divided)
        pieces = [whole_piece(self.scheme, part.signature) for part, _ in parts]
        refined = iter(self._refined([part for (part, _), piece in zip(parts, pieces, strict=True) if piece is None]))
        for (part, domain), piece in zip(parts, pieces, strict=True):
            if piece is None:
                self._add_divided(part, self._division_of(IDENTITY, next(refined).domains), domain)
                continue
            stencils = piece.stencils if part.over is None else piece.stencils @ part.over
            own = piece.domain @ domain
            if piece.irregular is None:
                self._add_piece(None, stencils, own)
                continue
            patch = irregular_patch(self.scheme, piece.irregular)
            if self._piece_levels:
                tip = _Tip(stencils, patch, patch.basis.inverse @ stencils, 0, own, own)
                self._add_divided(tip, self._division_of(piece.domain, self.scheme.domain.children), domain)
            else:
                self._add_piece(patch, stencils, own)
        return list(range(begin, len(self._divided)))

    def _add_to_tip(self, tip: _Tip, child: int) -> int:
        """Add a child of a tip."""
        inner = self.scheme.domain.children[child] @ tip.inner
        if child > 0:
            return self._add_piece(None, tip.patch.eigen_children[child - 1] @ tip.coordinates, inner, tip.level)
        if tip.level + 1 == self._piece_levels:
            return self._add_piece(tip.patch, tip.stencils, tip.domain)
        smaller = tip.patch.basis.block_matrix() @ tip.coordinates
        return self._add_divided(replace(tip, coordinates=smaller, level=tip.level + 1, inner=inner), 0, inner)

    def _add_divided(self, part: _Part | _Tip, division: int, domain: AffineMap) -> int:
        for column in (self._group, self._place, self._level, self._gain):
            column.append(0)
        return self._add_row(part, division, domain)

    def _add_piece(self, patch: IrregularPatch | None, stencils: FloatArray, domain: AffineMap, level: int = 0) -> int:
        columns = stencils.shape[1]
        stencils = np.pad(stencils, ((0, 0), (0, -columns % self._column_step)))
        key = patch, stencils.shape, _order_of(stencils) if patch is None else None
        if key not in self._group_numbers:
            self._group_numbers[key] = len(self.groups)
            self.groups.append(PieceGroup(*key))
            structures = {patch: number for number, (patch, *_) in enumerate(self._group_numbers)}
            order = np.argsort([structures[each.patch] for each in self.groups], kind="stable")
            self._group_ranks = np.argsort(order).astype(np.int16)
        number = self._group_numbers[key]
        self._group.append(number)
        self._place.append(len(self.groups[number].stencils))
        self._level.append(level)
        self._gain.append(self.groups[number].take(stencils))
        return self._add_row(None, NONE, domain)

    def _add_row(self, part: _Part | _Tip | None, division: int, domain: AffineMap) -> int:
        maps = [domain @ of_corner for of_corner in self._corner_maps]
        self._maps.append(np.array([[*each.matrix.ravel(), *each.offset] for each in maps]))
        self._division.append(division)
        self._children.append(NONE)
        self._divided.append(part)
        return len(self._divided) - 1

    def _refined(self, parts: list[_Part]) -> list[RefinedElement]:
        """Parts refined once, less sharp by `steady_refinements`."""
        from .ring_mesh import refined_together

        for part in parts:
            most = MOST_SEMI_SHARP_REFINEMENTS + 1 if part.signature.is_semi_sharp else MAX_REFINEMENTS
            if part.depth >= most:
                raise not_isolated(self.scheme, part.signature, most)
        lowered = [part.signature.sharpened(-steady_refinements(self.scheme, part.signature)) for part in parts]
        elements, self._mesh = refined_together(self.scheme, lowered, self._mesh)
        return elements

    def _domain(self, part: int) -> AffineMap:
        """From the element's parameters, counted from its first corner, to those of a part."""
        a, b, c, d, x, y = self._maps.rows[part, 0]
        return AffineMap(np.array([[a, b], [c, d]]), np.array([x, y]))

    def _division_of(self, turn: AffineMap, maps: tuple[AffineMap, ...]) -> int:
        """Number of a division."""
        for number, (known_turn, known) in enumerate(self._divisions):
            pairs = zip((turn, *maps), (known_turn, *known), strict=False)
            if len(known) == len(maps) and all(one.is_same(other) for one, other in pairs):
                return number
        self._divisions.append((turn, maps))
        return len(self._divisions) - 1


def _order_of(stencils: FloatArray) -> tuple[int, ...] | None:
    """Of stencils that only put control points in another order, which of them each is; else None."""
    order = stencils.argmax(axis=1)
    return tuple(order.tolist()) if np.array_equal(stencils, np.eye(stencils.shape[1])[order]) else None


def occupied_pieces(scheme: Scheme, signature: Signature) -> OccupiedPieces:
    """Pieces of one element, whose number is 0. Kept, if it has nothing semi-sharp: else there may be very many."""
    return OccupiedPieces.of(scheme, signature) if signature.is_semi_sharp else _kept_pieces(scheme, signature)


@lru_cache(maxsize=256)
def _kept_pieces(scheme: Scheme, signature: Signature) -> OccupiedPieces:
    return OccupiedPieces.of(scheme, signature)


def not_isolated(scheme: Scheme, left: Signature, refinements: int) -> SchemeError:
    """What is wrong if so many refinements leave an element of some signature."""
    if left.is_semi_sharp:
        return SchemeError(
            f"{scheme.name}: {refinements} refinements leave something of a {left.kind} semi-sharp; expected each to "
            "take one from the sharpness"
        )
    return SchemeError(
        f"{scheme.name}: refinement leaves a {left.kind} with fans {left.fans} neither regular nor self-similar; "
        "expected a scheme that isolates extraordinary points"
    )


def steady_refinements(scheme: Scheme, signature: Signature) -> int:
    """How far a signature is lowered; not at all where Chaikin's method mixes sharpness, as no two levels are alike."""
    if optional_member(scheme, "crease_method") == "chaikin" and not signature.has_equal_creases:
        return 0
    return signature.steady_refinements
