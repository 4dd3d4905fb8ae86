"""The limit surface on the device: evaluated at any parameters, and intersected by rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..mesh.shared import Content, LaterArray, Shared
from .array_types import ArrayTypes, Float, FloatBuffer, Index, Index4, Mask, Ray, Vector2, Vector3
from .coefficient_map import CoefficientMap
from .element_walk import ElementWalk, Location
from .line_intersection import MISSED, ON_LINE, LineHits, LineIntersection, Lines
from .nearest_location import NearestLocation, NearestPoints
from .piece_kernel import DIFFERENCE, PatchValues, PieceKernel
from .surface_points import NearestSurfacePoints, RandomSurfacePoints, SurfaceHits, SurfacePoints
from .vectors import cross, over, rounding, unit
from .vertex_kernel import coordinates_expected

if TYPE_CHECKING:
    from ..patches import PieceTable, SamplingCells
    from .displacement import Displacement
    from .line_intersection import AnyPiece

# Points this near to a line are on it, in lengths of the derivatives there.
NEAR_LINE = 1e-4

_LOADED: Shared[LaterArray] = Shared()


class SurfaceKernel:
    """The limit surface of a cage on the device; see `LimitSurface.on_device`."""

    def __init__(
        self,
        table: PieceTable,
        float_type: type,  # Flat Dr.Jit array, such as ``drjit.llvm.ad.Float``
        *,
        # Whether to evaluate by Stam's form, (9) and (11): with the first term, which the stabilised form leaves out
        use_stam: bool = False,
        cells: Callable[[], SamplingCells] | None = None,  # Makes what `sample` draws from, when it is first asked
    ) -> None:
        self.types = ArrayTypes.of(float_type)
        self._cells = cells
        self._patches = PieceKernel.shared(table, float_type, use_stam=use_stam)
        self.walk = self._patches.walk  # Over the surface's elements
        # If there is one, the displaced surface is evaluated and intersected. Derivatives reach heights and their
        # scale, too.
        self.displacement: Displacement | None = None
        self._control_count = table.control_count
        self._map = CoefficientMap.shared(table, float_type)
        self.coefficients: FloatBuffer = float_type()  # Of all pieces, see `PieceTable`, as control points make them
        self._loaded: LaterArray | None = None

    def set_control_points(self, points: FloatBuffer) -> None:
        """Take over control points. What is evaluated afterwards has derivatives by them.

        Parameters
        ----------
        points : flat array, 3-vector, or (n, 3) array of NumPy or Dr.Jit
            x, y, z of each.

        Raises
        ------
        ValueError
            If there are more or fewer than before.
        """
        if dr.is_vector_v(points) or dr.is_tensor_v(points):
            points = dr.ravel(points)
        elif not dr.is_array_v(points):
            points = self.types.floats(np.ravel(points))
        if len(points) != 3 * self._control_count:
            raise ValueError(coordinates_expected(len(points), self._control_count))
        self._loaded = None
        self.take(self._map(points))

    def load(self, positions: NDArray[np.floating]) -> None:
        """Take over control points, ``(n, 3)``, that other kernels may have: equal ones share their coefficients."""
        self._loaded = _LOADED.get((self._map, Content(positions)), LaterArray)
        self.take(self._loaded.get(lambda: self._map(self.types.floats(positions.ravel()))))

    def attach(self, points: FloatBuffer) -> None:
        """Attach derivatives by the control points once more, without making coefficients."""
        self.take(self._map(points, dr.detach(self.coefficients)))

    def take(self, coefficients: FloatBuffer) -> None:
        """Take over coefficients, maybe equal ones with other derivatives."""
        # Literals would be compiled into kernels.
        dr.make_opaque(coefficients)
        # Assign in place, because others may hold a reference to the array.
        self.coefficients[:] = coefficients

    def evaluate(
        self, element: Index | Location, uv: Vector2 | None = None, corner: Index = 0, derivatives: int = 1
    ) -> SurfacePoints:
        """Evaluate points, normals and tangents.

        Differentiable with respect to the control points and the parameters, forward and backward.

        Parameters
        ----------
        element : index array, or Location
            0-based, as for `LimitSurface.evaluate`; or the location of a result, without ``uv`` and ``corner``.
        uv : 2-vector
            Parameters, in the domain, seen from the corner.
        corner : index array
        derivatives : 1 or 2
            2 adds those of the normals.

        Raises
        ------
        TypeError
            If ``uv`` is missing beside an element, or given beside a location.
        """
        return self.at(self._location(element, uv, corner), derivatives=derivatives)

    def _location(self, element: Index | Location, uv: Vector2 | None, corner: Index) -> Location:
        if isinstance(element, Location) is (uv is not None):
            raise TypeError("expected a location alone, or an element and uv")
        return element if uv is None else self.walk.at(element, uv[0], uv[1], corner)

    def intersect(
        self, ray: Ray, element: Index | Location, uv: Vector2 | None = None, corner: Index = 0, derivatives: int = 1
    ) -> SurfaceHits:
        """Find where rays intersect the surface, near given parameters.

        Differentiable with respect to the control points and the ray: points stay on the ray.

        Parameters
        ----------
        ray : object
            With an origin ``o`` and a direction ``d``, 3-vectors, such as Mitsuba's rays.
        element, uv, corner, derivatives
            As for `evaluate`: where to begin.
        """
        vector3 = self.types.vector3
        o, d = vector3(ray.o), vector3(ray.d)
        start = self._location(element, uv, corner)
        # From the foot of the starting point, as single precision loses digits over long distances.
        along, away = dr.detach(d), dr.detach(o)
        foot = self.at(start, moves=False).p - away
        foot = away + along * (dr.dot(foot, along) / dr.squared_norm(along))
        hits = self.line_hits(foot, along, start)
        lines = Lines(o, d, hits.kind == ON_LINE)
        found = self.at(hits.location, derivatives=derivatives, lines=lines, values=hits.values)
        along_ray = found.p - o
        t = dr.dot(along_ray, d) / dr.squared_norm(d)
        off = dr.squared_norm(dr.detach(along_ray - d * t))
        near = dr.square(NEAR_LINE) * dr.maximum(dr.squared_norm(found.dp_du), dr.squared_norm(found.dp_dv))
        # Beside extraordinary points, rounding errors exceed that.
        size = dr.squared_norm(dr.detach(found.p)) + dr.squared_norm(dr.detach(along_ray))
        is_on = off < dr.maximum(near, dr.square(rounding(self.types)) * size)
        t = dr.select((hits.kind != MISSED) & is_on, t, dr.inf)
        return SurfaceHits(**vars(found), t=t)

    def closest(
        self,
        points: Vector3,
        element: Index | Location,
        uv: Vector2 | None = None,
        corner: Index = 0,
        derivatives: int = 1,
    ) -> NearestSurfacePoints:
        """Find the nearest points of the surface, from given parameters down.

        The distance falls on the way, across elements, and along borders and creases where it would fall beyond these.
        So what is found is a minimum, but not always the least: `LimitSurface.closest_point` finds that.

        Differentiable with respect to the control points and the points: what is found follows them, and stays the
        nearest point. On a border or a crease it stays there, and at a corner it stays where it is.

        Parameters
        ----------
        points : 3-vector
            In the space of the control points.
        element, uv, corner, derivatives
            As for `evaluate`: where to begin.
        """
        points = self.types.given(self.types.vector3, points)
        search = NearestLocation(self.types, self.walk, partial(self._patches.piece, dr.detach(self.coefficients)))
        start = self._location(element, uv, corner)
        start = Location(start.half_edge, dr.detach(start.u), dr.detach(start.v))
        location, nearest = search.found(dr.detach(points), start)
        found = self.at(location, derivatives=derivatives, nearest=replace(nearest, p=points))
        return NearestSurfacePoints(**vars(found), distance=dr.norm(points - found.p))

    def sample(self, choice: Float, inside: Vector2, derivatives: int = 1) -> RandomSurfacePoints:
        """Draw points of the surface from random numbers.

        Each number gives a point, so points are not exactly uniform by area: their density is ``pdf``, and ``1 / pdf``
        weighs them. It is within some ten percent of the mean but around extraordinary points. When control points
        move, parameters are drawn as before, and the density is that of the moved surface.

        Differentiable with respect to the control points; parameters stay.

        Parameters
        ----------
        choice : float array
            In [0, 1): chooses a cell of the surface.
        inside : 2-vector
            In [0, 1) each: chooses a point there.
        derivatives : int
            As for `evaluate`.

        Raises
        ------
        ValueError
            If the kernel was made without cells.
        """
        location, density = self._sampler.drawn(choice, inside)
        found = self.at(location, derivatives=derivatives)
        return RandomSurfacePoints(**vars(found), pdf=over(density, dr.norm(cross(found.dp_du, found.dp_dv))))

    @cached_property
    def _sampler(self) -> AreaSampler:
        if self._cells is None:
            raise ValueError("the kernel was made without cells to draw from; expected one from LimitSurface.on_device")
        return AreaSampler(self._cells(), self.types, self.walk)

    def at(
        self,
        location: Location,
        active: Mask = True,
        derivatives: int = 1,  # 2 adds those of the normals
        *,
        # With these, derivatives follow the points at which the lines intersect the surface; else the location stays.
        # Beside extraordinary points, those of ``dp_du`` and ``dp_dv`` are of the location as it is, in any case.
        lines: Lines | None = None,
        nearest: NearestPoints | None = None,  # With these, derivatives follow the points that are nearest to them
        moves: bool = True,  # Whether there are derivatives by the control points, and by what displaces the surface
        # As `line_hits` has found them there, which saves time where there are no derivatives
        values: PatchValues | None = None,
    ) -> SurfacePoints:
        """Evaluate the surface."""
        coefficients = self.coefficients if moves else dr.detach(self.coefficients)
        if self.displacement is None or moves:
            return self._at(location, active, derivatives, lines, nearest, coefficients, values)
        with dr.suspend_grad(*self.displacement.variables()):
            return self._at(location, active, derivatives, lines, nearest, coefficients, values)

    def _at(
        self,
        location: Location,
        active: Mask,
        derivatives: int,
        lines: Lines | None,
        nearest: NearestPoints | None,
        coefficients: FloatBuffer,
        values: PatchValues | None,
    ) -> SurfacePoints:
        u, v = dr.detach(location.u), dr.detach(location.v)
        arrays = [] if self.displacement is None else self.displacement.variables()
        is_moving = dr.grad_enabled(coefficients, *arrays)
        follows: Lines | NearestPoints | None = None
        if lines is not None and (is_moving or dr.grad_enabled(lines.o, lines.d)):
            follows = lines
        elif nearest is not None and (is_moving or dr.grad_enabled(nearest.p)):
            follows = nearest
        is_shifted = follows is not None or dr.grad_enabled(location.u, location.v)
        if values is None or is_moving or derivatives == 2 or is_shifted:
            piece = self._piece(coefficients, location.half_edge, u, v, active)
            evaluated = piece.values(derivatives=2 if is_shifted else derivatives)
            # Kernels then need not evaluate the surface once more.
            values = evaluated.at_values(values) if values is not None and is_moving else evaluated
        n = unit(values.normal)
        if derivatives == 1 and not is_shifted:
            return SurfacePoints(location, values.value, n, values.du, values.dv)
        # Without second derivatives, their own derivatives are not needed.
        with dr.suspend_grad(when=derivatives == 1):
            dn_du, dn_dv = _normal_derivatives(values, n)
        if not is_shifted:
            return SurfacePoints(location, values.value, n, values.du, values.dv, dn_du, dn_dv)
        steps = (location.u, location.v) if follows is None else follows.step(values)
        # Values stay, derivatives are those of the steps.
        x, y = (dr.replace_grad(self.types.float(0), each) for each in steps)  # type: ignore[func-returns-value]  # The stub is wrong.
        location, moved = Location(location.half_edge, u + x, v + y), values.shifted(x, y)
        n = n + (dr.detach(dn_du) * x + dr.detach(dn_dv) * y)
        du, dv = moved.du, moved.dv
        if lines is not None and follows is lines and piece.is_deep is not None:
            # Derivatives of tangents have no bound near extraordinary points, and would add much noise.
            du, dv = dr.select(piece.is_deep, values.du, du), dr.select(piece.is_deep, values.dv, dv)
        found = SurfacePoints(location, moved.value, n, du, dv)
        if derivatives == 1:
            return found
        by_u, by_v = _second_normal_derivatives(piece)
        dn_du, dn_dv = (
            each + (of_u * x + of_v * y) for each, of_u, of_v in zip((dn_du, dn_dv), by_u, by_v, strict=True)
        )
        return replace(found, dn_du=dn_du, dn_dv=dn_dv)

    def _piece(
        self,
        coefficients: FloatBuffer,
        half_edge: Index,
        u: Float,
        v: Float,
        active: Mask = True,
        row: Index4 | None = None,
    ) -> AnyPiece:
        """The piece of the surface in which parameters lie, displaced if there is a displacement."""
        piece = self._patches.piece(coefficients, half_edge, u, v, active, row)
        return piece if self.displacement is None else self.displacement.piece(piece, half_edge, u, v, active)

    def line_hits(
        self,
        p: Vector3,  # A point of each line, near the surface
        d: Vector3,  # Along it
        location: Location,  # Where to begin
        active: Mask = True,
        *,
        max_distance: Float = dr.inf,  # How far from the point the surface may be
        # Above zero where the surface's normal is to be along the line, below where it is to be against it: a line
        # that enters a ball also leaves it, and Newton's method may find either.
        facing: Float = 0,
    ) -> LineHits:
        """Find where lines intersect the surface near given locations, see `LineIntersection`; without derivatives."""
        with dr.suspend_grad():
            piece = partial(self._piece, dr.detach(self.coefficients))
            return LineIntersection(self.types, self.walk, piece).hits(p, d, location, active, max_distance, facing)


def _normal_derivatives(values: PatchValues, n: Vector3) -> tuple[Vector3, Vector3]:
    uu, uv, vv = values.second
    # Where the surface collapses, nothing turns: infinite derivatives times zero would not be numbers.
    inverse = over(1, dr.norm(cross(values.du, values.dv)), 0)
    changes = (cross(uu, values.dv) + cross(values.du, uv), cross(uv, values.dv) + cross(values.du, vv))
    dn_du, dn_dv = ((change - n * dr.dot(n, change)) * inverse for change in changes)
    return dn_du, dn_dv


def _second_normal_derivatives(piece: AnyPiece) -> tuple[list, list]:
    """Derivatives by u and by v of those of the unit normal: differences, without derivatives of their own."""
    step = DIFFERENCE * dr.rcp(piece.magnification)

    def at(du: Float, dv: Float) -> tuple[Vector3, Vector3]:
        values = piece.values(du, dv, 2)
        return _normal_derivatives(values, unit(values.normal))

    with dr.suspend_grad():
        per = 0.5 * dr.rcp(step)
        pairs = ((at(step, 0), at(-step, 0)), (at(0, step), at(0, -step)))
        by_u, by_v = ([(b - a) * per for b, a in zip(*ends, strict=True)] for ends in pairs)
    return by_u, by_v


class AreaSampler:
    """Draws random locations on a surface."""

    def __init__(
        self,
        cells: SamplingCells,
        types: ArrayTypes,
        walk: ElementWalk,  # Over the surface's elements
    ) -> None:
        self._types, self._walk = types, walk
        self._count = len(cells.areas)
        if not cells.areas.sum() > 0:
            raise ValueError("the surface has no area; expected one to draw points from")
        # Probabilities are differences of the rounded cumulative sums.
        until = (np.cumsum(cells.areas) / cells.areas.sum()).astype(types.numpy_float)
        until[-1] = 1
        chances = np.diff(until.astype(np.float64), prepend=0)
        size = np.abs(np.linalg.det(cells.matrices)) * (0.5 if walk.domain.corner_count == 3 else 1)
        self._until = types.floats(until)
        self._start = types.indices(cells.half_edge)
        self._matrices, self._offsets = types.floats(cells.matrices), types.floats(cells.offsets)
        self._density = types.floats(chances / size)

    def drawn(
        self,
        choice: Float,  # In [0, 1)
        inside: Vector2,  # In [0, 1) each
    ) -> tuple[Location, Float]:
        """Locations, and their density by the parameters of their elements."""
        types = self._types

        def is_before(index: Index) -> Mask:
            return types.fetch(types.float, self._until, index) <= choice

        number = types.index(dr.binary_search(0, self._count - 1, is_before))
        x, y = inside[0], inside[1]
        if self._walk.domain.corner_count == 3:
            is_beyond = x + y > 1
            x, y = dr.select(is_beyond, 1 - x, x), dr.select(is_beyond, 1 - y, y)
        a, b, c, d = types.fetch(types.vector4, self._matrices, number)
        offset = types.fetch(types.vector2, self._offsets, number)
        u, v = dr.fma(a, x, dr.fma(b, y, offset[0])), dr.fma(c, x, dr.fma(d, y, offset[1]))
        half_edge = types.fetch(types.index, self._start, number)
        return Location(half_edge, u, v), types.fetch(types.float, self._density, number)
