"""Evaluation of patches at any parameters: of points, or of other values that are subdivided like points.

A sample is evaluated from the coefficients of the piece that contains it, which a `CoefficientMap` has computed. Close
to an extraordinary point, at levels that have no pieces, the terms of equations (10) and (12) are summed instead.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

from ..evaluation.irregular_patch import LEVEL_PIECES, PIECE_LEVELS
from ..evaluation.patch_tree import PartKind
from ..evaluation.polynomials import polynomial_basis
from ..patches.piece_table import (
    CODE,
    CORNERS,
    FACTORS,
    FRAME,
    FRAMES,
    KINDS,
    LEVEL,
    LEVELS,
    PACKET,
    PATCH,
    PATCH_CORNER,
    REST,
    TERM,
    TURN,
    UNEVEN,
    WHOLE,
    PieceTable,
    piece_packets,
)
from .algebra import Monomials, added, combined, cross, like, selected
from .array_types import ArrayTypes, Float, FloatBuffer, Index, Index4, Mask, Value, Vector3
from .locations import ElementWalk, doublings, turn_matrix, turned

# Lower bound of the distance from an extraordinary point, in parameters of the tip, for computing its level: zero has
# no exponent. No level is as deep as this.
LEAST_EXTENT = 2.0**-64
# Step of finite differences, in parameters of a piece: for second derivatives of displaced surfaces, and for those of
# unit normals. In single precision, their relative rounding error is 2⁻¹³.
DIFFERENCE = 2.0**-10
# Dr.Jit only accepts plain integers, not enumerations.
_ONLY_CHILD, _REGULAR, _TIP = map(int, (PartKind.ONLY_CHILD, PartKind.REGULAR, PartKind.TIP))


# Not frozen, as `Location` is not.
@dataclass(eq=False)
class PatchValues:
    """Value and derivatives of a patch at given parameters."""

    value: Value
    # Derivatives by the parameters, seen from the given half-edge. At an extraordinary point, where they vanish or are
    # infinite, tangents of arbitrary length instead.
    du: Value
    dv: Value
    # Normal of arbitrary length: the cross product of the derivatives, or of a tangent frame where these do not span
    # the tangent plane. Zero for values other than points.
    normal: Vector3
    second: tuple[Value, ...] = ()  # Derivatives by uu, uv and vv

    @property
    def first_order(self) -> tuple[Value, ...]:
        """Value, derivatives and normal."""
        return self.value, self.du, self.dv, self.normal

    def shifted(self, du: Float, dv: Float) -> PatchValues:
        """Attach the value and its first derivatives to parameters that move by ``du`` and ``dv``.

        Requires second derivatives. Automatic differentiation cannot replace them: the loop over a tip's terms
        is not differentiated by the parameters, and two such loops in forward mode raise an error in Dr.Jit 1.5.
        """
        uu, uv, vv = map(dr.detach, self.second)
        by_u, by_v = dr.detach(self.du), dr.detach(self.dv)
        return replace(
            self,
            value=self.value + (by_u * du + by_v * dv),
            du=self.du + (uu * du + uv * dv),
            dv=self.dv + (uv * du + vv * dv),
        )

    def seen_from_first(self, walk: ElementWalk, corner: Index) -> PatchValues:
        """Transform first derivatives from parameters seen from ``corner`` to those seen from the first corner."""
        a, b, c, d = turn_matrix(walk.domain, walk.types, corner)
        du, dv = combined(self.du, d, self.dv, -c), combined(self.dv, a, self.du, -b)
        return PatchValues(self.value, like(du, self.value), like(dv, self.value), self.normal)


class TipTerms(NamedTuple):
    """Terms to sum at the levels of a tip that have no pieces, see `patches.piece_table.Tip`."""

    count: Index  # 0 where the sample lies in a piece
    coordinates: Index  # First number of the coordinates
    row: Index  # First row of the block
    factor: Index  # First factor
    # First row of the block whose derivatives are the tangents where those of the surface do not span the tangent
    # plane, and its first factor; the lanes that need these tangents, and those that need `uneven_frame`. None if no
    # tip has such lanes.
    frame_row: Index = None
    frame_factor: Index = None
    needs_frame: Mask = None
    is_uneven: Mask = None


@dataclass(frozen=True, eq=False)
class Piece:
    """The piece that contains given parameters."""

    kernel: PieceKernel
    buffer: FloatBuffer  # The coefficients of all pieces
    # Coefficients of this piece, a list for each coordinate; zeros at levels of tips that have no pieces
    coefficients: list[list[Float]]
    # Parameters in the piece, relative to the middle of the domain
    s: Float
    t: Float
    jacobian: tuple[Float, Float, Float, Float]  # ds/du, ds/dv, dt/du, dt/dv for the given parameters u, v
    magnification: Float  # Absolute scale of s and t relative to u and v: a power of two
    tip: TipTerms | None
    size: int  # Number of components of a value

    @property
    def is_deep(self) -> Mask | None:
        """Whether parameters lie at a level of a tip that has no pieces; None if there are no tips."""
        return None if self.tip is None else self.tip.count > 0

    def is_inside(self, du: Float, dv: Float, tolerance: Float) -> Mask:
        """Whether parameters offset by ``du`` and ``dv`` lie in the piece, or within a tolerance of it."""
        s, t = self._parameters(du, dv)
        centre_s, centre_t = self.kernel.centre
        return reduce(dr.minimum, self.kernel.domain.edge_distances(s + centre_s, t + centre_t)) >= -tolerance

    def values(self, du: Float = 0, dv: Float = 0, derivatives: int = 1) -> PatchValues:
        """Evaluate at parameters offset by ``du`` and ``dv``, which may lie outside of the piece.

        ``du`` and ``dv`` must be detached, see `PatchValues.shifted`.
        """
        s, t = self._parameters(du, dv)
        kernel = self.kernel
        components = [kernel.monomials.values(numbers, s, t, derivatives) for numbers in self.coefficients]
        value, *partials = ([*vector] for vector in zip(*components, strict=True))
        frame = None
        if self.tip is not None:
            value, partials, frame = self._with_tip(self.tip, value, partials, s, t, derivatives)
        a, b, c, d = self.jacobian

        def along(by_s: list, by_t: list) -> tuple[list, list]:
            return combined(by_s, a, by_t, c), combined(by_s, b, by_t, d)

        by_s, by_t, *second = partials
        du, dv = along(by_s, by_t)
        normal = cross(*((du, dv) if frame is None else along(*frame))) if self.size == 3 else [0] * self.size
        if second:
            ss, st, tt = second
            second = [
                [x * (i * k) + y * (i * m + k * j) + z * (j * m) for x, y, z in zip(ss, st, tt, strict=True)]
                for (i, j), (k, m) in (((a, c), (a, c)), ((a, c), (b, d)), ((b, d), (b, d)))
            ]
        vector = kernel.types.vector(self.size)
        value, du, dv, normal, *second = (vector(*components) for components in (value, du, dv, normal, *second))
        return PatchValues(value, du, dv, normal, tuple(second))

    def _parameters(self, du: Float, dv: Float) -> tuple[Float, Float]:
        a, b, c, d = self.jacobian
        return self.s + (a * du + b * dv), self.t + (c * du + d * dv)

    def _with_tip(
        self, tip: TipTerms, value: list, partials: list[list], s: Float, t: Float, derivatives: int
    ) -> tuple[list, list[list], tuple[list, list] | None]:
        """Add the sums of a tip's terms to the value and the derivatives.

        Returns both, and tangents by s and t that span the tangent plane if derivatives do not everywhere.
        """
        kernel, types, size = self.kernel, self.kernel.types, self.size
        evaluate, has_frame = kernel.monomials.values, tip.frame_row is not None

        # A piece has a coordinate in place of each of its coefficients, and begins with the first coordinate.
        width, length = kernel.count - 1, kernel.length(size)

        def coordinate(number: Index, active: Mask = True) -> list[Float]:
            """Coordinate of the term after a number of others that are not the first."""
            offset = tip.coordinates + number // width * length + number % width * size
            return [dr.gather(types.float, self.buffer, offset + i, active) for i in range(size, 2 * size)]

        def add_term(k, *totals):
            factor = kernel.factor(tip.factor + k)
            weights = [weight * factor for weight in evaluate(kernel.weights(tip.row + k), s, t, derivatives)]
            if has_frame:
                factor = kernel.factor(tip.frame_factor + k, tip.needs_frame)
                tangents = evaluate(kernel.weights(tip.frame_row + k, tip.needs_frame), s, t)[1:]
                weights += [tangent * factor for tangent in tangents]
            products = itertools.product(weights, coordinate(k - 1))
            return k + 1, *(dr.fma(x, weight, total) for (weight, x), total in zip(products, totals, strict=True))

        sum_count = size * (1 + len(partials) + 2 * has_frame)
        # The loop only computes sums: ``max_iterations=-1`` lets reverse mode run without storing its iterations.
        keywords: dict[str, Any] = {"max_iterations": -1} if dr.grad_enabled(self.buffer) else {}
        _, *totals = dr.while_loop(
            # The first term is the extraordinary point itself.
            (types.index(1), *(types.float(0) for _ in range(sum_count))),
            lambda k, *_: k < tip.count,
            add_term,
            mode="symbolic",
            label="tip",
            **keywords,
        )
        value_sum, *derivative_sums = (totals[i : i + size] for i in range(0, sum_count, size))
        is_deep = tip.count > 0
        first: list[Float] = [dr.gather(types.float, self.buffer, tip.coordinates + i, is_deep) for i in range(size)]
        point = added(first, value_sum)
        value, *partials = (
            added(vector, change) for vector, change in zip((value, *partials), (point, *derivative_sums), strict=False)
        )
        if not has_frame:
            return value, partials, None
        by_s, by_t, tangent_s, tangent_t = *partials[:2], *derivative_sums[-2:]
        _, slow_s, slow_t = evaluate(kernel.weights(tip.row + 1, tip.is_uneven), s, t)
        uneven = combined(by_s, slow_s, by_t, slow_t), combined(tangent_t, slow_s, tangent_s, -slow_t)
        frame_s, frame_t = (
            selected(tip.needs_frame, selected(tip.is_uneven, *frame), derivative)
            for *frame, derivative in zip(uneven, (tangent_s, tangent_t), (by_s, by_t), strict=True)
        )
        return value, partials, (frame_s, frame_t)


class PieceKernel:
    """A piece table on the device."""

    def __init__(
        self,
        table: PieceTable,
        float_type: type,  # Flat Dr.Jit array, such as ``drjit.llvm.ad.Float``
    ) -> None:
        self.types = types = ArrayTypes(float_type)
        scheme = table.patches.scheme
        self.domain, basis = scheme.domain, polynomial_basis(scheme)
        self.monomials = Monomials(basis.powers.tolist())
        self.centre = tuple(scheme.domain.centre.tolist())  # The middle of the domain
        self.walk = ElementWalk(table, types)  # Over the table's elements
        self.count = len(basis.powers)
        self._row_size = -(-self.count // PACKET) * PACKET
        self._piece_levels = table.piece_levels
        self._patch_starts, self._nodes = types.indices(table.patch_starts), types.indices(table.nodes)
        kinds = table.nodes[:, 0] & KINDS
        self._is_divided = bool((kinds < _REGULAR).any())
        self._has_tips = bool((kinds == _TIP).any())
        self._has_frames = bool((table.nodes[:, 3] & FRAMES).any())
        if self._has_tips:
            self._weights = types.floats(np.concatenate([tip.rows for tip in table.tips], dtype=types.numpy_float))
        self._is_split = table.patches.refined is not None

    def piece(
        self,
        buffer: FloatBuffer,  # Coefficients
        half_edge: Index,
        # In the domain, seen from the half-edge
        u: Float,
        v: Float,
        active: Mask = True,
        row: Index4 | None = None,  # `ElementWalk.row` of the half-edges, if known
        size: int = 3,  # Number of components of a coefficient
    ) -> Piece:
        """The piece that contains given parameters."""
        types, domain = self.types, self.domain
        # A new reference to the array: Dr.Jit traces this code again for derivatives, when ``buffer`` may have been
        # assigned other coefficients.
        buffer = type(buffer)(buffer)
        if row is None:
            row = self.walk.row(half_edge, active)
        code, scale, quarter = row[CODE], types.float(1), types.index(0)
        if self._is_split:
            code, u, v, scale, quarter = self._split(half_edge, row, u, v, active)
        turn = code // PATCH_CORNER & CORNERS
        patch = code // PATCH
        first_piece, root = dr.gather(types.index2, self._patch_starts, patch, active)
        node = dr.gather(types.index4, self._nodes, root, active)
        if self._is_divided:
            node, turn, u, v, scale = self._leaf(node, turn, u, v, scale, active)
        kind, number, block_row, tip_code = node
        turn = (turn + kind // TURN) % domain.corner_count
        u, v = turned(domain, u, v, turn)
        number, is_piece, tip = first_piece + number, active, None
        if self._has_tips:
            is_tip = (kind & KINDS) == _TIP
            level_count, term_count = tip_code // LEVEL & LEVELS, tip_code // TERM
            level, child, u, v, scale = self._at_level(is_tip, level_count, u, v, scale)
            coordinates = (number + LEVEL_PIECES * self._piece_levels) * self.length(size)
            number += child
            is_deep = active & is_tip & (level >= self._piece_levels)
            is_piece = active & ~is_deep
            is_rest = level == level_count
            block = dr.select(is_rest, REST, child - LEVEL_PIECES * level)
            row = dr.fma(block, term_count, block_row)
            factor = dr.fma(term_count, FACTORS, block_row) * self._row_size + level * term_count
            frames: tuple = ()
            if self._has_frames and size == 3:
                frame = tip_code & FRAMES
                is_uneven = is_deep & (frame == UNEVEN) & (level >= PIECE_LEVELS) & ~is_rest
                needs_frame = is_uneven | (is_deep & is_rest & (frame != 0))
                frame_row = dr.select(is_uneven, row, dr.fma(term_count, FRAME, block_row))
                frame_factor = factor + dr.select(is_uneven, (level_count + 1) * term_count, 0)
                frames = frame_row, frame_factor, needs_frame, is_uneven
            tip = TipTerms(dr.select(is_deep, term_count, 0), coordinates, row, factor, *frames)
        numbers = types.row(buffer, self.length(size), number, is_piece)
        a, b, c, d = turn_matrix(domain, types, (turn + quarter) % domain.corner_count)
        return Piece(
            self,
            buffer,
            [numbers[i : size * self.count : size] for i in range(size)],
            u - self.centre[0],
            v - self.centre[1],
            (a * scale, b * scale, c * scale, d * scale),
            dr.abs(scale),
            tip,
            size,
        )

    def length(self, size: int) -> int:
        """Number of the coefficients of a piece of ``size`` components, with padding."""
        return PACKET * piece_packets(self.count, size)

    def weights(self, row: Index, active: Mask = True) -> list:
        """Fetch a row of the blocks, with one weight for each monomial."""
        return self.types.row(self._weights, self._row_size, row, active)[: self.count]

    def factor(self, index: Index, active: Mask = True) -> Float:
        """Fetch the factor of a term."""
        return dr.gather(self.types.float, self._weights, index, active)

    def _split(
        self, half_edge: Index, row: Index4, u: Float, v: Float, active: Mask
    ) -> tuple[Index, Float, Float, Float, Index]:
        """Find the quarter of a whole element that contains given parameters.

        Returns the code of the half-edge at its corner; parameters in the quarter, seen from this half-edge; their
        derivative by the given parameters; and the corner from which the given half-edge is seen. Other elements keep
        their half-edge and parameters.
        """
        types = self.types
        is_whole = (row[CODE] & WHOLE) != 0
        corner, inner_u, inner_v, inner_scale = self._child_at(u, v)
        # Half-edges of an element are consecutive.
        given_corner = row[CODE] & CORNERS
        later_corner = (given_corner + corner) & 3
        code = self.walk.row(half_edge - given_corner + dr.select(is_whole, later_corner, given_corner), active)[CODE]
        # The given half-edge seen from the quarter's: the inverse of the turn by ``corner``.
        turn = dr.select(is_whole, (4 - corner) & 3, types.index(0))
        quarter_u, quarter_v = turned(self.domain, inner_u, inner_v, turn)
        u, v = dr.select(is_whole, quarter_u, u), dr.select(is_whole, quarter_v, v)
        return code, u, v, dr.select(is_whole, inner_scale, types.float(1)), turn

    def _child_at(self, u: Float, v: Float) -> tuple[Index, Float, Float, Float]:
        number, *inner = self.domain.child_at(u, v, dr.select)
        return self.types.index(number), *inner

    def _leaf(
        self, node: Index4, turn: Index, u: Float, v: Float, scale: Float, active: Mask
    ) -> tuple[Index4, Index, Float, Float, Float]:
        """Descend to the leaf that contains given parameters.

        Returns the leaf's row; the corner of its domain from which parameters are seen; parameters in the leaf; and
        their derivative by the given parameters. Parameters stay relative to the corner from which they were given,
        which is the same corner of each child's domain: turning them would cancel digits next to this corner.
        """
        types, count = self.types, self.domain.corner_count

        def descend(node, turn, u, v, scale):
            kind, first, _, _ = node
            turn = (turn + kind // TURN) % count
            number, inner_u, inner_v, inner_scale = self._child_at(u, v)
            # Children at corners are numbered from the first corner; the middle child of a triangle is the last.
            number = dr.select(number < count, (number + turn) % count, number)
            is_only = (kind & KINDS) == _ONLY_CHILD
            return (
                dr.gather(types.index4, self._nodes, first + dr.select(is_only, 0, number), active),
                turn,
                dr.select(is_only, u, inner_u),
                dr.select(is_only, v, inner_v),
                dr.select(is_only, scale, scale * inner_scale),
            )

        return dr.while_loop(
            (node, turn, u, v, scale),
            lambda node, *_: active & ((node[0] & KINDS) < _REGULAR),
            descend,
            mode="symbolic",
            label="tree_arrays",
        )

    def _at_level(
        self, is_tip: Mask, level_count: Index, u: Float, v: Float, scale: Float
    ) -> tuple[Index, Index, Float, Float, Float]:
        """Find the regular piece of a tip that contains given parameters.

        Returns the level; the number of the piece among those of all levels, zero in other leaves; parameters in the
        piece; and their derivative by the given parameters.
        """
        types = self.types
        extent = u + v if self.domain.corner_count == 3 else dr.maximum(u, v)
        max_level = dr.select(is_tip, level_count, types.index(0))
        level, power = doublings(types, dr.maximum(extent, LEAST_EXTENT), max_level)
        u, v, scale = u * power, v * power, scale * power
        number, inner_u, inner_v, inner_scale = self._child_at(u, v)
        is_child = is_tip & (level < level_count)
        return (
            level,
            dr.select(is_child, dr.fma(level, LEVEL_PIECES, number - 1), level * LEVEL_PIECES),
            dr.select(is_child, inner_u, u),
            dr.select(is_child, inner_v, v),
            dr.select(is_child, scale * inner_scale, scale),
        )


def differences(vectors: Callable[[Float, Float], Sequence[Vector3]], magnification: Float) -> list[list[Vector3]]:
    """Detached derivatives of vectors by u, then by v, from the vectors at parameters offset by two numbers."""
    step = DIFFERENCE * dr.rcp(magnification)
    with dr.suspend_grad():
        inverse = 0.5 * dr.rcp(step)
        return [
            [(ahead - behind) * inverse for ahead, behind in zip(vectors(u, v), vectors(-u, -v), strict=True)]
            for u, v in ((step, 0), (0, step))
        ]
