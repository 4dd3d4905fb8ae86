"""Surface interactions of the limit surface itself, where rays have hit its triangles."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..kernels.element_walk import Place
from ..kernels.placement import Placement
from ..kernels.surface_kernel import SurfaceKernel
from ..kernels.triangle_places import TrianglePlaces
from ..patches import PieceTable
from ..surface import LimitSurface
from ..tessellation import SamplingTable

# Of 3.9 and of the flags that the shape is asked with.
_NORMAL_DERIVATIVES = int(mi.RayFlags.dNSdUV) | int(mi.RayFlags.dNGdUV)


class ExactShading:
    """Completes surface interactions of a shape.

    Parameters
    ----------
    variant : module
    surface : LimitSurface
    table : SamplingTable
        Of the shape's triangles.
    starts_at_surface : bool
        Whether rays may leave from the surface, which can lie before a triangle; else they leave from the triangle.
    """

    def __init__(self, variant: Any, surface: LimitSurface, table: SamplingTable, *, starts_at_surface: bool) -> None:
        self._variant = variant
        is_jit = dr.is_jit_v(variant.Float)
        cage = surface.cage
        pieces = PieceTable.build(surface.patches, cage.cut_mesh.vertex, cage.vertex_count)
        float_type = variant.Float if is_jit else float
        self._kernel = SurfaceKernel(pieces, float_type)
        self._triangles = TrianglePlaces(table, self._kernel.walk, self._kernel.types)
        self._starts_at_surface = starts_at_surface
        self._sign = 1.0
        self._is_turned = False

    def update(self, points: Any, offset: Any, *, mirrors: bool, flips: bool) -> None:
        """Take over control points.

        Parameters
        ----------
        points : flat array
            x, y, z of each, in the world but for the offset; derivatives reach them.
        offset : 3-vector
            Where they are relative to.
        mirrors : bool
            Whether the placement is a reflection: tangents and triangles are turned over.
        flips : bool
            Whether normals are asked for on the other side.
        """
        self._kernel.set_control_points(points)
        self._offset = offset
        self._sign = -1.0 if mirrors != flips else 1.0
        self._is_turned = mirrors

    def __call__(self, si: Any, ray: Any, preliminary: Any, flags: int, active: Any) -> None:
        """Complete a surface interaction; see `InteractionHook`."""
        variant, kernel = self._variant, self._kernel
        triangle, barycentric = preliminary.prim_index, dr.detach(preliminary.prim_uv)
        b1, b2 = (barycentric.y, barycentric.x) if self._is_turned else (barycentric.x, barycentric.y)
        hit, d = dr.detach(si.p) - self._offset, dr.detach(ray.d)
        hit, d = kernel.types.vector3(hit), kernel.types.vector3(d)
        with dr.suspend_grad():
            place = self._triangles(triangle, b1, b2, active)
            place, way = kernel.intersect(hit, d, place, active)
        points = kernel.evaluate(place, active, 2 if flags & _NORMAL_DERIVATIVES else 1)
        exists = dr.squared_norm(points.n) > 0
        n = variant.Normal3f(points.n * self._sign)
        si.sh_frame.n = dr.select(exists, n, si.n)
        si.uv = variant.Point2f(place.u, place.v)
        si.dp_du, si.dp_dv = variant.Vector3f(points.dp_du), variant.Vector3f(points.dp_dv)
        if points.dn_du is not None:
            si.dn_du, si.dn_dv = (variant.Vector3f(each * self._sign) for each in (points.dn_du, points.dn_dv))
        if self._starts_at_surface:
            beyond = dr.dot(points.p - hit, d)
            is_before = exists & (beyond < 0)
            si.p = dr.select(is_before, variant.Point3f(points.p + self._offset), si.p)
            si.t = dr.select(is_before, si.t + beyond, si.t)
            si.n = dr.select(exists, n, si.n)
