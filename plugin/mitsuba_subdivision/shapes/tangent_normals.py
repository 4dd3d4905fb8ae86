"""The texture `tangent_normals`: normal maps that follow texture coordinates, also where these are mirrored."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..kernels.array_types import Mask
from ..variants import Variant


def make_tangent_normals(variant: Variant) -> type:
    """Make the texture's class of a variant of Mitsuba."""

    class TangentNormals(variant.Texture):
        """The texture ``normals``, for the BSDF `normalmap`.

        This BSDF takes the second component of normals along ``n x dp_du``. USD, MaterialX, glTF and Blender take it
        along ``dp_dv``, which is opposite where texture coordinates or transformations are mirrored.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self._normals = props["normals"]

        def eval_3(self, si: Any, active: Mask = True) -> Any:
            """Normal relative to the shading frame, from 0 to 1."""
            x, y, z = self._normals.eval_3(si, active)
            is_mirrored = dr.dot(dr.cross(si.dp_du, si.dp_dv), si.sh_frame.n) < 0
            return variant.Color3f(x, dr.select(is_mirrored, 1 - y, y), z)

        def traverse(self, callback: Any) -> None:
            callback.put("normals", self._normals, mi.ParamFlags.Differentiable)

    return TangentNormals
