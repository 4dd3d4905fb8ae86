"""The limit surface on the device: evaluation, ray intersection, nearest points and random points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from ..mesh.shared import shared
from ..patches.area_samples import SamplingCells
from ..patches.piece_table import PieceTable
from .algebra import AffineMap, cross, over, unit
from .array_types import ArrayTypes, Float, FloatBuffer, Index, Index4, Mask, Ray, Vector2, Vector3
from .line_intersection import MISSED, ON_LINE, Lines, line_hits
from .linear_maps import CoefficientMap, ControlValues, attached
from .locations import Location
from .piece_kernel import PatchValues, Piece, PieceKernel, differences
from .vertex_kernel import coordinates_expected

if TYPE_CHECKING:
    from .displacement import Displacement
    from .nearest_points import NearestPoints

# Largest distance of a hit from its line, relative to the longest derivative of the surface; used by `intersect`.
NEAR_LINE = 1e-4


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a surface.

    Attributes
    ----------
    location : Location
        Element and parameters.
    p : 3-vector
        In the space of the control points.
    n : 3-vector
        Unit normal along ``dp_du x dp_dv``. Where the surface has none, as on folds, zero or dominated by rounding.
    dp_du, dp_dv : 3-vectors
        Derivatives by the parameters of the location.
    dn_du, dn_dv : 3-vectors, or None
        Derivatives of the normal, if they were requested.
    t : float array, or None
        Of `SurfaceKernel.intersect`: ray parameter, in lengths of the direction; infinite where the ray does not
        intersect the surface nearby.
    distance : float array, or None
        Of `SurfaceKernel.closest`: distance from the given points.
    pdf : float array, or None
        Of `SurfaceKernel.sample`: probability density by area.
    """

    location: Location
    p: Vector3
    n: Vector3
    dp_du: Vector3
    dp_dv: Vector3
    dn_du: Vector3 = None
    dn_dv: Vector3 = None
    t: Float = None
    distance: Float = None
    pdf: Float = None

    def placed(self, to_world: AffineMap) -> SurfacePoints:
        """Transform the points to another space."""
        normal = to_world.normal(self.n)
        n = unit(normal)
        dp_du, dp_dv = to_world.direction(self.dp_du), to_world.direction(self.dp_dv)
        points = SurfacePoints(self.location, to_world.point(self.p), n, dp_du, dp_dv)
        if self.dn_du is None:
            return points
        inverse = over(1, dr.norm(normal), 0)
        changes = (to_world.normal(derivative) * inverse for derivative in (self.dn_du, self.dn_dv))
        dn_du, dn_dv = (change - n * dr.dot(n, change) for change in changes)
        return replace(points, dn_du=dn_du, dn_dv=dn_dv)


