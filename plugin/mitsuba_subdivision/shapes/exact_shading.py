"""Surface interactions of the limit surface at the triangles that rays hit, and at texture coordinates."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from enum import Enum, auto
from functools import partial
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import upload
from ..kernels.affine_map import AffineMap
from ..kernels.array_types import Float, FloatBuffer, Index, IndexBuffer, Mask, Matrix4, Value, Vector2, Vector3
from ..kernels.channel_kernel import ChannelKernel, channel_kernel
from ..kernels.control_values import ControlValues
from ..kernels.line_intersection import ON_LINE, Lines
from ..kernels.surface_kernel import SurfaceKernel
from ..kernels.surface_points import SurfacePoints
from ..kernels.triangle_locations import SomeTriangles, TriangleLocations, triangle_locations
from ..kernels.vectors import added, dot, over
from ..mesh.connectivity import IntArray
from ..mesh.shared import Shared
from ..schemes.domain import FloatArray
from ..surface import TEXCOORDS, LimitSurface
from ..tessellation import AttributeLayout, AttributeTable
from ..variants import Variant
from .attribute_parameters import WIDTHS, mesh_name
from .placement import Placement
from .spectral_colors import SpectralUpsampling, holds_spectra

if TYPE_CHECKING:
    from ..tessellation import VertexTable
    from .mitsuba_3_9_hook.hook_trial import TriangleHit

# Cosine between a ray and a normal at a silhouette.
GRAZING = 1e-2
# Texture coordinates that differ by less belong to the same location.
SAME_PARAMETERS = 1e-3
_NORMAL_DERIVATIVES = int(mi.RayFlags.dNSdUV) | int(mi.RayFlags.dNGdUV)
_PARAMETERS = int(mi.RayFlags.UV) | int(mi.RayFlags.dPdUV) | _NORMAL_DERIVATIVES
_KINDS = ("are on the ray", "are along the normal nearby", "are shaded where the triangle lies in the surface")
_FOLLOWS, _DETACHES = int(mi.RayFlags.FollowShape), int(mi.RayFlags.DetachShape)

# Shapes whose kernels traverse the same elements share the parameters of their triangles.
_TRIANGLES: Shared[TriangleLocations] = Shared()
_WELDED: Shared[AttributeLayout] = Shared()


class Side(Enum):
    """The behaviour of rays at a shape, which decides the origin and the normal of the rays that leave it.

    - Rays leave an opaque shape on the side that they came from. They start on the surface or on the triangle,
      whichever is in front, so that no triangle occludes them.
    - Rays may pass through transmissive materials and media, so both sides need the same origin: the triangle.
    - Emitters are sampled on their triangles. A hit on an emitter needs the same point and normal, or the multiple
      importance sampling weights of both strategies would not add up to one.
    """

    OPAQUE = auto()
    TRANSMISSIVE = auto()
    EMITTER = auto()


class ExactShading:
    """Completes the surface interactions of a shape.

    Near the hit on a triangle, the ray's line is intersected with the limit surface. The intersection gives the
    interaction its normal, parameters, their derivatives, and texture coordinates. Lines are intersected in object
    space, so that shapes with equal control points share the surface's coefficients.
    """

    def __init__(
        self,
        variant: Variant,
        surface: LimitSurface,
        # (n, 3) float64: its control points, relative to the centre of `RecentredPoints`
        positions: NDArray[np.float64],
        *,
        use_stam: bool,  # Whether to evaluate by Stam's form
    ) -> None:
        self._variant = variant
        self._name = surface.cage.source.name
        pieces = surface.pieces("stam" if use_stam else "stabilized")
        # The surface in object space, relative to the centre
        self.kernel = SurfaceKernel(pieces, variant.Float, use_stam=use_stam)
        self.kernel.load(positions)
        self.to_world: Matrix4 = self.kernel.types.matrix4(1)  # Of points relative to the centre
        self._counts: IndexBuffer = dr.zeros(self.kernel.types.index, len(_KINDS))
        self.take_counts()
        self._limit_surface = surface
        self._channels: dict[str, ChannelKernel] = {}
        self._texcoords = self.channel(TEXCOORDS) if TEXCOORDS in surface.attribute_names else None
        self._attributes = {
            mesh_name(name): self.channel(name)
            for name, attribute in surface.cage.attributes.items()
            if attribute.values.shape[1] in WIDTHS
        }
        self._colors = {
            name for name, channel in self._attributes.items() if holds_spectra(variant, name, channel.values.size)
        }
        self._upsampling = SpectralUpsampling.shared(variant) if self._colors else None
        self.side: Callable[[], Side] = lambda: Side.OPAQUE
        self._sign = 1.0

    def set_triangles(self, table: VertexTable, kept: IntArray | None = None) -> None:
        """Set the shape's triangles, before the first hit: those of a table, or some of them."""
        walk, types = self.kernel.walk, self.kernel.types
        self._triangles = _TRIANGLES.get((table, walk), lambda: triangle_locations(table, walk, types))
        if kept is not None:
            self._triangles = SomeTriangles(self._triangles, kept, types)

    def welded_table(self, table: VertexTable) -> AttributeTable:
        """Triangles without copies of vertices, because normals and texture coordinates are evaluated at hits.

        Attributes have the value of one side of a seam.
        """
        surface = self._limit_surface
        if not surface.cage.attributes:
            return AttributeTable(_welded(table), {})
        found = surface.attribute_table(table)
        values = {name: found.values[name] for name in surface.cage.attributes}
        if found.surface_vertex is None:
            return AttributeTable(_welded(table), values)
        _, first = np.unique(found.surface_vertex, return_index=True)
        layout = _welded(table, found.layout, first)
        return AttributeTable(layout, {name: value[first] for name, value in values.items()})

    def follow_side_of(self, shape: mi.Mesh) -> None:
        """Read the `Side` of a shape at every hit; its normals may be flipped."""
        self.side = _side_of(shape)
        self._sign = -1.0 if shape.has_flipped_normals() else 1.0

    def set_transform(
        self,
        to_world: Matrix4,  # From points relative to the centre to the world
        coefficients: FloatBuffer,  # The kernel's coefficients, maybe with derivatives
        placement: Placement,  # Of the same transformation
    ) -> None:
        """Set the transformation and coefficients; derivatives by both reach surface interactions."""
        self._are_turned = placement.mirrors
        self.kernel.take(coefficients)
        # Assign into the same array, because others may hold a reference to it.
        self.to_world[:] = self.kernel.types.matrix4(to_world)
        self._map = AffineMap.of(dr.detach(self.to_world), self.kernel.types.matrix4(placement.inverse))

    def channel(self, name: str) -> ChannelKernel:
        """An attribute of the cage on the surface, or its texture coordinates; the same object each time."""
        if name not in self._channels:
            kernel = self.kernel
            self._channels[name] = channel_kernel(self._limit_surface.channel(name), kernel.walk, kernel.types.float)
        return self._channels[name]

    @property
    def values(self) -> dict[str, ControlValues]:
        """Of texture coordinates and of the attributes evaluated on the surface, by their names in the cage."""
        return {name: channel.values for name, channel in self._channels.items()}

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the arrays that gradients pass through: forward mode reaches a rendering through such arrays only."""
        differentiable = mi.ParamFlags.Differentiable
        callback.put("shading_coefficients", self.kernel.coefficients, differentiable)
        callback.put("shading_to_world", self.to_world, differentiable)
        for name, values in self.values.items():
            callback.put(f"shading_cage_{name}", values.flat, differentiable)

    def complete(self, si: mi.SurfaceInteraction3f, triangle_hit: TriangleHit) -> None:
        """Complete a surface interaction as Mitsuba asks for it."""
        ray, preliminary, flags, active = triangle_hit
        kernel, vector3 = self.kernel, self.kernel.types.vector3
        b1, b2 = dr.detach(preliminary.prim_uv)
        if self._are_turned:
            b1, b2 = b2, b1
        # Without derivatives, less is traced.
        moves = not flags & _DETACHES and self._is_moving()
        hit = self._map.inverse_point(vector3(dr.detach(si.p)))
        along = vector3(dr.detach(ray.d))
        d = self._map.inverse_direction(along)
        location = self._triangles(preliminary.prim_index, b1, b2, active)
        # Search no further than the triangle's size, nor than the ray's length: its origin is in front of the surface.
        # Both are lengths in the world, where they are compared along the ray.
        sides = vector3(dr.detach(si.dp_du)), vector3(dr.detach(si.dp_dv))
        size = dr.maximum(*(dot(side, side) for side in sides))
        farthest = dr.minimum(dr.sqrt(size * dr.rcp(dot(along, along))), dr.detach(si.t)) * dr.sqrt(dot(d, d))
        facing = dot(vector3(dr.detach(si.n)), along)
        hits = kernel.line_hits(hit, d, location, active, max_distance=farthest, facing=facing * self._sign)
        self._count(hits.kind, active)
        to_world = AffineMap.of(self.to_world) if moves and dr.grad_enabled(self.to_world) else self._map
        lines = None
        if not flags & _FOLLOWS and (moves or dr.grad_enabled(ray.o, ray.d)):
            o, along = to_world.inverse_point(vector3(ray.o)), to_world.inverse_direction(vector3(ray.d))
            lines = Lines(o, along, hits.kind == ON_LINE)
        found = kernel.at(
            hits.location, active, 2 if flags & _NORMAL_DERIVATIVES else 1, lines=lines, moves=moves, values=hits.values
        )
        is_before = active & (dot(dr.detach(found.p) - hit, d) < 0)
        found = found.placed(to_world)
        if flags & _PARAMETERS:
            self._set_parameters(si, found, active)
        self._fill_in(si, found, is_before, vector3(ray.o), vector3(ray.d), facing)

    def _count(self, kind: Index, active: Mask) -> None:
        """At the log level Debug, count hits by kind, and log the counts of the last kernel."""
        if mi.log_level() > mi.LogLevel.Debug:
            return
        counts = self.take_counts()
        if sum(counts):
            shares = ", ".join(
                f"{count / sum(counts):.2%} {where}" for count, where in zip(counts, _KINDS, strict=True)
            )
            log: Any = mi.Log  # Mitsuba's stub says of this function only that it is an object.
            log(mi.LogLevel.Debug, f"{self._name}: of {sum(counts)} hits, {shares}")
        dr.scatter_add(self._counts, self.kernel.types.index(1), kind, active)

    def take_counts(self) -> list[int]:
        """Number of hits since the last call that were found on the ray, along a normal, and not at all.

        Hits are counted at the log level Debug only.
        """
        counts = np.array(self._counts).tolist()
        self._counts = dr.zeros(self.kernel.types.index, len(_KINDS))
        return counts

    def attribute(self, name: str, si: mi.SurfaceInteraction3f, active: Mask) -> Value | None:
        """Value of an attribute as a mesh stores it; in spectral variants the coefficients of a colour's spectrum."""
        if name not in self._attributes:
            return None
        vector3 = self.kernel.types.vector3
        # The interaction keeps the triangle, but not the location. A line through its point along the ray finds the
        # location again; along the mirrored ray where a BSDF has swapped front and back.
        start = self._triangles(si.prim_index, 1 / 3, 1 / 3, active)
        to_world, wi = self._map, dr.detach(si.wi)
        hit = to_world.inverse_point(vector3(dr.detach(si.p)))
        along, mirrored = self._direction(si, wi), self._direction(si, type(wi)(wi.x, wi.y, -wi.z))
        hits = self.kernel.line_hits(hit, to_world.inverse_direction(along), start, active)
        with dr.suspend_grad():
            # Texture coordinates; parameters if the cage has none.
            u, v = hits.location.u, hits.location.v
            if self._texcoords is not None:
                u, v = self._texcoords(hits.location, active)[0]
        is_other = active & (dr.maximum(dr.abs(u - si.uv.x), dr.abs(v - si.uv.y)) > SAME_PARAMETERS)
        others = self.kernel.line_hits(hit, to_world.inverse_direction(mirrored), start, is_other)
        location = hits.location.chosen(is_other, others.location)
        if dr.grad_enabled(si.p):
            # The hit stays on that line. Along it, the interaction's point may be that of the triangle.
            is_held = dr.select(is_other, others.kind, hits.kind) == ON_LINE
            if dr.grad_enabled(self.to_world):
                to_world = AffineMap.of(self.to_world)
            d = to_world.inverse_direction(dr.select(is_other, mirrored, along))
            lines = Lines(to_world.inverse_point(vector3(si.p)), d, is_held)
            location = self.kernel.at(location, active, lines=lines).location
        value = self._attributes[name](location, active)[0]
        return self._upsampling(value) if self._upsampling and name in self._colors else value

    def texcoords_of_corners(self, face_count: int) -> FloatArray:
        """Texture coordinates ``(3 n, 2)`` at the corners of all triangles, in their order in the mesh."""
        if self._texcoords is None:
            raise RuntimeError(f"{self._name} has no texture coordinates")
        index, b1, b2 = np.repeat(np.arange(face_count), 3), *np.tile(np.eye(3)[1:], face_count)
        if self._are_turned:
            b1, b2 = b2, b1
        types = self.kernel.types
        with dr.suspend_grad():
            location = self._triangles(types.indices(index), types.floats(b1), types.floats(b2), True)
            return np.array(self._texcoords(location, True)[0]).T

    def _is_moving(self) -> bool:
        """Whether there are derivatives by anything that moves the surface."""
        displacement = self.kernel.displacement
        arrays = [] if displacement is None else displacement.variables()
        return bool(dr.grad_enabled(self.kernel.coefficients, self.to_world, *arrays))

    def _direction(self, si: mi.SurfaceInteraction3f, wi: Vector3) -> Vector3:
        """Direction of the ray at an interaction; the normal of an interaction without a ray."""
        vector3 = self.kernel.types.vector3
        seen = vector3(dr.detach(si.to_world(wi)))
        return dr.select(dr.squared_norm(seen) > 0, seen, vector3(dr.detach(si.n)))

    def _fill_in(
        self,
        si: mi.SurfaceInteraction3f,
        found: SurfacePoints,
        is_before: Mask,  # Where the surface is in front of the triangle
        # The ray
        o: Vector3,
        d: Vector3,
        facing: Float,  # Below zero where the ray meets the triangle from outside
    ) -> None:
        """Set the normals, and the point that rays leave from."""
        variant, side = self._variant, self.side()
        if side is Side.EMITTER:
            return
        exists = dot(found.n, found.n) > 0
        n = dr.select(exists, variant.Normal3f(found.n * self._sign), si.n)
        n = _facing(n, dr.detach(d), facing)
        si.sh_frame.n = n
        if side is Side.TRANSMISSIVE:
            return
        # If the surface lies behind the triangle, the ray leaves from the triangle, in front of all triangles.
        t = dot(found.p - o, d) / dot(d, d)
        is_before &= t > 0
        si.p, si.t = dr.select(is_before, variant.Point3f(found.p), si.p), dr.select(is_before, t, si.t)
        si.n = n

    def _set_parameters(self, si: mi.SurfaceInteraction3f, found: SurfacePoints, active: Mask) -> None:
        """Parameters, or texture coordinates, and derivatives by them."""
        variant = self._variant
        u, v = found.location.u, found.location.v
        tangents = [(found.dp_du, found.dp_dv)]
        if found.dn_du is not None:
            tangents.append((found.dn_du * self._sign, found.dn_dv * self._sign))
        if self._texcoords is not None:
            (u, v), (u_u, v_u), (u_v, v_v) = self._texcoords(found.location, active)
            inverse = over(1, u_u * v_v - u_v * v_u, 0)
            tangents = [((a * v_v - b * v_u) * inverse, (b * u_u - a * u_v) * inverse) for a, b in tangents]
        si.uv = variant.Point2f(u, v)
        si.dp_du, si.dp_dv = (variant.Vector3f(each) for each in tangents[0])
        if len(tangents) > 1:
            si.dn_du, si.dn_dv = (variant.Vector3f(each) for each in tangents[1])


