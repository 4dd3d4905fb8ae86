"""The limit surface as a traced shape of Mitsuba 3.10, without triangles; Mitsuba 3.9 never uses this module.

In Mitsuba 3.10, classes of Python derive from ``mi.Shape``, and Dr.Jit traces their ``ray_intersect_preliminary`` when
a scene is loaded (pull request 1967). Public are the pull request's description, its test, and an add-on for Blender
that has such a shape. They show how the methods below are called and what they return; that a shape has primitives with
boxes of their own; that tracing takes over arrays as they lie in memory and refuses scatters. Not public is the rest,
and nothing here has run in Mitsuba 3.10: whether ``prim_uv`` arrives where it is asked for (the hit is found once more
instead), whether a scene traces anew and asks for new boxes when parameters have changed, what silhouettes and emitters
need of a shape (none is offered: no area lights, no derivatives of outlines), and whether symbolic loops in an
intersection function run on every backend, as a fractal in the pull request's notebook suggests.
"""

from __future__ import annotations

import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..kernels import Placement
from ..kernels.domain_map import clamped
from ..kernels.element_walk import Location
from ..kernels.line_meeting import Lines, along_tangents
from ..kernels.surface_kernel import SurfaceKernel
from ..kernels.surface_points import SurfacePoints
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..patches import PatchTable, PieceTable
from ..patches.piece_table import PATCH
from ..schemes import SchemeError
from ..schemes.domain import FloatArray, ParameterDomain
from ..surface import LimitSurface
from .parameters import read_parameters
from .property_values import errors_about
from .vertices import require_finite

FIRST_VERSION = (3, 10)
# Of `mi.RayFlags` in 3.10; those of 3.9 have other names and values.
NORMAL_PARTIALS, FOLLOW_SHAPE, DETACH_SHAPE = 0x2, 0x4, 0x8

# How often the domain is quartered for the starts of Newton's method: it begins at the middle of each part.
START_LEVELS = 2
# Newton's steps from each start. Three or four suffice where it converges.
STEPS = 10
# Longest step, in parameters: polynomials may be far off outside their domain.
LONGEST_STEP = 0.5
# A shorter step leads nowhere else in single precision.
STILL = 1e-6
# A point this near to a ray is on it, relative to its distance and its coordinates: some roundings of single precision.
# It closes the seams between primitives.
ON_RAY = 1e-6
# Boxes are larger by this, relative to the largest coordinate, as points are rounded in single precision.
BOX_MARGIN = 2.0**-20
# Weights that are zero but for rounding.
ZERO_WEIGHT = 1e-12


def traced_problem(variant: Any) -> str | None:
    """Why surfaces cannot be traced in a variant of Mitsuba; None if they can."""
    version = tuple(int(number) for number in re.findall(r"\d+", str(mi.__version__))[:2])
    if version < FIRST_VERSION:
        return f"needs Mitsuba 3.10; this is {mi.__version__}"
    if not dr.is_jit_v(variant.Float):
        return "needs a variant with a backend"
    if "prim_index" not in (variant.Shape.bbox.__doc__ or "") or not hasattr(variant.Shape, "initialize"):
        return f"needs shapes that Python can derive from; those of Mitsuba {mi.__version__} have another interface"
    return None


def primitive_half_edges(patches: PatchTable) -> IntArray:
    """``(p,)`` half-edge of the elements from which each primitive's parameters are seen, in ascending order.

    A primitive is an element that fits the domain, or one corner of an element that does not.
    """
    t = patches.elements
    half_edges = np.arange(t.half_edge_count)
    face = t.face_of(half_edges)
    return half_edges[(half_edges == t.face_offsets[face]) | ~patches.is_whole[face]]


