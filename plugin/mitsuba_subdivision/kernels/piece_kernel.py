"""Evaluation of patches at any parameters: of points, or of other values that are subdivided as points are.

What a sample needs are the coefficients of the piece that it lies in, which a `CoefficientMap` has made. Only next to
extraordinary points, beyond the levels that are pieces, equations (10) and (12) are summed over the one-ring.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from ..evaluation.patch_tree import PartKind
from ..evaluation.polynomials import polynomial_basis
from ..evaluation.tree_arrays import LEVEL_PIECES, PIECE_LEVELS, FrameKind
from ..mesh.shared import Shared
from ..patches.piece_table import (
    CODE,
    CONTROL,
    CORNERS,
    FRAMES,
    KINDS,
    LEVEL,
    LEVELS,
    PACKET,
    PATCH,
    PATCH_CORNER,
    TURN,
    WHOLE,
)
from .array_types import ArrayTypes, Float, FloatBuffer, Index, Index4, Mask, Value, Vector3
from .element_walk import ElementWalk, distances, doublings, in_child, turn_matrix, turned
from .polynomial import Monomials
from .vectors import added, combined, cross, like

if TYPE_CHECKING:
    from ..patches import PieceTable

# Zero has no exponent. Nothing as near to an extraordinary point has a level of its own.
LEAST_EXTENT = 2.0**-64
# Derivatives that no polynomial gives are differences over so much of a piece. Rounding leaves 2⁻¹³ of them in single
# precision.
DIFFERENCE = 2.0**-10
# Dr.Jit takes plain integers only.
_ONLY_CHILD, _REGULAR, _TIP = map(int, (PartKind.ONLY_CHILD, PartKind.REGULAR, PartKind.TIP))
_UNEVEN = int(FrameKind.UNEVEN)


@dataclass(frozen=True, eq=False)
class PatchValues:
    """What a patch is at some parameters."""

    value: Value
    # Derivatives by the parameters, as seen from the half-edge that was given. At an extraordinary point, where they
    # vanish or are infinite, tangents of arbitrary length.
    du: Value
    dv: Value
    # Along the normal, of any length: the cross product of the derivatives, or where these do not serve, of a frame.
    # Zeros for values other than points.
    normal: Vector3
    second: tuple[Value, ...] = ()  # Derivatives by uu, uv and vv

    def shifted(self, du: Float, dv: Float) -> PatchValues:
        """The value and its first derivatives, with first derivatives of parameters that move; needs second ones.

        Derivatives do not pass through the loop over a tip's control points, and two such loops in forward mode end in
        an error of Dr.Jit's (1.5).
        """
        uu, uv, vv = map(dr.detach, self.second)
        by_u, by_v = dr.detach(self.du), dr.detach(self.dv)
        return replace(
            self,
            value=self.value + (by_u * du + by_v * dv),
            du=self.du + (uu * du + uv * dv),
            dv=self.dv + (uv * du + vv * dv),
        )

    def at_values(self, known: PatchValues) -> PatchValues:
        """Known values with these derivatives by the control points."""
        value, du, dv, normal = (
            dr.replace_grad(dr.detach(getattr(known, name)), getattr(self, name))  # type: ignore[func-returns-value]  # The stub is wrong.
            for name in ("value", "du", "dv", "normal")
        )
        return PatchValues(value, du, dv, normal, self.second)

    def seen_from_first(self, walk: ElementWalk, corner: Index) -> PatchValues:
        """First derivatives by parameters seen from the first corner, instead of from a later one."""
        a, b, c, d = turn_matrix(walk.domain, walk.types, corner)
        du, dv = combined(self.du, d, self.dv, -c), combined(self.dv, a, self.du, -b)
        return PatchValues(self.value, like(du, self.value), like(dv, self.value), self.normal)


@dataclass(frozen=True, eq=False)
class Tip:
    """What is summed at the deeper levels of a tip, see `TreeArrays.blocks`."""

    control_count: Index  # Of the one-ring; 0 where a sample lies in no tip, or in a piece of it
    ring: Index  # First packet of the control points
    row: Index  # First row of the block
    frame: TipFrame | None  # Where derivatives do not serve as tangents; None where they always do


@dataclass(frozen=True, eq=False)
class TipFrame:
    """Tangents in place of the derivatives."""

    row: Index  # First row of the block whose derivatives they are
    # Lanes that need a tangent frame, and lanes that need that of `uneven_frame`
    is_needed: Mask
    is_uneven: Mask


@dataclass(frozen=True, eq=False)
class Piece:
    """The piece that some parameters lie in."""

    kernel: PieceKernel
    buffer: FloatBuffer  # The coefficients of all pieces
    coefficients: list[list[Float]]  # Those of this piece, of each coordinate; zeros in the deeper levels of tips
    # Parameters in the piece, from the middle of the domain
    s: Float
    t: Float
    jacobian: tuple[Float, Float, Float, Float]  # Derivatives of s by the parameters that were given, and of t
    magnification: Float  # How many times as fast as these s and t run: a power of two
    tip: Tip | None
    size: int = 3  # Of a value

    @property
    def is_deep(self) -> Mask | None:
        """Whether parameters lie at the deeper levels of a tip; None if there are no tips."""
        return None if self.tip is None else self.tip.control_count > 0

    def is_inside(self, du: Float, dv: Float, tolerance: Float) -> Mask:
        """Whether parameters so far on are in the piece, or no further outside than a tolerance."""
        s, t = self._parameters(du, dv)
        least, *others = distances(self.kernel.domain, s + self.kernel.centre[0], t + self.kernel.centre[1])
        for other in others:
            least = dr.minimum(least, other)
        return least >= -tolerance

    def values(self, du: Float = 0, dv: Float = 0, derivatives: int = 1) -> PatchValues:
        """Evaluate so far on from the parameters that were given, maybe outside of the piece.

        ``du`` and ``dv`` are without derivatives: see `PatchValues.shifted`.
        """
        s, t = self._parameters(du, dv)
        kernel = self.kernel
        # Of each coordinate.
        found = [kernel.monomials.values(numbers, s, t, derivatives) for numbers in self.coefficients]
        value, *by = ([*each] for each in zip(*found, strict=True))
        frame = None
        if self.tip is not None:
            value, by, frame = self._with_tip(self.tip, value, by, s, t, derivatives)
        a, b, c, d = self.jacobian
        by_s, by_t, *second = by
        found_u, found_v = combined(by_s, a, by_t, c), combined(by_s, b, by_t, d)
        tangents = [found_u, found_v]
        if frame is not None:
            is_needed, of_s, of_t = frame
            of_frame = combined(of_s, a, of_t, c), combined(of_s, b, of_t, d)
            tangents = [
                [dr.select(is_needed, x, y) for x, y in zip(*each, strict=True)]
                for each in zip(of_frame, tangents, strict=True)
            ]
        normal = cross(*tangents) if self.size == 3 else [0] * self.size
        if second:
            ss, st, tt = second
            second = [
                [x * (i * k) + y * (i * m + k * j) + z * (j * m) for x, y, z in zip(ss, st, tt, strict=True)]
                for (i, j), (k, m) in (((a, c), (a, c)), ((a, c), (b, d)), ((b, d), (b, d)))
            ]
        vector = kernel.types.vector(self.size)
        value, found_u, found_v, normal = (vector(*each) for each in (value, found_u, found_v, normal))
        return PatchValues(value, found_u, found_v, normal, tuple(vector(*each) for each in second))

    def _parameters(self, du: Float, dv: Float) -> tuple[Float, Float]:
        a, b, c, d = self.jacobian
        return self.s + (a * du + b * dv), self.t + (c * du + d * dv)

    def _with_tip(
        self, tip: Tip, value: list, by: list[list], s: Float, t: Float, derivatives: int
    ) -> tuple[list, list[list], tuple[Mask, list, list] | None]:
        """Add the point and the derivatives at deeper levels to those of pieces.

        Also gives where a frame is needed, and its tangents by s and t.
        """
        kernel, types, size = self.kernel, self.kernel.types, self.size
        evaluate, frame = kernel.monomials.values, tip.frame

        def add(k: Index, *sums: Float) -> tuple:
            weights = evaluate(kernel.weights(tip.row + k), s, t, derivatives)
            if frame is not None:
                weights += evaluate(kernel.weights(frame.row + k, frame.is_needed), s, t)[1:]
            terms = itertools.product(weights, kernel.control(self.buffer, tip.ring + k, size))
            return k + 1, *(dr.fma(x, weight, total) for (weight, x), total in zip(terms, sums, strict=True))

        sum_count = size * (1 + len(by) + (0 if frame is None else 2))
        # It sums only, so that derivatives pass through it backwards without a record of its iterations.
        keywords: dict[str, Any] = {"max_iterations": -1} if dr.grad_enabled(self.buffer) else {}
        _, *sums = dr.while_loop(
            # The other control points are relative to the first.
            (types.index(1), *(types.float(0) for _ in range(sum_count))),
            lambda k, *_: k < tip.control_count,
            add,
            mode="symbolic",
            label="tip",
            **keywords,
        )
        of_value, *of = (sums[i : i + size] for i in range(0, sum_count, size))
        is_deep = tip.control_count > 0
        point = added(kernel.control(self.buffer, tip.ring, size, is_deep), of_value)
        value, *by = (added(each, own) for each, own in zip((value, *by), (point, *of), strict=False))
        if kernel.first_term is not None:
            one, of_s, of_t = kernel.first_term(s, t, is_deep)
            value, by[0], by[1] = added(value, point, one), added(by[0], point, of_s), added(by[1], point, of_t)
        if frame is None:
            return value, by, None
        by_s, by_t, other_s, other_t = *by[:2], *of[-2:]
        _, slow_s, slow_t = evaluate(kernel.weights(tip.row, frame.is_uneven), s, t)
        uneven_s, uneven_t = combined(by_s, slow_s, by_t, slow_t), combined(other_t, slow_s, other_s, -slow_t)
        frame_s = [dr.select(frame.is_uneven, x, y) for x, y in zip(uneven_s, other_s, strict=True)]
        frame_t = [dr.select(frame.is_uneven, x, y) for x, y in zip(uneven_t, other_t, strict=True)]
        return value, by, (frame.is_needed, frame_s, frame_t)


class PieceKernel:
    """A piece table on the device."""

    def __init__(
        self,
        table: PieceTable,
        float_type: type,  # Flat Dr.Jit array, such as ``drjit.llvm.ad.Float``
        *,
        # Whether tips are evaluated by (9) and (11) instead of (10) and (12). They must have no levels that are pieces.
        use_stam: bool = False,
    ) -> None:
        if use_stam and table.piece_levels:
            raise ValueError("a table with levels of tips that are pieces; expected one made for Stam's form")
        self.types = types = ArrayTypes.of(float_type)
        scheme = table.patches.scheme
        self.domain = scheme.domain
        basis = polynomial_basis(scheme)
        self.monomials = Monomials(basis.powers.tolist())
        self.centre = tuple(basis.centre.tolist())  # The middle of the domain
        self.first_term = FirstTerm(basis.matrix.T.tolist(), self.monomials) if use_stam else None
        self.walk = ElementWalk(table, types)  # Over the table's elements
        self._count = len(basis.powers)
        self._numbers, self._row_size = PACKET * table.packets_of_piece, -(-self._count // PACKET) * PACKET
        self._piece_levels = table.piece_levels
        self._patch_starts, self._nodes = types.indices(table.patch_starts), types.indices(table.nodes)
        kinds = table.nodes[:, 0] & KINDS
        self._is_divided = bool((kinds < _REGULAR).any())
        self._has_tips = bool((kinds == _TIP).any())
        self._has_frames = bool((table.nodes[:, 3] & FRAMES).any())
        if self._has_tips:
            self._weights = types.floats(table.weights(self._row_size, types.numpy_float))
            self._rings = types.indices(table.rings)
        self._is_split = table.refinement is not None

    @classmethod
    def shared(cls, table: PieceTable, float_type: type, *, use_stam: bool = False) -> PieceKernel:
        """The kernel of a table, the same for all that ask for it."""
        return _KERNELS.get((table, float_type, use_stam), lambda: cls(table, float_type, use_stam=use_stam))

    def piece(
        self,
        buffer: FloatBuffer,  # Coefficients
        half_edge: Index,  # Of an element
        # Inside the domain, seen from the half-edge
        u: Float,
        v: Float,
        active: Mask = True,
        row: Index4 | None = None,  # `ElementWalk.row` of the half-edges, if it is known
        size: int = 3,  # How many of a coefficient's three numbers are wanted
    ) -> Piece:
        """The piece in which parameters lie."""
        types, domain = self.types, self.domain
        # Dr.Jit evaluates this again for derivatives, and must find the same array then, whatever the object has been
        # assigned since.
        buffer = type(buffer)(buffer)
        if row is None:
            row = self.walk.row(half_edge, active)
        code, scale, quarter = row[CODE], types.float(1), types.index(0)
        if self._is_split:
            code, u, v, scale, quarter = self._split(half_edge, row, u, v, active)
        turn = code // PATCH_CORNER & CORNERS
        patch = code // PATCH
        first_piece, node = types.fetch(types.index2, self._patch_starts, patch, active)
        if self._is_divided:
            node, turn, u, v, scale = self._leaf(node, turn, u, v, scale, active)
        kind, first, block_row, ends = types.fetch(types.index4, self._nodes, node, active)
        turn = (turn + kind // TURN) % domain.corner_count
        u, v = turned(domain, u, v, turn)
        number, is_piece, tip = first_piece + first, active, None
        if self._has_tips:
            is_tip = (kind & KINDS) == _TIP
            level, block, u, v, scale = self._at_level(is_tip, ends // LEVEL & LEVELS, u, v, scale)
            number += block
            is_deep = active & is_tip & (level >= self._piece_levels)
            is_piece = active & (is_deep == False)  # noqa: E712 - an array
            tip = self._tip(patch, block_row, ends, level, block, is_deep)
        numbers = types.row(buffer, self._numbers, number, is_piece)
        a, b, c, d = turn_matrix(domain, types, (turn + quarter) % domain.corner_count)
        return Piece(
            self,
            buffer,
            [numbers[i : 3 * self._count : 3] for i in range(size)],
            u - self.centre[0],
            v - self.centre[1],
            (a * scale, b * scale, c * scale, d * scale),
            dr.abs(scale),
            tip,
            size,
        )

    def control(self, buffer: FloatBuffer, packet: Index, size: int, active: Mask = True) -> list[Float]:
        """The control value in a packet of the coefficients."""
        return [*self.types.fetch(self.types.vector4, buffer, packet, active)][:size]

    def weights(self, row: Index, active: Mask = True) -> list:
        """A row of the blocks, one number for each monomial."""
        return self.types.row(self._weights, self._row_size, row, active)[: self._count]

    def _split(
        self, half_edge: Index, row: Index4, u: Float, v: Float, active: Mask
    ) -> tuple[Index, Float, Float, Float, Index]:
        """Of the corner of a whole element in whose quarter parameters lie.

        Returns the code of its half-edge; parameters in the quarter, seen from there; how fast they run; their turn.
        """
        types = self.types
        is_whole = (row[CODE] & WHOLE) != 0
        corner, inner_u, inner_v, inner_scale = in_child(self.domain, types, u, v)
        # Half-edges of an element follow each other.
        own = row[CODE] & CORNERS
        at = (own + corner) & 3
        code = self.walk.row(half_edge - own + dr.select(is_whole, at, own), active)[CODE]
        # Seen from a later corner is turned the other way round.
        turn = dr.select(is_whole, (4 - corner) & 3, types.index(0))
        quarter_u, quarter_v = turned(self.domain, inner_u, inner_v, turn)
        u, v = dr.select(is_whole, quarter_u, u), dr.select(is_whole, quarter_v, v)
        return code, u, v, dr.select(is_whole, inner_scale, types.float(1)), turn

    def _leaf(
        self, node: Index, turn: Index, u: Float, v: Float, scale: Float, active: Mask
    ) -> tuple[Index, Index, Float, Float, Float]:
        """The node in which parameters lie that is not divided, and parameters there before it is turned.

        Parameters remain relative to the corner from which they were given, ``turn``: near it, turning them would
        lose their last digits. It is the same corner in every copy of the domain.
        """
        types, count = self.types, self.domain.corner_count

        def node_at(node: Index) -> Index4:
            return types.fetch(types.index4, self._nodes, node, active)

        def is_inner(node: Index, *_: Any) -> Mask:
            return active & ((node_at(node)[0] & KINDS) < _REGULAR)

        def descend(node: Index, turn: Index, u: Float, v: Float, scale: Float) -> tuple:
            kind, first, _, _ = node_at(node)
            turn = (turn + kind // TURN) % count
            number, inner_u, inner_v, inner_scale = in_child(self.domain, types, u, v)
            # Copies at corners are counted from the first one; that in the middle of a triangle comes after them.
            number = dr.select(number < count, (number + turn) % count, number)
            is_only = (kind & KINDS) == _ONLY_CHILD
            return (
                first + dr.select(is_only, 0, number),
                turn,
                dr.select(is_only, u, inner_u),
                dr.select(is_only, v, inner_v),
                dr.select(is_only, scale, scale * inner_scale),
            )

        return dr.while_loop((node, turn, u, v, scale), is_inner, descend, mode="symbolic", label="tree_arrays")

    def _at_level(
        self, is_tip: Mask, level_count: Index, u: Float, v: Float, scale: Float
    ) -> tuple[Index, Index, Float, Float, Float]:
        """Where parameters lie in a tip.

        Returns the level, and the number of the regular child among those of all levels, zero in other leaves;
        parameters in the regular child of that level, and how fast they run.
        """
        types = self.types
        extent = u + v if self.domain.corner_count == 3 else dr.maximum(u, v)
        most = dr.select(is_tip, level_count, types.index(0))
        level, power = doublings(types, dr.maximum(extent, LEAST_EXTENT), most)
        u, v, scale = u * power, v * power, scale * power
        number, inner_u, inner_v, inner_scale = in_child(self.domain, types, u, v)
        is_child = is_tip & (level < level_count)
        block = dr.select(is_child, dr.fma(level, LEVEL_PIECES, number - 1), level * LEVEL_PIECES)
        return (
            level,
            block,
            dr.select(is_child, inner_u, u),
            dr.select(is_child, inner_v, v),
            dr.select(is_child, scale * inner_scale, scale),
        )

    def _tip(self, patch: Index, block_row: Index, ends: Index, level: Index, block: Index, is_deep: Mask) -> Tip:
        """What is summed at deeper levels; ``ends`` is the last column of `PieceTable.nodes`."""
        types = self.types
        frame, level_count, control_count = ends & FRAMES, ends // LEVEL & LEVELS, ends // CONTROL
        deeper = block - LEVEL_PIECES * self._piece_levels
        ring = types.fetch(types.index, self._rings, patch, is_deep)
        own = Tip(
            dr.select(is_deep, control_count, types.index(0)), ring, dr.fma(deeper, control_count, block_row), None
        )
        if not self._has_frames:
            return own
        is_rest = level == level_count
        is_uneven = is_deep & (frame == _UNEVEN) & (level >= PIECE_LEVELS) & (is_rest == False)  # noqa: E712 - an array
        is_needed = is_uneven | (is_deep & is_rest & (frame != 0))
        # After those of all levels and the rest, that of the frame at the point, then those of uneven levels.
        rest = LEVEL_PIECES * (level_count - self._piece_levels)
        frame_block = rest + 1 + dr.select(is_uneven, deeper + 1, types.index(0))
        return replace(own, frame=TipFrame(dr.fma(frame_block, control_count, block_row), is_needed, is_uneven))


@dataclass(frozen=True)
class FirstTerm:
    """What the first terms of (9) and (11) are more than those of (10) and (12), by rounding alone.

    The first eigenvector is one everywhere. So the term of the point is ``ĉ_1`` times the sum of the basis functions,
    which is one; those of the derivatives are ``2ⁿ⁺¹ ĉ_1`` times sums of their derivatives, which are zero. In single
    precision these sums are not quite.
    """

    functions: list[list[float]]  # Coefficients of each function of the scheme's basis
    monomials: Monomials

    def __call__(self, s: Float, t: Float, active: Mask) -> tuple[Float, Float, Float]:
        """Factors of a point in what is added to it and to its two derivatives by the parameters of a child."""
        total = (s * 0,) * 3
        for coefficients in self.functions:
            function = self.monomials.values([s * 0 + each for each in coefficients], s, t)
            total = tuple(a + b for a, b in zip(total, function, strict=True))  # type: ignore[assignment]
        one, by_s, by_t = (dr.select(active, each, 0) for each in (total[0] - 1, total[1], total[2]))
        return one, by_s, by_t


_KERNELS: Shared[PieceKernel] = Shared()
