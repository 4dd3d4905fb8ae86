"""The limit surface on the device: evaluated at any parameters, and met by rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from .array_types import ArrayTypes
from .element_walk import ElementWalk, Place
from .patch_kernel import PatchKernel, PatchValues
from .sparse_matrix import SparseMatrix

if TYPE_CHECKING:
    from ..patches import PieceTable

# Newton's steps along the ray, and then as many along the normal where they do not converge.
STEPS = 8
# Of them in a row in the same piece.
STEPS_IN_PIECE = 3
# Longest step, in parameters of an element: polynomials may be far off outside theirs.
LONGEST_STEP = 0.5
# A step shorter than this, in parameters of a piece, is the last: the next would be shorter than its square.
LAST_STEP = 3e-4


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a surface.

    Attributes
    ----------
    element place : Place
    p : 3-vector
    n : 3-vector
        Unit normal along ``dp_du x dp_dv``, or zero where the surface has none.
    dp_du, dp_dv : 3-vectors
    dn_du, dn_dv : 3-vectors, or None
        If second derivatives were asked for.
    """

    place: Place
    p: Any
    n: Any
    dp_du: Any
    dp_dv: Any
    dn_du: Any = None
    dn_dv: Any = None


class SurfaceKernel:
    """The limit surface of a cage on the device.

    Parameters
    ----------
    table : PieceTable
    float_type : type
        Flat Dr.Jit array, such as ``drjit.llvm.ad.Float``, or ``float``.
    """

    def __init__(self, table: PieceTable, float_type: type) -> None:
        self.types = ArrayTypes.of(float_type)
        self.walk = ElementWalk(table, self.types)
        self.patches = PatchKernel(table, float_type)
        self._refine = None
        if table.refinement is not None:
            self._refine = SparseMatrix(table.refinement, float_type, is_relative=True)

    def set_control_points(self, points: Any) -> None:
        """Take over control points, flat x, y, z; derivatives of what is evaluated reach them."""
        points = points if self._refine is None else self._refine(points)
        self._points = self.types.padded(points)
        self._is_attached = dr.grad_enabled(points)

    def _fetch(self, index: Any, active: Any) -> Any:
        return self.types.packet(self._points, index, active)

    def values(self, place: Place, active: Any = True, derivatives: int = 1) -> PatchValues:
        """Points and derivatives by the parameters."""
        unrolled = self._is_attached and not dr.is_suspended() if hasattr(dr, "is_suspended") else self._is_attached
        piece = self.patches.piece(self._fetch, place.half_edge, place.u, place.v, active, unrolled=unrolled)
        return piece.values(derivatives)

    def evaluate(self, place: Place, active: Any = True, derivatives: int = 1) -> SurfacePoints:
        """Points, normals and tangents; with 2 derivatives also those of the normals."""
        found = self.values(place, active, derivatives)
        n = _unit(dr.cross(found.tangent_u, found.tangent_v))
        change = (None, None)
        if derivatives == 2:
            uu, uv, vv = found.second
            across = dr.cross(found.du, found.dv)
            inverse = dr.rcp(dr.norm(across))
            change = tuple(
                (each - n * dr.dot(n, each)) * inverse
                for each in (
                    dr.cross(uu, found.dv) + dr.cross(found.du, uv),
                    dr.cross(uv, found.dv) + dr.cross(found.du, vv),
                )
            )
        return SurfacePoints(place, found.value, n, found.du, found.dv, *change)

    def intersect(self, p: Any, d: Any, place: Place, active: Any = True) -> tuple[Place, Any]:
        """Where lines meet the surface, near given places.

        Newton's method along the line; where it does not converge, along the surface's normal at the given place; and
        where that does not either, the given place.

        Parameters
        ----------
        p : 3-vector
            A point of each line.
        d : 3-vector
            Unit vector along it.
        place : Place
            Where to begin.

        Returns
        -------
        place : Place
            In whole elements seen from the first corner.
        way : index array
            0 on the line, 1 along the normal, 2 where neither converged.
        """
        types = self.types

        def is_on(way: Any, *_: Any) -> Any:
            return active & (way < 2)

        def step(way: Any, count: Any, is_done: Any, d: Any, half_edge: Any, u: Any, v: Any) -> tuple:
            here = Place(half_edge, u, v)
            piece = self.patches.piece(self._fetch, half_edge, u, v, active)
            is_finite, length, of_u, of_v = True, 0, 0, 0
            for number in range(STEPS_IN_PIECE):
                found = piece.values()
                if number == 0:
                    normal = dr.cross(found.tangent_u, found.tangent_v)
                    d = dr.select((way == 1) & (count == 0), _unit(normal), d)
                du, dv = _step(p - found.value, d, found.du, found.dv)
                length = dr.maximum(dr.abs(du), dr.abs(dv))
                factor = dr.select(length > LONGEST_STEP, LONGEST_STEP / length, 1)
                is_finite = is_finite & dr.isfinite(length)
                du, dv = du * factor, dv * factor
                of_u, of_v = of_u + du, of_v + dv
                piece = piece.moved(du, dv)
            moved = self.walk.carried(Place(half_edge, u + of_u, v + of_v), active)
            a, b, c, _ = piece.parameters.jacobian
            size = dr.maximum(dr.abs(a), dr.maximum(dr.abs(b), dr.abs(c)))
            is_within = piece.parameters.inside(self.patches.domain) >= -LAST_STEP
            has_converged = is_finite & is_within & (length * size < LAST_STEP)
            here = here.chosen(is_finite, moved)
            fails = (count + 1 >= STEPS) & (has_converged == False)  # noqa: E712 - an array
            here = here.chosen(fails, place)
            # Ways of those that have arrived are raised by 4, which ends their loop.
            way = dr.select(has_converged, way + 4, dr.select(fails, way + 1, way))
            return way, dr.select(fails, 0, count + 1), is_done, d, here.half_edge, here.u, here.v

        state = (types.index(0), types.index(0), types.float(0) > 1, d, place.half_edge, place.u, place.v)
        way, _, _, _, half_edge, u, v = dr.while_loop(state, is_on, step, label="meet_surface")
        return self.walk.from_first(Place(half_edge, u, v), active), way & 3


def _step(r: Any, d: Any, du: Any, dv: Any) -> tuple[Any, Any]:
    """How far along two tangents a way of ``r`` leads, but for what of it is along ``d``."""
    inverse = dr.rcp(dr.dot(dr.cross(du, dv), d))
    return dr.dot(d, dr.cross(r, dv)) * inverse, dr.dot(d, dr.cross(du, r)) * inverse


def _unit(vector: Any) -> Any:
    """The vector over its length; zero if that is zero."""
    # Over the largest component first, so that squares neither overflow nor vanish.
    largest = dr.max(dr.abs(vector))
    vector = dr.select(largest > 0, vector / largest, 0)
    squared = dr.squared_norm(vector)
    return dr.select(squared > 0, vector * dr.rsqrt(squared), 0)