def primitive_boxes(table: PieceTable, positions: FloatArray) -> FloatArray:
    """``(p, 2, 3)`` lowest and highest coordinates of the one-ring of each primitive.

    They hold the primitive if the scheme's weights are not negative: refined points are then averages, on borders, too.

    Parameters
    ----------
    table : PieceTable
    positions : (n, 3) float
        Control points.
    """
    points = positions if table.refinement is None else table.refinement @ positions
    boxes = []
    for first, patch_count, control_count, _ in table.classes.tolist():
        controls = table.controls[first : first + patch_count * control_count].reshape(control_count, patch_count)
        ring = points[controls]
        boxes.append(np.stack([ring.min(axis=0), ring.max(axis=0)], axis=1))
    first_patch = np.array(ragged.starts(table.classes[:, 1]))
    box = np.concatenate(boxes)[first_patch[table.half_edges[:, 3]] + table.patch_codes // PATCH]
    # An element of a cage that has been refined once has several patches.
    begins = primitive_half_edges(table.patches)
    low, high = np.minimum.reduceat(box[:, 0], begins), np.maximum.reduceat(box[:, 1], begins)
    return np.stack([low, high], axis=1)


def require_averages(surface: LimitSurface) -> None:
    """Check that refined points are averages of control points.

    Raises
    ------
    SchemeError
        If the scheme has negative weights, so that a surface may leave the boxes of its one-rings.
    """
    least = surface.scheme.refine(surface.patches.topology).stencils.matrix.data.min()
    if least < -ZERO_WEIGHT:
        raise SchemeError(
            f"{surface.cage.source.name}: the scheme {surface.scheme.name} has the weight {least}; expected none below "
            "0, as tracing needs boxes of control points that hold the surface"
        )


def starts_in(domain: ParameterDomain, levels: int) -> FloatArray:
    """``(s, 2)`` middles of the copies of a domain that has been divided some times."""
    starts = domain.corners.mean(axis=0, keepdims=True)
    for _ in range(levels):
        starts = np.concatenate([child.inverse()(starts) for child in domain.children])
    return starts


class TracedSurface:
    """What a ray tracer asks a limit surface.

    Two cores answer for 0.1 to 0.4 million pairs of a ray and a primitive in a second. A ray enters the boxes of some
    20 primitives, as one-rings overlap.

    Parameters
    ----------
    variant : module
        With a backend.
    surface : LimitSurface

    Attributes
    ----------
    boxes : (p, 2, 3) float32
        Lowest and highest coordinates of each primitive in the world.

    Raises
    ------
    SchemeError
        If the scheme has negative weights.
    """

    boxes: NDArray[np.float32]

    def __init__(self, variant: Any, surface: LimitSurface) -> None:
        require_averages(surface)
        self._variant = variant
        cage = surface.cage
        self._table = PieceTable.build(surface.patches, cage.cut_mesh.vertex, cage.vertex_count)
        self._kernel = SurfaceKernel(self._table, variant.Float)
        self._domain = surface.scheme.domain
        self._half_edges = self._kernel.types.indices(primitive_half_edges(surface.patches))
        starts = starts_in(self._domain, START_LEVELS)
        self._starts, self._start_count = self._kernel.types.floats(starts), len(starts)
        low, high = cage.positions.min(axis=0), cage.positions.max(axis=0)
        self._centre = ((low + high) / 2).astype(np.float32)

    def move(self, control_points: Any, to_world: Any, *, flips: bool) -> None:
        """Take over control points; derivatives by them reach surface interactions.

        Parameters
        ----------
        control_points : flat array
            In object space.
        to_world : (4, 4) float64
        flips : bool
            Whether normals are wanted on the other side.
        """
        vector3 = self._kernel.types.vector3
        self._sign = -1.0 if (np.linalg.det(to_world[:3, :3]) < 0) != flips else 1.0
        placement = Placement.of(self._variant.Matrix4f(to_world), vector3)
        # Relative to the middle of the cage, coordinates keep their digits.
        points = placement.direction(dr.unravel(vector3, control_points) - vector3(*self._centre.tolist()))
        self._offset = placement.point(vector3(*self._centre.tolist()))
        dr.make_opaque(self._offset)
        self._kernel.set_control_points(dr.ravel(points))
        positions = np.array(dr.detach(control_points), dtype=np.float64).reshape(-1, 3)
        boxes = primitive_boxes(self._table, positions @ to_world[:3, :3].T + to_world[:3, 3])
        margin = BOX_MARGIN * np.abs(boxes).max()
        self.boxes = (boxes + np.array([[-margin], [margin]])).astype(np.float32)

    def meet(self, ray: Any, primitive: Any, active: Any, near: Any = None) -> tuple[Location, Any]:
        """Where rays meet primitives; without derivatives.

        Newton's method begins in all parts of the primitive and stays in it. From each hit that is the first so far, it
        looks for one before. The first of all counts.

        Parameters
        ----------
        ray : Ray3f
        primitive : index array
        active : mask
        near : float array, optional
            The hit is taken whose distance is the nearest to this.

        Returns
        -------
        location : Location
        t : float array
            Distance along the ray, in lengths of ``ray.d``; infinite where there is no hit.
        """
        kernel, types = self._kernel, self._kernel.types
        half_edge = types.fetch(types.index, self._half_edges, primitive, active)
        o, d, most = (dr.detach(each) for each in (types.vector3(ray.o) - self._offset, types.vector3(ray.d), ray.maxt))
        per_length = dr.rcp(dr.squared_norm(d))

        def start_at(number: Any) -> Any:
            return types.fetch(types.vector2, self._starts, dr.minimum(number, self._start_count - 1))

        def goes_on(start: Any, *_: Any) -> Any:
            return active & (start < self._start_count)

        def go(start: Any, count: Any, u: Any, v: Any, least: Any, t: Any, t_u: Any, t_v: Any) -> tuple:
            found = kernel.at(Location(half_edge, u, v), active, 2, moves=False)
            way = found.p - o
            distance = dr.dot(way, d) * per_length
            off = d * distance - way
            size = dr.norm(way) + dr.max(dr.abs(found.p))
            is_on = dr.squared_norm(off) <= dr.square(ON_RAY * size)
            rank = distance if near is None else dr.abs(distance - near)
            is_better = is_on & (distance > 0) & (distance <= most) & (rank < least)
            du, dv = along_tangents(off, d, found.dp_du, found.dp_dv)
            factor = dr.minimum(LONGEST_STEP / dr.maximum(dr.abs(du), dr.abs(dv)), 1)
            next_u, next_v = clamped(self._domain, u + du * factor, v + dv * factor)
            # Not a number where the tangents' plane holds the ray: that is no step, either.
            moves = dr.maximum(dr.abs(next_u - u), dr.abs(next_v - v)) > STILL
            before_u, before_v, has_before = _before(d * dr.sqrt(per_length), found)
            before_u, before_v = clamped(self._domain, u + before_u, v + before_v)
            has_before &= is_better
            is_last = (is_on | ~moves | (count + 1 >= STEPS)) & ~has_before
            next_start = start_at(start + 1)
            return (
                dr.select(is_last, start + 1, start),
                dr.select(is_last | has_before, 0, count + 1),
                dr.select(is_last, next_start.x, dr.select(has_before, before_u, next_u)),
                dr.select(is_last, next_start.y, dr.select(has_before, before_v, next_v)),
                dr.select(is_better, rank, least),
                dr.select(is_better, distance, t),
                dr.select(is_better, u, t_u),
                dr.select(is_better, v, t_v),
            )

        first, infinite, zero = start_at(types.index(0)), types.float(dr.inf), types.float(0)
        state = (types.index(0), types.index(0), first.x, first.y, infinite, infinite, zero, zero)
        *_, t, u, v = dr.while_loop(state, goes_on, go, mode="symbolic", label="meet_primitive")
        return Location(half_edge, u, v), t

    def ray_intersect_preliminary(self, ray: Any, primitive: Any, active: Any) -> Any:
        """The first hit of a primitive, as ``mi.Shape.ray_intersect_preliminary``."""
        variant = self._variant
        active = variant.Mask(active)
        with dr.suspend_grad():
            location, t = self.meet(ray, variant.UInt32(primitive), active)
        preliminary = dr.zeros(variant.PreliminaryIntersection3f)
        preliminary.valid = active & dr.isfinite(t)
        preliminary.t = t
        preliminary.prim_uv = variant.Point2f(location.u, location.v)
        preliminary.prim_index = primitive
        return preliminary

    def compute_surface_interaction(self, ray: Any, preliminary: Any, flags: int, active: Any) -> Any:
        """The surface at a hit, as ``mi.Shape.compute_surface_interaction``; where it is not found again, none."""
        variant, kernel, vector3 = self._variant, self._kernel, self._kernel.types.vector3
        with dr.suspend_grad():
            location, t = self.meet(ray, preliminary.prim_index, active, near=preliminary.t)
        lines = None
        if not flags & FOLLOW_SHAPE:
            lines = Lines(vector3(ray.o) - self._offset, vector3(ray.d))
        derivatives = 2 if flags & NORMAL_PARTIALS else 1
        found = kernel.at(location, active, derivatives, lines=lines, moves=not flags & DETACH_SHAPE)
        si = dr.zeros(variant.SurfaceInteraction3f)
        si.p = variant.Point3f(found.p + self._offset)
        si.t = dr.select(active & dr.isfinite(t), dr.dot(si.p - ray.o, ray.d) / dr.squared_norm(ray.d), dr.inf)
        exists = dr.squared_norm(found.n) > 0
        si.n = dr.select(exists, variant.Normal3f(found.n * self._sign), variant.Normal3f(-dr.normalize(ray.d)))
        si.sh_frame.n = si.n
        si.uv = variant.Point2f(found.location.u, found.location.v)
        si.dp_du, si.dp_dv = variant.Vector3f(found.dp_du), variant.Vector3f(found.dp_dv)
        if found.dn_du is not None:
            si.dn_du, si.dn_dv = (variant.Vector3f(each * self._sign) for each in (found.dn_du, found.dn_dv))
        si.prim_index, si.shape = preliminary.prim_index, preliminary.shape
        return si


def _before(d: Any, hit: SurfacePoints) -> tuple[Any, Any, Any]:
    """From a hit to where its ray would have met the surface before, if that curved everywhere as there.

    In the plane of the ray and the normal, the surface is nearly a parabola.
    """
    slope = dr.dot(d, hit.n)
    tangent = hit.n * slope - d
    du, dv = along_tangents(tangent, hit.n, hit.dp_du, hit.dp_dv)
    s = 2 * slope / dr.dot(hit.dn_du * du + hit.dn_dv * dv, tangent)
    return du * s, dv * s, dr.isfinite(s) & (s > 0)


def make_traced_subdivision(variant: Any, shape_class: type | None = None) -> type:
    """Make the class of the traced shape.

    Parameters
    ----------
    variant : module
    shape_class : type, optional
        Of what to derive it. (Default: the variant's ``Shape``)

    Raises
    ------
    RuntimeError
        If it is to be derived of Mitsuba's own class, and there is a `traced_problem`.
    """
    if shape_class is None:
        problem = traced_problem(variant)
        if problem is not None:
            raise RuntimeError(f"tracing a surface {problem}")
        shape_class = variant.Shape
    base: Any = shape_class

    class TracedSubdivision(base):
        """The limit surface of a control cage; parameters as those of ``subdivision`` that are not about triangles."""

        def __init__(self, props: Any) -> None:
            parameters = read_parameters(props)
            super().__init__(props)
            self._to_world, self._flips = parameters.to_world, bool(props.get("flip_normals", False))
            self.control_points = variant.Float(parameters.surface.cage.positions.ravel())
            self._traced = TracedSurface(variant, parameters.surface)
            self._move()
            self.initialize()

        def traverse(self, callback: Any) -> None:
            super().traverse(callback)
            flags = mi.ParamFlags
            callback.put("control_points", self.control_points, flags.Differentiable | flags.Discontinuous)

        def parameters_changed(self, keys: list[str]) -> None:
            if not keys or "control_points" in keys:
                self._move()
            super().parameters_changed(keys)

        def _move(self) -> None:
            with errors_about("control_points"):
                require_finite(self.control_points)
            self._traced.move(self.control_points, self._to_world, flips=self._flips)

        def primitive_count(self) -> int:
            return len(self._traced.boxes)

        def bbox(self, prim_index: int | None = None) -> Any:
            boxes = self._traced.boxes
            low, high = (boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)) if prim_index is None else boxes[prim_index]
            return variant.ScalarBoundingBox3f(low.tolist(), high.tolist())

        def ray_intersect_preliminary(self, ray: Any, prim_index: Any = 0, active: Any = True) -> Any:
            return self._traced.ray_intersect_preliminary(ray, prim_index, active)

        def compute_surface_interaction(self, ray: Any, pi: Any, ray_flags: int = 1, active: Any = True) -> Any:
            return self._traced.compute_surface_interaction(ray, pi, int(ray_flags), active)

    return TracedSubdivision
