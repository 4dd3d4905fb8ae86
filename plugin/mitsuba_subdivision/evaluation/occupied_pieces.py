"""Pieces of elements, but only those in which samples lie.

An element without semi-sharp features has few pieces. A crease of sharpness s has 2^s parts along it, most of them
without a sample, and parts in which no samples lie are not divided. Divided parts are kept, so that later samples
descend to their pieces all at once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from threading import RLock

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..schemes.domain import IDENTITY, AffineMap, FloatArray
from ..schemes.scheme import Scheme
from .divided_element import (
    MOST_SEMI_SHARP_REFINEMENTS,
    DividedElement,
    PartKind,
    element_of,
    not_isolated,
    refine_elements,
)
from .equations import Evaluator
from .irregular_patch import IrregularPatch
from .patch_pieces import MAX_REFINEMENTS, Piece
from .refined_rings import RingMesh

# Weights of control points are sums over eigen-coordinates, in which large terms may cancel. Cancelled terms leave
# rounding errors. So this part of them counts as weight: times `TANGENT_ROUNDING` that is one rounding error, or more.
CANCELLED = 1 / 16
# In place of a child in which no sample has lain.
NO_CHILD = -1
# Parts with more control points, as around vertices of high valence, have no weights of their own: see `_Part`.
MANY_CONTROLS = 128
# Levels that are regular pieces at darts of high valence, where an eigenbasis takes a time that grows with the cube of
# the valence: at the last, derivatives lose a digit.
OWN_BASIS_LEVELS = 6
# Pieces of more weights are not copied for each sample: tips around vertices of high valence.
LARGE_PIECE = 1 << 18


class GrowingColumns:
    """Arrays of equally many rows, by their names, that grow at their end.

    Parameters
    ----------
    columns
        Shape of a row, and type.
    """

    def __init__(self, **columns: tuple[tuple[int, ...], DTypeLike]) -> None:
        self._capacity: dict[str, NDArray] = {
            name: np.empty((4, *shape), dtype=dtype) for name, (shape, dtype) in columns.items()
        }
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, name: str) -> NDArray:
        return self._capacity[name][: self._count]

    def append(self, **row: object) -> int:
        """Add a row, and return its index."""
        for name, value in row.items():
            if self._count == len(self._capacity[name]):
                self._capacity[name] = np.concatenate([self._capacity[name]] * 2)
            self._capacity[name][self._count] = value
        self._count += 1
        return self._count - 1


class PieceGroup:
    """Pieces of the same patch, or regular ones, over one-rings of as many control points.

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
    columns : (K,) int64
        Control points of an element that `weights` are of.
    """

    def __init__(self, patch: IrregularPatch | None, shape: tuple[int, int], order: tuple[int, ...] | None = None):
        self.patch, self._order = patch, order
        self.columns = np.arange(shape[1]) if order is None else np.array(order)
        names = ("stencils",) if patch is None else ("stencils", "coordinates")
        self._weights = GrowingColumns(**dict.fromkeys(names, (shape, np.float64)))

    @property
    def stencils(self) -> FloatArray:
        """``(n, K_piece, K)`` control points of each piece over the element's one-ring."""
        return self._weights["stencils"]

    @property
    def coordinates(self) -> FloatArray:
        """``(n, K_piece, K)`` eigen-coordinates of irregular pieces over the one-ring; ``stencils`` of regular ones."""
        return self._weights["stencils" if self.patch is None else "coordinates"]

    @property
    def is_large(self) -> bool:
        return int(np.prod(self.stencils.shape[1:])) > LARGE_PIECE

    @property
    def byte_count(self) -> int:
        return self.stencils.nbytes + (0 if self.patch is None else self.coordinates.nbytes)

    def take(self, stencils: FloatArray) -> tuple[int, float]:
        """Add a piece; its index, and the largest of its `absolute_sums`."""
        own = {} if self.patch is None else {"coordinates": self.patch.basis.inverse @ stencils}
        index = self._weights.append(stencils=stencils, **own)
        return index, float(self.absolute_sums(np.array([index])).max())

    def weights(self, rows: FloatArray, which: IntArray, evaluator: Evaluator, buffer: FloatArray) -> FloatArray:
        """Weights ``(s, d, K)`` of control points of the elements, those of `columns`.

        Parameters
        ----------
        rows : (d, s, K_piece)
            Of `IrregularPatch.rows`, or of the regular basis.
        which : (s,) int64
            Piece of each sample, or (1,) of all if pieces are large.
        evaluator : "power" | "stam" | "stabilized" | "limit"
        buffer : (n,) float64
            To gather stencils in: fresh memory takes several times as long.
        """
        rows = rows.swapaxes(0, 1)
        if self._order is not None:
            return rows
        source = self.stencils if evaluator == "power" else self.coordinates
        if self.is_large:
            found = rows.reshape(-1, rows.shape[2]) @ source[which[0]]
            return found.reshape(*rows.shape[:2], -1).astype(rows.dtype, copy=False)
        stencils = buffer[: len(which) * source[0].size].reshape(len(which), *source.shape[1:])
        # Without checks of the indices, which would allocate memory.
        source.take(which, axis=0, out=stencils, mode="clip")
        # Sums are double precision, and rounded once.
        return (rows @ stencils).astype(rows.dtype, copy=False)

    def absolute_sums(self, which: IntArray) -> FloatArray:
        """Of some pieces ``(s, K_piece)``: bounds of the absolute weights of control points in each coordinate.

        Sums of the absolute weights, and for irregular pieces a part of cancelled terms (`CANCELLED`).
        """
        sums = np.abs(self.stencils[which]).sum(axis=2)
        if self.patch is None:
            return sums
        cancelled = CANCELLED * (sums @ np.abs(self.patch.basis.inverse).T)
        return cancelled + np.abs(self.coordinates[which]).sum(axis=2)

    def absolute_weights(self, frame: FloatArray, which: IntArray) -> FloatArray:
        """For each tangent of a frame, the sum ``(2, s)`` of the absolute weights of control points in it.

        Parameters
        ----------
        frame : (2, s, K_piece)
            Rows over the pieces' coordinates.
        which : (s,) int64
            Piece of each sample, or (1,) of all.
        """
        sums = np.abs(self.stencils[which]).sum(axis=2).astype(frame.dtype)
        if self.patch is None:
            return np.einsum("dsk,sk->ds", np.abs(frame), sums)
        sums = sums @ np.abs(self.patch.basis.inverse).T.astype(frame.dtype)
        own = self.coordinates[which].astype(frame.dtype)
        found = np.abs(frame.swapaxes(0, 1) @ own).sum(axis=2).T
        return CANCELLED * np.einsum("dsk,sk->ds", np.abs(frame), sums) + found