def _facing(n: Vector3, d: Vector3, facing: Float) -> Vector3:
    """Normals that face a ray from the same side as the triangle.

    Where a triangle sticks out beyond a silhouette, the surface nearby may face away, and would be black. There the
    normal is turned to that of the silhouette: nearly perpendicular to the ray.
    """
    own, inverse = dr.detach(n), dr.rsqrt(dot(d, d))
    cosine = dot(own, d) * inverse
    least = dr.select(facing < 0, -GRAZING, GRAZING)
    turned = added(own, d, (least - cosine) * inverse)
    return dr.select(cosine * facing < 0, turned * dr.rsqrt(dot(turned, turned)), n)


def _side_of(shape: mi.Mesh) -> Callable[[], Side]:
    """Function that returns the current `Side` of a shape; it does not keep the shape alive."""
    reference = weakref.ref(shape)

    def side() -> Side:
        alive = reference()
        if alive is not None and alive.is_emitter():
            return Side.EMITTER
        if alive is None or alive.is_medium_transition() or int(alive.bsdf().flags()) & int(mi.BSDFFlags.Transmission):
            return Side.TRANSMISSIVE
        return Side.OPAQUE

    return side


def _welded(
    table: VertexTable,
    split: AttributeLayout | None = None,  # Triangles with copies of vertices along seams, if there are seams
    first: IntArray | None = None,  # (n,) int64: the vertex of `split` whose attributes each vertex has
) -> AttributeLayout:
    """Triangles without copies of vertices, shared between shapes."""

    def triangles() -> NDArray[np.uint32]:
        if not table.copies.size:
            return table.triangles
        return table.weld_target.astype(np.uint32)[table.triangles]

    def make() -> AttributeLayout:
        locate = (
            None if split is None or split.locate is None or first is None else partial(_chosen, split.locate, first)
        )
        return AttributeLayout(None, triangles, locate=locate)

    return _WELDED.get((table, split), make)


