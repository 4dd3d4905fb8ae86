"""From texture coordinates to the surface, for shapes whose meshes do not store texture coordinates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ..device_arrays import upload
from ..kernels.types import Mask, Vector2
from ..variants import Variant

if TYPE_CHECKING:
    from .exact_shading import ExactShading

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