class SurfaceKernel:
    """The limit surface of a cage on the device; see `LimitSurface.on_device`."""

    def __init__(
        self,
        table: PieceTable,
        float_type: type,  # Flat Dr.Jit array, such as ``drjit.llvm.ad.Float``
        *,
        cells: Callable[[], SamplingCells] | None = None,  # Makes the cells for `sample` when it is first called
    ) -> None:
        self.types = ArrayTypes(float_type)
        self._make_cells = cells
        self._patches = shared(PieceKernel, table, float_type)
        self.walk = self._patches.walk  # Over the surface's elements
        # Displacement of the surface. All results are those of the displaced surface, and differentiable with respect
        # to the heights and their scale.
        self.displacement: Displacement | None = None
        self._control_count = table.control_count
        self.values = ControlValues(self.types, 3, CoefficientMap, table)  # Its control points

    def set_control_points(self, points: FloatBuffer) -> None:
        """Set the control points. Later results are differentiable with respect to them.

        Parameters
        ----------
        points : flat array, 3-vector, or (n, 3) array of NumPy or Dr.Jit
            x, y, z of each control point.

        Raises
        ------
        ValueError
            If the number of control points is not that of the cage.
        """
        if dr.is_vector_v(points) or dr.is_tensor_v(points):
            points = dr.ravel(points)
        elif not dr.is_array_v(points):
            points = self.types.floats(np.ravel(points))
        if len(points) != 3 * self._control_count:
            raise ValueError(coordinates_expected(len(points), self._control_count))
        self.values.set(points)

    @property
    def coefficients(self) -> FloatBuffer:
        """Coefficients of all pieces, see `PieceTable`."""
        return self.values.flat

    def evaluate(
        self, element: Index | Location, uv: Vector2 | None = None, corner: Index = 0, derivatives: int = 1
    ) -> SurfacePoints:
        """Evaluate points, normals and tangents.

        Differentiable with respect to the control points and the parameters, forward and backward.

        Parameters
        ----------
        element : index array, or Location
            0-based element, as for `LimitSurface.evaluate`; or the location of a result, without ``uv`` and ``corner``.
        uv : 2-vector
            Parameters in the domain, seen from the corner.
        corner : index array
        derivatives : 1 or 2
            2 adds the derivatives of the normals.

        Raises
        ------
        TypeError
            If an element is given without ``uv``, or a location with ``uv``.
        """
        return self.at(self._location(element, uv, corner), derivatives=derivatives)

    def _location(self, element: Index | Location, uv: Vector2 | None, corner: Index) -> Location:
        if isinstance(element, Location) is (uv is not None):
            raise TypeError("expected a location alone, or an element and uv")
        return element if uv is None else self.walk.at(element, uv[0], uv[1], corner)

    def intersect(
        self, ray: Ray, element: Index | Location, uv: Vector2 | None = None, corner: Index = 0, derivatives: int = 1
    ) -> SurfacePoints:
        """Intersect rays with the surface near given parameters.

        Differentiable with respect to the control points and the ray: hits stay on the ray.

        Parameters
        ----------
        ray : object
            With an origin ``o`` and a direction ``d``, 3-vectors, such as Mitsuba's rays.
        element, uv, corner, derivatives
            As for `evaluate`: starting point of the search.
        """
        vector3 = self.types.vector3
        o, d = vector3(ray.o), vector3(ray.d)
        start = self._location(element, uv, corner)
        # Start from the projection of the starting point onto the line: long distances lose digits.
        direction, origin = dr.detach(d), dr.detach(o)
        projection = self.at(start, moves=False).p - origin
        projection = origin + direction * (dr.dot(projection, direction) / dr.squared_norm(direction))
        location, kind, known = self.line_hits(projection, direction, start)
        lines = Lines(o, d, kind == ON_LINE)
        points = self.at(location, derivatives=derivatives, constraint=lines, known=known)
        along_ray = points.p - o
        t = dr.dot(along_ray, d) / dr.squared_norm(d)
        squared_distance = dr.squared_norm(dr.detach(along_ray - d * t))
        tolerance = dr.square(NEAR_LINE) * dr.maximum(dr.squared_norm(points.dp_du), dr.squared_norm(points.dp_dv))
        # Next to extraordinary points, rounding errors exceed this distance.
        squared_size = dr.squared_norm(dr.detach(points.p)) + dr.squared_norm(dr.detach(along_ray))
        is_on_line = squared_distance < dr.maximum(tolerance, dr.square(self.types.rounding) * squared_size)
        t = dr.select((kind != MISSED) & is_on_line, t, dr.inf)
        return replace(points, t=t)

    def closest(
        self,
        points: Vector3,
        element: Index | Location,
        uv: Vector2 | None = None,
        corner: Index = 0,
        derivatives: int = 1,
    ) -> SurfacePoints:
        """Find locally nearest points of the surface by descent from given parameters.

        The descent crosses elements, and follows a border or a crease that it cannot cross. The result is a local
        minimum of the distance; `LimitSurface.closest_point` finds the global one.

        Differentiable with respect to the control points and the points: the result remains the nearest point. On a
        border or a crease it moves along this only, and at a corner it does not move.

        Parameters
        ----------
        points : 3-vector
            In the space of the control points.
        element, uv, corner, derivatives
            As for `evaluate`: starting point of the search.
        """
        from .nearest_points import nearest_locations

        points = self.types.converted(self.types.vector3, points)
        start = dr.detach(self._location(element, uv, corner))
        piece_at = partial(self._patches.piece, dr.detach(self.coefficients))
        location, nearest = nearest_locations(self.walk, piece_at, dr.detach(points), start)
        surface = self.at(location, derivatives=derivatives, constraint=replace(nearest, p=points))
        return replace(surface, distance=dr.norm(points - surface.p))

    def sample(self, choice: Float, inside: Vector2, derivatives: int = 1) -> SurfacePoints:
        """Draw points of the surface from random numbers.

        No number is rejected, so points are not exactly uniform by area: their density is ``pdf``, and their weight is
        ``1 / pdf``. The density is within some ten percent of its mean, except around extraordinary points. When
        control points move, the same numbers give the same parameters, and ``pdf`` is the density on the moved surface.

        Differentiable with respect to the control points, for fixed parameters.

        Parameters
        ----------
        choice : float array
            In [0, 1): selects a cell of the surface.
        inside : 2-vector
            In [0, 1) each: selects a point in the cell.
        derivatives : int
            As for `evaluate`.

        Raises
        ------
        ValueError
            If the kernel was made without cells.
        """
        types = self.types
        until, density, start, matrices, offsets = self._cells

        def is_before(index: Index) -> Mask:
            return dr.gather(types.float, until, index) <= choice

        cell = types.index(dr.binary_search(0, len(until) - 1, is_before))
        x, y = inside[0], inside[1]
        if self.walk.domain.corner_count == 3:
            is_beyond = x + y > 1
            x, y = dr.select(is_beyond, 1 - x, x), dr.select(is_beyond, 1 - y, y)
        a, b, c, d = dr.gather(types.vector4, matrices, cell)
        offset = dr.gather(types.vector2, offsets, cell)
        u, v = dr.fma(a, x, dr.fma(b, y, offset[0])), dr.fma(c, x, dr.fma(d, y, offset[1]))
        points = self.at(Location(dr.gather(types.index, start, cell), u, v), derivatives=derivatives)
        by_parameters: Float = dr.gather(types.float, density, cell)
        return replace(points, pdf=over(by_parameters, dr.norm(cross(points.dp_du, points.dp_dv))))

    @cached_property
    def _cells(self) -> tuple[FloatBuffer, ...]:
        """Cumulative probabilities of cells, and densities by their parameters, half-edges, matrices and offsets."""
        if self._make_cells is None:
            raise ValueError("the kernel was made without cells to draw from; expected one from LimitSurface.on_device")
        types, cells = self.types, self._make_cells()
        if not cells.areas.sum() > 0:
            raise ValueError("the surface has no area; expected one to draw points from")
        # Probabilities are differences of the rounded cumulative sums.
        cumulative = (np.cumsum(cells.areas) / cells.areas.sum()).astype(types.numpy_float)
        cumulative[-1] = 1
        size = np.abs(np.linalg.det(cells.matrices)) * (0.5 if self.walk.domain.corner_count == 3 else 1)
        density = np.diff(cumulative.astype(np.float64), prepend=0) / size
        floats = (types.floats(values) for values in (cumulative, density, cells.matrices, cells.offsets))
        until, density, matrices, offsets = floats
        return until, density, types.indices(cells.half_edge), matrices, offsets

    def at(
        self,
        location: Location,
        active: Mask = True,
        derivatives: int = 1,  # 2 adds the derivatives of the normals
        *,
        # Lines hit at the points, or points that they are nearest to, which derivatives follow; by default none
        constraint: Lines | NearestPoints | None = None,
        moves: bool = True,  # Whether results are attached to the control points and the displacement
        known: PatchValues | None = None,  # Values of `line_hits`: save the evaluation where nothing is differentiated
    ) -> SurfacePoints:
        """Evaluate the surface."""
        coefficients = self.coefficients if moves else dr.detach(self.coefficients)
        variables = [] if self.displacement is None else self.displacement.variables()
        with dr.suspend_grad(*variables, when=bool(variables) and not moves):
            is_moving = dr.grad_enabled(coefficients, *variables)
            if constraint is not None and not (is_moving or dr.grad_enabled(*constraint.variables)):
                constraint = None
            if known is None or derivatives == 2:
                return self._traced(coefficients, location, active, derivatives, constraint)
            points, lines = _points(location, known), cast("Lines | None", constraint)
            if not (is_moving or lines):
                return points
            parts: Any
            if self.displacement is None and dr.flag(dr.JitFlag.SymbolicScope):
                parts = self._attached_later(points, type(coefficients)(coefficients), active, lines)
            else:
                # With the known primal values, Dr.Jit omits the evaluation from kernels that only need derivatives.
                traced: Any = _parts(self._traced(coefficients, location, active, 1, lines))
                parts = dr.replace_grad(_parts(points), traced)  # type: ignore[func-returns-value]  # The stub is wrong.
            *vectors, u, v = parts
            return SurfacePoints(Location(location.half_edge, u, v), *vectors)

    def _attached_later(
        self, points: SurfacePoints, coefficients: FloatBuffer, active: Mask, lines: Lines | None
    ) -> tuple[Vector3 | Float, ...]:
        """Attach known hits to the coefficients and the lines, by code that is traced when derivatives are computed.

        Dr.Jit traces a call for its values first, and again for derivatives.
        """
        ends = () if lines is None else lines.variables

        def traced(coefficients: FloatBuffer, *ends: Vector3) -> tuple[Vector3 | Float, ...]:
            moved = lines and replace(lines, o=ends[0], d=ends[1])
            return _parts(self._traced(coefficients, points.location, active, 1, moved))

        def propagated(mode: dr.ADMode, start: Any, changes: Any) -> None:
            dr.accum_grad(start, changes)
            dr.enqueue(mode, start)
            dr.traverse(mode, dr.ADFlag.ClearNone)

        def backward(*gradients: Vector3 | Float) -> tuple[Vector3 | Float, ...]:
            with dr.resume_grad():
                copies = _copies(ends)
                # Sums go to the gradient of the coefficients themselves: a call cannot make arrays for them.
                propagated(dr.ADMode.Backward, traced(coefficients, *copies), gradients)
            return (0, *dr.grad(copies))

        def forward(changes: tuple[Vector3 | Float, ...]) -> tuple[Vector3 | Float, ...]:
            with dr.resume_grad():
                copies = _copies((coefficients, *ends))
                outputs = traced(*copies)
                propagated(dr.ADMode.Forward, copies, (dr.grad(coefficients), *changes[1:]))
            return dr.grad(outputs)

        # Attached to all coefficients by the first one. With a literal index, Dr.Jit would copy it at once.
        first = points.location.half_edge >> 31
        argument = dr.gather(self.types.float, coefficients, first, active), *ends
        return attached(_parts(points), argument, forward, backward)

    def _traced(
        self, coefficients: FloatBuffer, location: Location, active: Mask, derivatives: int, constraint: Any
    ) -> SurfacePoints:
        fixed = dr.detach(location)
        piece = self._piece(coefficients, fixed.half_edge, fixed.u, fixed.v, active)
        slides = constraint is not None or dr.grad_enabled(location.u, location.v)
        values = piece.values(derivatives=2 if slides else derivatives)
        if not slides:
            return _points(location, values, derivatives)
        step = (location.u, location.v) if constraint is None else constraint.step(values)
        points = _sliding(piece, fixed, values, step, derivatives)
        if isinstance(constraint, Lines) and piece.is_deep is not None:
            # Derivatives of tangents are unbounded near extraordinary points, and would add noise.
            dp_du = dr.select(piece.is_deep, values.du, points.dp_du)
            dp_dv = dr.select(piece.is_deep, values.dv, points.dp_dv)
            points = replace(points, dp_du=dp_du, dp_dv=dp_dv)
        return points

    def _piece(
        self, coefficients: FloatBuffer, half_edge: Index, u: Float, v: Float, active: Mask = True, row: Index4 = None
    ) -> Piece:
        piece = self._patches.piece(coefficients, half_edge, u, v, active, row)
        return piece if self.displacement is None else self.displacement.piece(piece, half_edge, u, v, active)

    def line_hits(
        self, p: Vector3, d: Vector3, location: Location, active: Mask = True, **limits: Float
    ) -> tuple[Location, Index, PatchValues]:
        """Intersect lines with the surface near given locations, see `line_hits`. Results are detached."""
        # Optimised loops are traced twice, which takes longer than it saves.
        with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
            piece = partial(self._piece, dr.detach(self.coefficients))
            return line_hits(self.walk, piece, p, d, location, active, **limits)