def _chosen(locate: Callable[[], tuple[IntArray, FloatArray]], chosen: IntArray) -> tuple[IntArray, FloatArray]:
    """Some of the locations that a function returns."""
    start, uv = locate()
    return start[chosen], uv[chosen]


# Each step takes off most of the difference between texture coordinates on the surface and on its triangles.
STEPS = 3


class Parameterization:
    """Finds points of a shape with exact shading by their texture coordinates, as Mitsuba does on triangles."""

    def __init__(
        self,
        variant: Variant,
        shape: mi.Mesh,
        exact: ExactShading,  # Of the shape, with its current texture coordinates
    ) -> None:
        self._variant = variant
        uv = exact.texcoords_of_corners(shape.face_count())
        mesh = variant.Mesh("texture coordinates", vertex_count=len(uv), face_count=len(uv) // 3)
        parameters = mi.traverse(mesh)
        for name, values in (("vertex_positions", np.pad(uv, ((0, 0), (0, 1)))), ("faces", np.arange(len(uv)))):
            parameters[name] = upload(type(parameters[name]), values)
        parameters.update()
        self._scene = mi.load_dict({"type": "scene", "mesh": mesh})

    def hit(self, shape: mi.Mesh, uv: Vector2, ray_flags: int, active: Mask) -> mi.SurfaceInteraction3f:
        """The interaction where a shape has some texture coordinates; invalid where it has not."""
        found = self._at(shape, uv, ray_flags, active)
        target = uv
        for _ in range(STEPS):
            target = target + dr.select(found.is_valid(), uv - found.uv, 0)
            nearer = self._at(shape, target, ray_flags, active & found.is_valid())
            found = dr.select(nearer.is_valid(), nearer, found)
        return found

    def _at(self, shape: mi.Mesh, uv: Vector2, ray_flags: int, active: Mask) -> mi.SurfaceInteraction3f:
        variant = self._variant
        above = variant.Ray3f(variant.Point3f(uv.x, uv.y, -1), variant.Vector3f(0, 0, 1))
        found = self._scene.ray_intersect_preliminary(above, active=active)
        active &= found.is_valid()
        index = dr.select(active, found.prim_index, 0)
        corners = [shape.vertex_position(each, active) for each in shape.face_indices(index, active)]
        n, (b1, b2) = shape.face_normal(index, active), found.prim_uv
        point = corners[0] + (corners[1] - corners[0]) * b1 + (corners[2] - corners[0]) * b2
        ray = variant.Ray3f(dr.detach(point + n), dr.detach(variant.Vector3f(-n)))
        found.t = dr.select(active, 1, dr.inf)
        found.shape = variant.ShapePtr(shape) if dr.is_jit_v(variant.Float) else shape
        return found.compute_surface_interaction(ray, ray_flags | int(mi.RayFlags.UV), active)