@dataclass(frozen=True, eq=False)
class _Part:
    """A part that may be divided further.

    Weights of a part with many control points are a large matrix, and those of the next part would be a product of two.
    So such a part has none, and rows over its control points go upwards, from part to part, by sparse products.

    Attributes
    ----------
    source : DividedElement or Piece
        The part's own element; or the irregular piece of the whole element that it is a level of.
    weights : (K_part, K) float64, or None
        Its control points, or eigen-coordinates, over the element's one-ring. None for the element itself, and for many
        control points.
    depth : int
        Number of refinements that made it: of the element, or of the first part without semi-sharp features. Or the
        level.
    above : (_Part, int), or None
        The part that it is a child of, and its number among the children; or that which the piece is, and 0. Only where
        there are many control points.
    """

    source: DividedElement | Piece
    weights: FloatArray | None = None
    depth: int = 0
    above: tuple[_Part, int] | None = None

    @property
    def byte_count(self) -> int:
        if self.above is not None:
            return 0
        return (0 if self.weights is None else self.weights.nbytes) + (
            self.source.stencils.nbytes if isinstance(self.source, Piece) else 0
        )

    def child(self, element: DividedElement, number: int) -> _Part:
        """The part that is a child of an element, which is this part."""
        below = element.child_element(number)
        is_less_sharp = element.signature.is_semi_sharp and not below.signature.is_semi_sharp
        depth = 0 if is_less_sharp else self.depth + 1
        if below.control_count > MANY_CONTROLS:
            return _Part(below, None, depth, (self, number))
        return _Part(below, self.over_element(element.child(number)[1]), depth)

    def tip(self, piece: Piece, domain: AffineMap) -> _Part:
        """The first level of an irregular piece, which is this part; ``domain`` is the piece's, from the element's."""
        if len(piece.weights) > MANY_CONTROLS:
            own = Piece(domain, piece.weights, piece.patch, piece.control_count)
            return _Part(own, above=(self, 0))
        whole = self.whole_piece(piece, domain)
        return _Part(whole, whole.coordinates)

    def whole_piece(self, piece: Piece, domain: AffineMap) -> Piece:
        """A piece, which is this part, over the control points of the element."""
        stencils = self.over_element(piece.stencils)
        return Piece(domain, stencils, piece.patch, stencils.shape[1])

    def regular_child(self, number: int) -> FloatArray:
        """``(R, K)`` control points of one of the regular pieces of a level."""
        patch = self.piece.irregular_patch
        if self.weights is not None:
            return patch.eigen_children[number - 1] @ self.weights
        return self.over_element(patch.regular_child(number, self.depth))

    def next_level(self) -> _Part:
        """The level after this one."""
        if self.weights is None:
            return _Part(self.source, None, self.depth + 1, self.above)
        weights = self.piece.irregular_patch.basis.block_matrix() @ self.weights
        return _Part(self.source, weights, self.depth + 1)

    @property
    def piece(self) -> Piece:
        """The piece that the part is a level of."""
        if not isinstance(self.source, Piece):
            raise TypeError("an element; expected a level around an extraordinary point")
        return self.source

    def over_element(self, rows: FloatArray) -> FloatArray:
        """Rows over the part's control points, or eigen-coordinates if it has weights, as weights ``(n, K)``."""
        if self.weights is not None:
            return rows @ self.weights
        if self.above is None:
            return rows
        part, number = self.above
        if isinstance(part.source, Piece):
            raise TypeError("a level of a piece; expected an element")
        if isinstance(self.source, Piece):
            return part.over_element(self.source.scattered(rows))
        return part.over_element(part.source.over_controls(rows[None], number)[0])


