"""Exact shading: surface interactions of the limit surface, at hits on triangles and at texture coordinates."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from ..cage.errors import warn
from ..kernels.algebra import AffineMap, added, dot, over
from ..kernels.array_types import Float, Index, IndexBuffer, Mask, Matrix4, Value, Vector2, Vector3
from ..kernels.line_intersection import ON_LINE, Lines
from ..kernels.locations import Location, TriangleLocations
from ..kernels.surface_kernel import SurfaceKernel, SurfacePoints
from ..mesh.shared import shared
from ..surface import TEXCOORDS
from ..variants import Variant
from .cage_attributes import mesh_name, spectral_upsampling
from .outlines import turn_to_seen
from .placement import Placement

if TYPE_CHECKING:
    from ..kernels.channel_kernel import ChannelKernel
    from .mesh_buffers import Triangles

# Distance at which projective integrators begin rays to points of outlines: hits at just this distance are of these.
OUTLINE = 1
# Cosine of the angle between a ray and the normals that `_turned_to_ray` turns to a silhouette.
GRAZING = 1e-2
# Tolerance when comparing texture coordinates, or parameters, of a location.
SAME_PARAMETERS = 1e-3
_NORMAL_DERIVATIVES = int(mi.RayFlags.dNSdUV) | int(mi.RayFlags.dNGdUV)
_PARAMETERS = int(mi.RayFlags.UV) | int(mi.RayFlags.dPdUV) | _NORMAL_DERIVATIVES
_KINDS = ("are on the ray", "are along the normal", "are at the triangle's parameters")
_FOLLOWS, _DETACHES = int(mi.RayFlags.FollowShape), int(mi.RayFlags.DetachShape)

# Number of fixed-point iterations of `ExactShading.hit_by_texcoords`. Each removes most of the difference between
# texture coordinates on the surface and on its triangles.
STEPS = 3


class ExactShading:
    """Completes the surface interactions of a shape.

    The line of a ray is intersected with the limit surface near the hit on a triangle. The intersection determines the
    normal, parameters, derivatives and texture coordinates of the interaction. Lines are intersected in object space,
    so that shapes with equal control points share the surface's coefficients.
    """

    def __init__(
        self,
        variant: Variant,
        shape: mi.Mesh,  # Its current material is used at each hit; not kept alive
        name: str,  # Name of the cage in messages
        kernel: SurfaceKernel,  # The surface in object space, relative to the centre of the placement
        channels: dict[str, ChannelKernel],  # Texture coordinates and attributes, by their names in the cage
        placement: Placement,
        triangles: Triangles,
    ) -> None:
        self._variant, self._name, self.kernel, self.channels = variant, name, kernel, channels
        self._shape: Callable[[], mi.Mesh | None] = weakref.ref(shape)
        # Sign of normals, relative to the surface's
        self._sign = -1.0 if shape.has_flipped_normals() else 1.0
        self._warns = True  # Of derivatives without an update, once
        self._counts: IndexBuffer = dr.zeros(kernel.types.index, len(_KINDS))
        self._texcoords = channels.get(TEXCOORDS)
        self._attributes = {mesh_name(name): channel for name, channel in channels.items() if name != TEXCOORDS}
        sizes = {name: channel.values.size for name, channel in self._attributes.items()}
        self._upsampling = spectral_upsampling(variant, sizes)
        self.to_world: Matrix4 = kernel.types.matrix4(1)  # For points relative to the centre
        self.update(placement.matrix, placement)
        self.retessellate(triangles)

    def retessellate(self, triangles: Triangles) -> None:
        """Choose the triangles of the shape, before their first hit."""
        # Shapes with the same tessellation and elements share locations.
        self._triangles = shared(TriangleLocations, triangles.table, self.kernel.walk)
        self._kept = None if triangles.kept is None else self.kernel.types.indices(triangles.kept)

    def _located(self, triangle: Index, b1: Float, b2: Float, active: Mask) -> Location:
        if self._kept is not None:
            triangle = dr.gather(self.kernel.types.index, self._kept, triangle, active)
        return self._triangles(triangle, b1, b2, active)

    def update(
        self,
        to_world: Matrix4,  # Maps points relative to the centre to world space, possibly attached to the parameter
        placement: Placement,  # Of ``to_world``
    ) -> None:
        """Set the transformation. Surface interactions are differentiable with respect to it."""
        self._are_turned = placement.mirrors
        # Assign in place, because other objects may hold a reference to the array.
        self.to_world[:] = self.kernel.types.matrix4(to_world)
        self._map = AffineMap.of(dr.detach(self.to_world), self.kernel.types.matrix4(placement.inverse()))

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose intermediate arrays: forward mode reaches a rendering only through arrays that are traversed."""
        differentiable = mi.ParamFlags.Differentiable
        callback.put("shading_coefficients", self.kernel.coefficients, differentiable)
        callback.put("shading_to_world", self.to_world, differentiable)
        for name, channel in self.channels.items():
            callback.put(f"shading_cage_{name}", channel.values.flat, differentiable)

    def complete(
        self,
        si: mi.SurfaceInteraction3f,
        # Arguments of `mi.Shape.compute_surface_interaction`
        ray: mi.Ray3f,
        preliminary: mi.PreliminaryIntersection3f,
        flags: int,  # `mi.RayFlags`
        active: Mask,
    ) -> None:
        """Complete the surface interaction at a hit on a triangle, in place."""
        kernel, vector3 = self.kernel, self.kernel.types.vector3
        # A copy, which may be kept: derivatives are traced later.
        active = type(active)(active)
        b1, b2 = dr.detach(preliminary.prim_uv)
        if self._are_turned:
            b1, b2 = b2, b1
        # Trace no derivatives that are not needed.
        moves = not flags & _DETACHES and self._is_moving()
        ray_o, ray_d = vector3(ray.o), vector3(ray.d)
        # The hit on the triangle and the ray's direction, in object space
        hit, d = self._map.inverse_point(vector3(dr.detach(si.p))), self._map.inverse_direction(dr.detach(ray_d))
        location = self._located(preliminary.prim_index, b1, b2, active)
        # Integrators begin the rays to outlines at a distance of `OUTLINE`, wherever the sensor is.
        length = dr.select(preliminary.t == OUTLINE, dr.inf, dr.detach(si.t))
        # Limit the search to the triangle's size, and to the length of the ray, whose origin is in front of the
        # surface. Both are lengths in world space along the ray, converted to object space.
        sides = vector3(dr.detach(si.dp_du)), vector3(dr.detach(si.dp_dv))
        size = dr.maximum(*(dot(side, side) for side in sides))
        squared = dot(dr.detach(ray_d), dr.detach(ray_d))
        farthest = dr.minimum(dr.sqrt(size * dr.rcp(squared)), length) * dr.sqrt(dot(d, d))
        # Negative where the ray hits the triangle from outside
        side = dot(vector3(dr.detach(si.n)), dr.detach(ray_d))
        limits = {"max_distance": farthest, "wanted_sign": side * self._sign}
        location, kind, known = kernel.line_hits(hit, d, location, active, **limits)
        self._count(kind, active)
        to_world = AffineMap.of(self.to_world) if moves and dr.grad_enabled(self.to_world) else self._map
        lines = None
        if not flags & _FOLLOWS and (moves or dr.grad_enabled(ray.o, ray.d)):
            lines = Lines(to_world.inverse_point(ray_o), to_world.inverse_direction(ray_d), kind == ON_LINE)
        order = 2 if flags & _NORMAL_DERIVATIVES else 1
        points = kernel.at(location, active, order, constraint=lines, moves=moves, known=known)
        is_before = active & (dot(dr.detach(points.p) - hit, d) < 0)
        points = points.placed(to_world)
        if flags & _PARAMETERS:
            self._set_parameters(si, points, active)
        self._fill_in(si, points, is_before, ray_o, ray_d, side)

    def _count(self, kind: Index, active: Mask) -> None:
        if mi.log_level() > mi.LogLevel.Debug:
            return
        counts = np.array(self._counts).tolist()
        if sum(counts):
            shares = ", ".join(
                f"{count / sum(counts):.2%} {where}" for count, where in zip(counts, _KINDS, strict=True)
            )
            log: Any = mi.Log  # Mitsuba's stub declares this function as an object.
            log(mi.LogLevel.Debug, f"{self._name}: of {sum(counts)} hits, {shares}")
        self._counts = dr.zeros(self.kernel.types.index, len(_KINDS))
        dr.scatter_add(self._counts, self.kernel.types.index(1), kind, active)

    def attribute(self, name: str, si: mi.SurfaceInteraction3f, active: Mask) -> Value | None:
        """Value of a mesh attribute; in spectral variants the coefficients of a colour's spectrum."""
        if name not in self._attributes:
            return None
        vector3, wi = self.kernel.types.vector3, dr.detach(si.wi)
        # The interaction contains the triangle, but not the location. Intersect the line through its point along the
        # ray again.
        to_world, direction = self._map, self._direction(si, wi)
        start = self._located(si.prim_index, 1 / 3, 1 / 3, active)
        hit = to_world.inverse_point(vector3(dr.detach(si.p)))

        def found(direction: Vector3, active: Mask) -> tuple[Location, Index]:
            # As for the interaction: near outlines, the line soon leaves the surface again.
            side = dot(vector3(dr.detach(si.n)), direction) * self._sign
            d = self._map.inverse_direction(direction)
            return self.kernel.line_hits(hit, d, start, active, wanted_sign=side)[:2]

        location, kind = found(direction, active)
        shape = self._shape()
        if shape is None or int(shape.bsdf().flags()) & int(mi.BSDFFlags.BackSide):
            # Where `twosided` has swapped front and back, intersect the mirrored ray.
            mirrored = self._direction(si, type(wi)(wi.x, wi.y, -wi.z))
            with dr.suspend_grad():
                # Texture coordinates, or parameters if the cage has none: the components of ``si.uv``.
                u, v = location.u, location.v
                if self._texcoords is not None:
                    u, v = self._texcoords(location, active)[0]
            is_mirrored = active & (dr.maximum(dr.abs(u - si.uv.x), dr.abs(v - si.uv.y)) > SAME_PARAMETERS)
            at_mirrored = found(mirrored, is_mirrored)
            location, kind = location.chosen(is_mirrored, at_mirrored[0]), dr.select(is_mirrored, at_mirrored[1], kind)
            direction = dr.select(is_mirrored, mirrored, direction)
        if dr.grad_enabled(si.p):
            # The hit stays on its line. So does the point of the interaction, even if it is that of the triangle.
            if dr.grad_enabled(self.to_world):
                to_world = AffineMap.of(self.to_world)
            o, d = to_world.inverse_point(vector3(si.p)), to_world.inverse_direction(direction)
            lines = Lines(o, d, kind == ON_LINE)
            location = self.kernel.at(location, active, constraint=lines).location
        value = self._attributes[name](location, active)[0]
        return self._upsampling[name](value) if name in self._upsampling else value

    def turn_outline(self, ss: mi.SilhouetteSample3f, active: Mask) -> None:
        """Move a sample of the shape's outline to the triangle that is seen, in place."""
        turn_to_seen(cast("mi.Mesh", self._shape()), ss, active)

    def hit_by_texcoords(
        self,
        scene: mi.Scene,  # Made by `texture_scene`, of current texture coordinates
        uv: Vector2,
        ray_flags: int,
        active: Mask,
    ) -> mi.SurfaceInteraction3f:
        """Interaction at the point of the shape with given texture coordinates; invalid where there is none."""
        variant, shape = self._variant, cast("mi.Mesh", self._shape())

        def at(uv: Vector2, active: Mask) -> mi.SurfaceInteraction3f:
            uv_ray = variant.Ray3f(variant.Point3f(uv.x, uv.y, -1), variant.Vector3f(0, 0, 1))
            preliminary = scene.ray_intersect_preliminary(uv_ray, active=active)
            active &= preliminary.is_valid()
            index = dr.select(active, preliminary.prim_index, 0)
            corners = [shape.vertex_position(vertex, active) for vertex in shape.face_indices(index, active)]
            n, (b1, b2) = shape.face_normal(index, active), preliminary.prim_uv
            point = corners[0] + (corners[1] - corners[0]) * b1 + (corners[2] - corners[0]) * b2
            ray = variant.Ray3f(dr.detach(point + n), dr.detach(variant.Vector3f(-n)))
            preliminary.t = dr.select(active, variant.Float(1), dr.inf)
            preliminary.shape = variant.ShapePtr(shape)
            return preliminary.compute_surface_interaction(ray, ray_flags | int(mi.RayFlags.UV), active)

        target: Any = uv
        si = at(uv, active)
        for _ in range(STEPS):
            target = target + dr.select(si.is_valid(), uv - si.uv, 0)
            next_si = at(target, active & si.is_valid())
            si = dr.select(next_si.is_valid(), next_si, si)
        return si

    def texture_scene(self, face_count: int) -> mi.Scene:
        """Scene of the shape's triangles over the plane of texture coordinates, in which hits are looked up."""
        index, b1, b2 = np.repeat(np.arange(face_count), 3), *np.tile(np.eye(3)[1:], face_count)
        if self._are_turned:
            b1, b2 = b2, b1
        types, texcoords = self.kernel.types, self.channels[TEXCOORDS]
        mesh = self._variant.Mesh("texture coordinates", 3 * face_count, face_count)
        with dr.suspend_grad():
            location = self._located(types.indices(index), types.floats(b1), types.floats(b2), True)
            u, v = texcoords(location, True)[0]
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = dr.ravel(types.vector3(u, v, 0))
        parameters["faces"] = dr.arange(types.index, 3 * face_count)
        parameters.update()
        return mi.load_dict({"type": "scene", "mesh": mesh})

    def _is_moving(self) -> bool:
        displacement = self.kernel.displacement
        variables = [] if displacement is None else displacement.variables()
        moves, shape = dr.grad_enabled(self.kernel.coefficients, self.to_world, *variables), cast("Any", self._shape())
        if not moves and self._warns and shape and dr.grad_enabled(shape.control_points, shape.to_world):
            self._warns = False
            warn(f"{self._name}: differentiated since its last update; expected params.update() after dr.enable_grad")
        return moves

    def _direction(self, si: mi.SurfaceInteraction3f, wi: Vector3) -> Vector3:
        """Direction of the ray of an interaction; the normal if there is no ray."""
        vector3 = self.kernel.types.vector3
        direction = vector3(dr.detach(si.to_world(wi)))
        return dr.select(dr.squared_norm(direction) > 0, direction, vector3(dr.detach(si.n)))

    def _fill_in(
        self,
        si: mi.SurfaceInteraction3f,
        points: SurfacePoints,
        is_before: Mask,  # Lanes where the surface is in front of the triangle
        # Origin and direction of the ray
        o: Vector3,
        d: Vector3,
        side: Float,  # Negative where the ray hits the triangle from outside
    ) -> None:
        """Set the normals, and the origin of rays that leave the surface.

        Emitters keep those of their triangles. Surfaces that rays pass through get the shading normal only; others also
        the geometric normal, and a point in front of the triangle.
        """
        variant, shape = self._variant, self._shape()
        # Emitters are sampled on their triangles. Hits need the same points and normals, or the weights of multiple
        # importance sampling would not sum to one.
        if shape is not None and shape.is_emitter():
            return
        exists = dot(points.n, points.n) > 0
        n = dr.select(exists, variant.Normal3f(points.n * self._sign), si.n)
        n = _turned_to_ray(n, dr.detach(d), side)
        si.sh_frame.n = n
        # Where rays may pass through a material or into a medium, both sides need the same origin: the triangle.
        sides = 0 if shape is None else int(shape.bsdf().flags())
        if shape is None or shape.is_medium_transition() or sides & int(mi.BSDFFlags.Transmission):
            return
        is_outline = si.t == OUTLINE
        if sides & int(mi.BSDFFlags.BackSide):
            # Integrators replace normals that point away at outlines, as interpolated ones do on the front.
            n = dr.select(is_outline & (side > 0), -n, n)
            si.sh_frame.n = n
        # Otherwise, rays leave on the side that they came from. They start on the surface or on the triangle, whichever
        # is in front, so that no triangle occludes them.
        t = dot(points.p - o, d) / dot(d, d)
        is_before &= (t > 0) | is_outline
        si.p, si.t = dr.select(is_before, variant.Point3f(points.p), si.p), dr.select(is_before, t, si.t)
        si.n = n

    def _set_parameters(self, si: mi.SurfaceInteraction3f, points: SurfacePoints, active: Mask) -> None:
        variant = self._variant
        u, v = points.location.u, points.location.v
        tangents = [(points.dp_du, points.dp_dv)]
        if points.dn_du is not None:
            tangents.append((points.dn_du * self._sign, points.dn_dv * self._sign))
        if self._texcoords is not None:
            (u, v), (u_u, v_u), (u_v, v_v) = self._texcoords(points.location, active)
            inverse = over(1, u_u * v_v - u_v * v_u, 0)
            tangents = [((a * v_v - b * v_u) * inverse, (b * u_u - a * u_v) * inverse) for a, b in tangents]
        si.uv = variant.Point2f(u, v)
        si.dp_du, si.dp_dv = (variant.Vector3f(tangent) for tangent in tangents[0])
        if len(tangents) > 1:
            si.dn_du, si.dn_dv = (variant.Vector3f(tangent) for tangent in tangents[1])


def _turned_to_ray(n: Vector3, d: Vector3, side: Float) -> Vector3:
    """Turn normals to the side of the triangle that a ray hits.

    Where a triangle extends beyond a silhouette, the surface nearby may face away from the ray, and would be black.
    Its normal is replaced by that of the silhouette, nearly perpendicular to the ray.
    """
    detached, inverse = dr.detach(n), dr.rsqrt(dot(d, d))
    cosine = dot(detached, d) * inverse
    target_cosine = dr.select(side < 0, -GRAZING, GRAZING)
    turned = added(detached, d, (target_cosine - cosine) * inverse)
    return dr.select(cosine * side < 0, turned * dr.rsqrt(dot(turned, turned)), n)
