"""Evaluation of patches at any parameters: of points, or of other values that are subdivided as points are."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from ..evaluation.piece_tree import FrameKind, NodeKind
from ..evaluation.polynomial_basis import ROUNDED, polynomial_basis
from ..patches.piece_table import CLASS, CORNERS, FOLLOWING, PATCH, PATCH_CORNER, PRECEDING
from .array_types import ArrayTypes
from .domain_map import MappedParameters
from .element_walk import ElementWalk
from .piece_polynomial import FramePolynomials, PiecePolynomial
from .polynomial import Polynomial

if TYPE_CHECKING:
    from ..patches import PieceTable

# Weights are read in packets of so many.
PACKET = 4
# The logarithm of zero would be infinite. Nothing as near to an extraordinary point has a level of its own.
NEAREST = 2.0**-64
# From this level on, single precision has lost some bits of the cross product of derivatives that become parallel.
FIRST_UNEVEN_LEVEL = 3
# Dr.Jit takes plain integers only.
_ONLY_CHILD, _OWN_POINTS, _IRREGULAR = map(int, (NodeKind.ONLY_CHILD, NodeKind.OWN_POINTS, NodeKind.IRREGULAR))
_UNEVEN = int(FrameKind.UNEVEN)


class PatchKernel:
    """A piece table on the device.

    Parameters
    ----------
    table : PieceTable
    float_type : type
        Flat Dr.Jit array, such as ``drjit.llvm.ad.Float``, or ``float``.
    is_published : bool
        Whether irregular pieces are evaluated by (9) and (11) instead of (10) and (12).

    Attributes
    ----------
    domain : ParameterDomain
    walk : ElementWalk
        Over the table's elements.
    """

    def __init__(self, table: PieceTable, float_type: type, *, is_published: bool = False) -> None:
        self._types = types = ArrayTypes.of(float_type)
        scheme = table.patches.scheme
        self.domain = scheme.domain
        basis = polynomial_basis(scheme)
        self._powers = [tuple(power) for power in basis.powers.tolist()]
        self._centre = tuple(basis.centre.tolist())
        self._basis = basis.matrix.tolist()
        count = len(self._powers)
        self._is_published = is_published
        self._packets = -(-count // PACKET)
        # An array that kernels gather from cannot be empty.
        slow = table.slow if len(table.slow) else np.zeros((1, count))
        self._weights, self._slow = (
            types.floats(np.pad(rows, ((0, 0), (0, self._packets * PACKET - count)))) for rows in (table.weights, slow)
        )
        self.walk = ElementWalk(table, types)
        self._classes, self._nodes = types.indices(table.classes), types.indices(table.nodes)
        self._orders, self._controls = types.indices(table.orders), types.indices(table.controls)
        self._shrinking = types.floats(np.log2(table.shrinking))
        kinds = table.nodes[:, 0] & 7
        self._is_divided = bool((kinds < _OWN_POINTS).any())
        self._has_own_points = bool((kinds == _OWN_POINTS).any())
        self._has_blocks = bool((kinds > _OWN_POINTS).any())
        self._has_irregular = bool((kinds == _IRREGULAR).any())
        self._has_frames = bool((table.nodes[:, 2] & 3).any())
        self._most_controls = int(table.classes[:, 2].max())
        self._is_split = table.refinement is not None

    def piece(
        self,
        fetch: Callable[[Any, Any], Any],
        half_edge: Any,
        u: Any,
        v: Any,
        active: Any = True,
        *,
        unrolled: bool = False,
    ) -> PiecePolynomial:
        """The piece in which parameters lie.

        Parameters
        ----------
        fetch : callable
            Finds control values by their index, where a mask is set.
        half_edge : index array
            Of an element.
        u, v : float arrays
            Inside the domain, seen from the half-edge.
        active : mask
        unrolled : bool
            Whether sums over control points are written out, which derivatives by the control values need.
        """
        types, domain = self._types, self.domain
        parameters = MappedParameters.of(u, v, types.float)
        if self._is_split:
            half_edge, parameters = self._split(half_edge, parameters, active)
        class_index = self.walk.neighbour(half_edge, CLASS, active)
        code = self.walk.patch_code(half_edge, active)
        first_control, patch_count, control_count, node = types.fetch(types.index4, self._classes, class_index, active)
        first_control = first_control + code // PATCH
        node, turn, parameters = self._leaf(node, code // PATCH_CORNER & CORNERS, parameters, active)
        kind, first_row, frames, slow_row = types.fetch(types.index4, self._nodes, node, active)
        parameters, kind = parameters.turned(domain, (turn + (kind >> 3)) % domain.corner_count), kind & 7
        level_count, frames = frames >> 2, frames & 3
        row, shrinking, is_irregular = first_row, types.float(1), kind == _IRREGULAR
        level = block = number = types.index(0)
        if self._has_irregular:
            level, number, inside, shrinking = self._at_level(node, level_count, parameters)
            block = dr.fma(level, len(domain.children) - 1, number)
            row = dr.select(is_irregular, dr.fma(block, control_count, row), row)
            parameters = parameters.chosen(is_irregular, inside)
            shrinking = dr.select(is_irregular, shrinking, 1)

        def value(k: Any, where: Any) -> Any:
            return fetch(types.fetch(types.index, self._controls, dr.fma(k, patch_count, first_control), where), where)

        origin = value(types.index(0), active)
        coefficients = [origin * 0 for _ in self._powers]
        if self._has_blocks:
            counted = dr.select((kind != _OWN_POINTS) & active, control_count, 0)
            coefficients = self._of_block(coefficients, origin, value, row, counted, unrolled=unrolled)
        if self._has_own_points:
            self._add_own(coefficients, origin, value, row, (kind == _OWN_POINTS) & active)
        frame = None
        if self._has_frames:
            is_rest = level == level_count
            is_uneven = (frames == _UNEVEN) & (level >= FIRST_UNEVEN_LEVEL) & (is_rest == False)  # noqa: E712 - an array
            needed = is_irregular & active & (is_uneven | ((frames != 0) & is_rest))
            # The block of the frame at the point, or those of uneven levels after it.
            point_block = dr.fma(level_count, len(domain.children) - 1, 1)
            row = dr.fma(point_block + dr.select(is_uneven, block + 1, 0), control_count, first_row)
            counted = dr.select(needed, control_count, 0)
            others = self._of_block([origin * 0] * len(self._powers), origin, value, row, counted, unrolled=unrolled)
            slow = self._packed(self._slow, slow_row + number, needed & is_uneven)
            frame = FramePolynomials(
                needed, is_uneven, Polynomial(tuple(others), self._powers), Polynomial(tuple(slow), self._powers)
            )
        polynomial = Polynomial(tuple(coefficients), self._powers)
        basis = self._basis if self._is_published else None
        return PiecePolynomial(
            origin, polynomial, shrinking, parameters, self._centre, domain, is_irregular, frame, basis
        )

    def nothing(self, kind: type) -> PiecePolynomial:
        """A piece of zeros, for loops to begin with; its values are of a kind."""
        types = self._types
        zero, no, vector = types.float(0), types.float(0) > 1, kind(0)
        vectors, numbers = (Polynomial((each,) * len(self._powers), self._powers) for each in (vector, zero))
        frame = FramePolynomials(no, no, vectors, numbers) if self._has_frames else None
        parameters = MappedParameters(zero, zero, (zero,) * 4)  # type: ignore[arg-type]
        basis = self._basis if self._is_published else None
        return PiecePolynomial(vector, vectors, zero, parameters, self._centre, self.domain, no, frame, basis)

    def _split(self, half_edge: Any, parameters: MappedParameters, active: Any) -> tuple[Any, MappedParameters]:
        """Corner of a whole element in whose quarter parameters lie, and parameters in that quarter."""
        types, domain = self._types, self.domain
        is_whole = self.walk.is_whole(half_edge, active)
        u, v = parameters.u >= 0.5, parameters.v >= 0.5
        following, preceding = (self.walk.neighbour(half_edge, column, active) for column in (FOLLOWING, PRECEDING))
        opposite = self.walk.neighbour(following, FOLLOWING, active)
        corner = dr.select(u, dr.select(v, types.index(2), 1), dr.select(v, types.index(3), 0))
        own = dr.select(u, dr.select(v, opposite, following), dr.select(v, preceding, half_edge))
        # Seen from a later corner is turned the other way round.
        quarter = parameters.turned(domain, (4 - corner) & 3).scaled(2)
        return dr.select(is_whole, own, half_edge), parameters.chosen(is_whole, quarter)

    def _leaf(
        self, node: Any, turn: Any, parameters: MappedParameters, active: Any
    ) -> tuple[Any, Any, MappedParameters]:
        """The node in which parameters lie that is not divided, and parameters there before it is turned.

        Parameters go on being seen from the corner that they were given from, ``turn``: near it, turning them would
        lose their last digits. It is the same corner in every copy of the domain.
        """
        if not self._is_divided:
            return node, turn, parameters
        types, domain = self._types, self.domain
        count = domain.corner_count

        def node_at(node: Any) -> Any:
            return types.fetch(types.index4, self._nodes, node, active)

        def is_inner(node: Any, *_: Any) -> Any:
            return active & ((node_at(node)[0] & 7) < _OWN_POINTS)

        def descend(node: Any, turn: Any, u: Any, v: Any, a: Any, b: Any, c: Any, d: Any) -> tuple:
            kind, first, _, _ = node_at(node)
            turn = (turn + (kind >> 3)) % count
            here = MappedParameters(u, v, (a, b, c, d))
            child, number = here.in_child(domain, 0)
            # Copies at corners are counted from the first one; that in the middle of a triangle comes after them.
            number = types.index(number)
            number = dr.select(number < count, (number + turn) % count, number)
            is_only = (kind & 7) == _ONLY_CHILD
            here = child.chosen(is_only, here)
            return first + dr.select(is_only, 0, number), turn, here.u, here.v, *here.jacobian

        state = (node, types.index(turn), parameters.u, parameters.v, *parameters.jacobian)
        node, turn, u, v, *jacobian = dr.while_loop(state, is_inner, descend, mode=types.loops, label="piece_tree")
        return node, turn, MappedParameters(u, v, tuple(jacobian))  # type: ignore[arg-type]

    def _at_level(
        self, node: Any, level_count: Any, parameters: MappedParameters
    ) -> tuple[Any, Any, MappedParameters, Any]:
        """Where parameters lie in an irregular piece.

        Returns
        -------
        level : index array
        number : index array
            Of the regular child; 0 for the rest.
        parameters : MappedParameters
            In the regular child of that level.
        shrinking : float array
            Power of the second eigenvalue.
        """
        types, domain = self._types, self.domain
        u, v = parameters.u, parameters.v
        extent = u + v if domain.corner_count == 3 else dr.maximum(u, v)
        # Where rounding takes a power of two for a little more or less, parameters are as little outside the child.
        n = dr.clip(dr.floor(-dr.log2(dr.maximum(extent, NEAREST))), 0, types.float(level_count))
        level = types.index(n)
        is_rest = level == level_count
        magnified = parameters.scaled(dr.exp2(n))
        child, number = magnified.in_child(domain, 1)
        shrinking = dr.exp2(n * types.fetch(types.float, self._shrinking, node))
        return level, dr.select(is_rest, 0, types.index(number)), child.chosen(is_rest, magnified), shrinking

    def _of_block(
        self, coefficients: list, origin: Any, value: Callable, row: Any, control_count: Any, *, unrolled: bool
    ) -> list:
        """Coefficients as weights times control values."""
        types = self._types

        def add(k: Any, *sums: Any) -> tuple:
            where = k < control_count
            relative = dr.select(where, value(k, where) - origin, 0)
            weights = self._packed(self._weights, row + k, where)
            return k + 1, *(dr.fma(relative, weight, total) for weight, total in zip(weights, sums, strict=True))

        # The first control value is the origin itself.
        state = (types.index(1), *coefficients)
        if unrolled:
            for _ in range(1, self._most_controls):
                state = add(*state)
        else:
            state = dr.while_loop(state, lambda k, *_: k < control_count, add, mode=types.loops, label="patch_block")
        return list(state[1:])

    def _packed(self, table: Any, row: Any, active: Any) -> list:
        """A row of weights, one for each monomial."""
        types = self._types
        packets = (types.fetch(types.vector4, table, row * self._packets + i, active) for i in range(self._packets))
        return [weight for packet in packets for weight in packet][: len(self._powers)]

    def _add_own(self, coefficients: list, origin: Any, value: Callable, order: Any, active: Any) -> None:
        """Add those of the regular basis, whose control values are the one-ring's own."""
        types, count = self._types, len(self._basis[0])
        for j in range(count):
            k = types.fetch(types.index, self._orders, order * count + j, active)
            relative = dr.select(active, value(k, active) - origin, 0)
            for m, row in enumerate(self._basis):
                if abs(row[j]) > ROUNDED:
                    coefficients[m] = dr.fma(relative, row[j], coefficients[m])