class OccupiedPieces:
    """Parts of elements in which samples have lain, down to pieces.

    Parameters
    ----------
    scheme : Scheme
    piece_levels : int
        Number of levels around an extraordinary point that are regular pieces. That takes less time than
        eigen-coordinates, and a few bits of derivatives.
    column_step : int
        Weights get columns of zeros, up to a multiple of this, so that there are fewer groups.

    Attributes
    ----------
    scheme : Scheme
    groups : list of PieceGroup
    ranks : (g,) int16
        Where each group comes if those of the same patch follow each other.
    parts : GrowingColumns
        All parts, elements among them. Of each ``kind``, a `PartKind`; ``children``, or `NO_CHILD`, in the order of
        its parameters; ``turn`` of a level around an extraordinary point, which makes these of the patch's, see
        `DividedElement.turn`; ``maps`` to its own parameters from the element's, as counted from each corner: matrix
        and offset. Of pieces ``group`` and ``index`` in the group; of regular ones ``level`` around an extraordinary
        point, else 0; ``gain``, the largest of `PieceGroup.absolute_sums`.
    """

    def __init__(self, scheme: Scheme, piece_levels: int = 0, column_step: int = 1) -> None:
        self.scheme, self._piece_levels, self._column_step = scheme, piece_levels, column_step
        rotations = [scheme.domain.rotation(corner) for corner in range(scheme.domain.corner_count)]
        self._rotations = AffineMap(*(np.stack(each) for each in zip(*rotations, strict=True)))
        self.groups: list[PieceGroup] = []
        self._group_numbers: dict[tuple[IrregularPatch | None, tuple[int, int], tuple[int, ...] | None], int] = {}
        self.ranks = np.empty(0, dtype=np.int16)
        # Only one thread at a time adds parts. Existing ones, which others read, do not change.
        self.lock = RLock()
        # Maps are composed before they are applied, so a tiny (u, v) at any corner stays exact.
        self.parts = GrowingColumns(
            kind=((), np.int8),
            turn=((), np.int8),
            children=((len(scheme.domain.children),), np.int32),
            maps=((len(rotations), 6), np.float64),
            group=((), np.int16),
            index=((), np.int32),
            level=((), np.int64),
            gain=((), np.float64),
        )
        # Those that have children to be made; None for others.
        self._divisible: list[_Part | None] = []
        self._divisible_bytes = 0
        self._mesh: RingMesh | None = None

    @classmethod
    def of(cls, scheme: Scheme, signature: Signature) -> OccupiedPieces:
        """Of one element, whose number is 0."""
        found = cls(scheme)
        found.add([signature])
        return found

    @property
    def byte_count(self) -> int:
        """About how much memory weights take."""
        return self._divisible_bytes + sum(group.byte_count for group in self.groups)

    def add(self, signatures: Iterable[Signature]) -> list[int]:
        """Take elements of some signatures, and return their numbers among the parts."""
        with self.lock:
            return self._add([(_Part(element_of(self.scheme, each)), IDENTITY) for each in signatures])

    def piece(self, part: int) -> Piece:
        """A part that is a piece."""
        group = self.groups[self.parts["group"][part]]
        stencils = group.stencils[self.parts["index"][part]]
        return Piece(self._domain(part), stencils, group.patch, stencils.shape[1])

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
            If refinement does not separate the irregularities of a one-ring, or something always stays semi-sharp.
        """
        part = part.copy()
        divided = np.flatnonzero(self.parts["kind"].take(part) <= PartKind.ONLY_CHILD)
        # In the part's own parameters, which are not exact near corners other than (0, 0).
        inner, _ = self.mapped(part.take(divided), uv.take(divided, axis=0).T, corner.take(divided))
        while len(divided):
            parent = part.take(divided)
            child, inner = self._first_child(parent, inner)
            at = parent * self.parts["children"].shape[1] + child
            found = self.parts["children"].ravel().take(at)
            if found.min() == NO_CHILD:
                with self.lock:
                    self._divide(parent, child)
                found = self.parts["children"].ravel().take(at)
            part[divided] = found
            rest = np.flatnonzero(self.parts["kind"].take(found) <= PartKind.ONLY_CHILD)
            divided, inner = divided.take(rest), inner.take(rest, axis=1)
        return part

    def mapped(self, part: IntArray, uv: FloatArray, corner: IntArray) -> tuple[FloatArray, FloatArray]:
        """Parameters ``(2, s)`` in parts, and their derivatives ``(2, 2, s)`` by those of the elements ``(2, s)``."""
        maps = self.parts["maps"]
        found = maps.reshape(-1, 6).take(part * maps.shape[1] + corner, axis=0).T.copy()
        jacobian = found[:4].reshape(2, 2, -1)
        # Products and sums one by one, as in `AffineMap`.
        return np.einsum("ijs,js->is", jacobian, uv) + found[4:], jacobian

    def _first_child(self, part: IntArray, uv: FloatArray) -> tuple[IntArray, FloatArray]:
        """The first child that each sample lies in, as it may lie on the border of several, and parameters there."""
        child, inner = self.scheme.domain.first_child(uv)
        is_only = self.parts["kind"].take(part) == PartKind.ONLY_CHILD
        return (np.where(is_only, 0, child), np.where(is_only, uv, inner)) if is_only.any() else (child, inner)

    def _divide(self, parent: IntArray, child: IntArray) -> None:
        """Make children that are missing."""
        count, children = self.parts["children"].shape[1], self.parts["children"].ravel()
        pairs = np.unique(count * parent + child)
        missing = [divmod(pair, count) for pair in pairs[children[pairs] == NO_CHILD].tolist()]
        new: list[tuple[_Part, AffineMap]] = []
        of_elements = []
        for index, number in missing:
            part = self._divisible[index]
            if part is None:
                continue
            if isinstance(part.source, Piece):
                turn, corners = int(self.parts["turn"][index]), self.scheme.domain.corner_count
                turned = (number + turn) % corners if number < corners else number
                found = self._add_level_child(part, turned, self._domain(index), turn)
                self.parts["children"][index, number] = found
                continue
            domain = part.source.domains[number] @ self._domain(index)
            new.append((part.child(part.source, number), domain))
            of_elements.append((index, number))
        for (index, number), found in zip(of_elements, self._add(new), strict=True):
            self.parts["children"][index, number] = found
        for index in {index for index, _ in missing}:
            count = 1 if self.parts["kind"][index] == PartKind.ONLY_CHILD else len(self.scheme.domain.children)
            part = self._divisible[index]
            if part is not None and (self.parts["children"][index, :count] != NO_CHILD).all():
                self._divisible_bytes -= part.byte_count
                self._divisible[index] = None

    def _add(self, parts: list[tuple[_Part, AffineMap]]) -> list[int]:
        """Add parts that are elements, with maps from the whole elements' parameters to theirs."""
        elements = [part.source for part, _ in parts if isinstance(part.source, DividedElement)]
        self._mesh = refine_elements(self.scheme, elements, self._mesh)
        found = []
        for element, (part, domain) in zip(elements, parts, strict=True):
            if element.piece is None:
                is_semi_sharp = element.signature.is_semi_sharp
                most = MOST_SEMI_SHARP_REFINEMENTS + 1 if is_semi_sharp else MAX_REFINEMENTS
                if part.depth >= most:
                    raise not_isolated(self.scheme, element.signature, most)
                found.append(self._add_part(part, domain, element.kind))
                continue
            of_piece = element.piece.domain @ domain
            if element.piece.patch is None or not self._piece_levels:
                found.append(self._add_piece(part.whole_piece(element.piece, of_piece)))
            else:
                tip = part.tip(element.piece, of_piece)
                found.append(self._add_part(tip, domain, PartKind.DIVIDED, turn=element.turn))
        return found

    def _add_level_child(self, part: _Part, number: int, domain: AffineMap, turn: int) -> int:
        """Add a child of a level around an extraordinary point; ``domain`` and ``turn`` as the level's row has them."""
        piece, level = part.piece, part.depth
        inner = self.scheme.domain.children[number] @ (domain if level else piece.domain)
        if number > 0:
            weights = part.regular_child(number)
            return self._add_piece(Piece(inner, weights, None, weights.shape[1]), level)
        has_own_basis = piece.irregular_patch.structure.shared_limit is not None
        if level + 1 < (OWN_BASIS_LEVELS if has_own_basis else self._piece_levels):
            return self._add_part(part.next_level(), inner, PartKind.DIVIDED, turn=turn)
        return self._add_piece(piece if part.above is None else part.above[0].whole_piece(piece, piece.domain))

    def _add_piece(self, piece: Piece, level: int = 0) -> int:
        rows, columns = piece.stencils.shape
        # NumPy's `pad` takes ten times as long for so few.
        stencils = np.zeros((rows, columns + -columns % self._column_step))
        stencils[:, :columns] = piece.stencils
        key = piece.patch, stencils.shape, _order_of(stencils) if piece.patch is None else None
        if key not in self._group_numbers:
            self._group_numbers[key] = len(self.groups)
            self.groups.append(PieceGroup(*key))
            patches = {patch: number for number, (patch, *_) in enumerate(self._group_numbers)}
            order = np.argsort([patches[each.patch] for each in self.groups], kind="stable")
            self.ranks = np.argsort(order).astype(np.int16)
        number = self._group_numbers[key]
        index, gain = self.groups[number].take(stencils)
        kind = PartKind.REGULAR if piece.patch is None else PartKind.TIP
        return self._add_part(None, piece.domain, kind, group=number, index=index, level=level, gain=gain)

    def _add_part(
        self,
        part: _Part | None,
        domain: AffineMap,
        kind: PartKind,
        turn: int = 0,
        group: int = 0,
        index: int = 0,
        level: int = 0,
        gain: float = 0.0,
    ) -> int:
        self._divisible.append(part)
        self._divisible_bytes += 0 if part is None else part.byte_count
        matrices = domain.matrix @ self._rotations.matrix
        offsets = self._rotations.offset @ domain.matrix.T + domain.offset
        return self.parts.append(
            kind=kind,
            turn=turn,
            children=NO_CHILD,
            maps=np.concatenate([matrices.reshape(-1, 4), offsets], axis=1),
            group=group,
            index=index,
            level=level,
            gain=gain,
        )

    def _domain(self, part: int) -> AffineMap:
        """From the element's parameters, counted from its first corner, to those of a part."""
        a, b, c, d, x, y = self.parts["maps"][part, 0]
        return AffineMap(np.array([[a, b], [c, d]]), np.array([x, y]))


def _order_of(stencils: FloatArray) -> tuple[int, ...] | None:
    """Of stencils that only put control points in another order, which of them each is; else None."""
    if np.count_nonzero(stencils) != len(stencils) or (stencils.max(axis=1) != 1).any():
        return None
    return tuple(stencils.argmax(axis=1).tolist())


def occupied_pieces(scheme: Scheme, signature: Signature) -> OccupiedPieces:
    """Pieces of one element, whose number is 0. Kept, if it has nothing semi-sharp: else there may be very many."""
    return OccupiedPieces.of(scheme, signature) if signature.is_semi_sharp else _kept_pieces(scheme, signature)


@lru_cache(maxsize=256)
def _kept_pieces(scheme: Scheme, signature: Signature) -> OccupiedPieces:
    return OccupiedPieces.of(scheme, signature)