def _parts(points: SurfacePoints) -> tuple[Vector3 | Float, ...]:
    return points.p, points.n, points.dp_du, points.dp_dv, points.location.u, points.location.v


def _copies(arrays: tuple) -> tuple:
    """Copies that are differentiated where the arrays are, without what these were computed from."""
    copies = dr.detach(arrays)
    dr.enable_grad([copy for copy, array in zip(copies, arrays, strict=True) if dr.grad_enabled(array)])
    return copies


def _points(location: Location, values: PatchValues, derivatives: int = 1) -> SurfacePoints:
    n = unit(values.normal)
    changes = _normal_derivatives(values, n) if derivatives == 2 else ()
    return SurfacePoints(location, values.value, n, values.du, values.dv, *changes)


def _sliding(
    piece: Piece,
    location: Location,  # Detached
    values: PatchValues,  # With second derivatives
    step: tuple[Float, Float],  # Numbers whose derivatives are those of u and v
    derivatives: int,
) -> SurfacePoints:
    """Points attached to parameters that move."""
    n = unit(values.normal)
    # If the derivatives of normals are not returned, they need not be differentiable.
    with dr.suspend_grad(when=derivatives == 1):
        dn_du, dn_dv = _normal_derivatives(values, n)
    # Steps of value zero that carry the derivatives of the parameters.
    du, dv = (dr.replace_grad(piece.kernel.types.float(0), number) for number in step)  # type: ignore[func-returns-value]  # The stub is wrong.
    shifted = values.shifted(du, dv)
    n = n + (dr.detach(dn_du) * du + dr.detach(dn_dv) * dv)
    location = Location(location.half_edge, location.u + du, location.v + dv)
    points = SurfacePoints(location, shifted.value, n, shifted.du, shifted.dv)
    if derivatives == 1:
        return points
    by_u, by_v = differences(lambda du, dv: _normal_derivatives(piece.values(du, dv, 2)), piece.magnification)
    dn_du, dn_dv = (x + (x_u * du + x_v * dv) for x, x_u, x_v in zip((dn_du, dn_dv), by_u, by_v, strict=True))
    return replace(points, dn_du=dn_du, dn_dv=dn_dv)


def _normal_derivatives(values: PatchValues, n: Vector3 | None = None) -> tuple[Vector3, Vector3]:
    n = unit(values.normal) if n is None else n
    uu, uv, vv = values.second
    # Zero where the surface collapses: infinite derivatives times zero would be NaN.
    inverse = over(1, dr.norm(cross(values.du, values.dv)), 0)
    changes = (cross(uu, values.dv) + cross(values.du, uv), cross(uv, values.dv) + cross(values.du, vv))
    dn_du, dn_dv = ((change - n * dr.dot(n, change)) * inverse for change in changes)
    return dn_du, dn_dv
