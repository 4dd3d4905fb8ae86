"""Heights of a displacement: a texture over texture coordinates, or an attribute of the cage.

They are evaluated for arrays of a kernel, single points, and arrays on the host; see `Heights`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ..device_arrays import mapped
from ..kernels.array_types import Float, Mask, Value, Vector2
from ..kernels.displacement import Heights
from ..schemes.domain import FloatArray
from ..variants import Variant

if TYPE_CHECKING:
    from ..patches import Channel

# Step of central differences of a texture, in texture coordinates.
DIFFERENCE = 2.0**-10
# Number of samples along each side of the unit square, from which the range of textures that are no bitmaps follows.
RANGE_SAMPLES = 256
# Textures that are not functions of texture coordinates, and the expected alternatives for messages.
_ELSEWHERE = {
    "MeshAttribute": 'the name of the attribute itself, such as "vertex_height"',
    "VolumeAdapter": "one over texture coordinates",
}
# Relative luminance of linear sRGB, with Mitsuba's weights.
_LUMINANCE = (0.212671, 0.715160, 0.072169)


@dataclass(frozen=True)
class HeightRange:
    """Interval of the heights of a displacement, without its scale."""

    # For textures that are no bitmaps, the interval of samples
    low: float
    high: float


class AttributeHeights(Heights):
    """Heights equal to a channel's values."""

    def __init__(
        self,
        channel: Channel,  # With one component
    ) -> None:
        self._values = channel.values

    def range(self) -> HeightRange:
        """Interval of the control values, which contains all heights because weights are not negative."""
        return HeightRange(float(self._values.min()), float(self._values.max()))


class TextureHeights(Heights):
    """Heights of a texture, with derivatives by the chain rule.

    The texture's gradient is Mitsuba's ``eval_1_grad`` if the texture implements it, as bitmaps do. Otherwise, it is
    Dr.Jit's derivative of ``eval_1``, or central differences over `DIFFERENCE` in variants without derivatives. The
    derivatives of a bitmap's gradient by texture coordinates are differences over a texel.

    Raises ValueError if the texture is not a function of texture coordinates, or not scalar.
    """

    def __init__(self, variant: Variant, texture: mi.Texture) -> None:
        self._variant, self._texture = variant, texture
        name = texture.class_name()
        if name in _ELSEWHERE:
            raise ValueError(f'a texture of the kind "{name}" was given; expected {_ELSEWHERE[name]}')
        self._is_jit = dr.is_jit_v(variant.Float)
        middle = self._interaction(0.5, 0.5)
        try:
            texture.eval_1(middle)
        except RuntimeError as error:
            raise ValueError(
                f'a texture of the kind "{name}" cannot be evaluated as a single number; expected a scalar texture, '
                f'such as a bitmap that is "raw" ({error})'
            ) from None
        self._gradient: Callable[[Float, Float, Mask], Sequence[Float]]
        try:
            texture.eval_1_grad(middle)
            self._gradient = self._own_gradient
        except RuntimeError:
            self._gradient = self._derivative if dr.is_diff_v(variant.Float) else self._difference

    def __call__(self, value: Value, du: Value, dv: Value, active: Mask = True) -> tuple[Float, Float, Float]:
        """See `Heights`."""
        s, t = value
        is_bitmap = self._gradient == self._own_gradient
        moves = is_bitmap and self._is_jit and dr.grad_enabled(s, t)
        by_s, by_t = (self._moving_slopes if moves else self._slopes)(s, t, active)
        return self._each(self._height, s, t, active), by_s * du[0] + by_t * du[1], by_s * dv[0] + by_t * dv[1]

    def _slopes(self, s: Float, t: Float, active: Mask) -> Sequence[Float]:
        """Derivatives of the heights by s and t."""
        by_s, by_t = self._each(self._gradient, s, t, active)
        return self._corrected(by_s, by_t) if self._gradient == self._own_gradient else (by_s, by_t)

    def _moving_slopes(self, s: Float, t: Float, active: Mask) -> Sequence[Float]:
        """Slopes of a bitmap, with derivatives by s and t that are differences over a texel.

        Bilinear interpolation makes the slope along s constant in s between texels, with jumps at these. Its derivative
        would be zero everywhere, although the normals of the displaced surface vary.
        """
        s_0, t_0 = dr.detach(s), dr.detach(t)
        slopes = self._slopes(s_0, t_0, active)
        # Lengths of a texel in texture coordinates.
        texels = abs(self._to_uv()) * np.array(self._texture.resolution(), dtype=np.float64)[:, None]
        step_s, step_t = (1 / np.maximum(texels.max(axis=0), 1)).tolist()
        for parameter, ds, dt in ((s, step_s / 2, 0.0), (t, 0.0, step_t / 2)):
            with dr.suspend_grad():
                behind = self._slopes(s_0 - ds, t_0 - dt, active)
                ahead = self._slopes(s_0 + ds, t_0 + dt, active)
            move = dr.replace_grad(type(s)(0), parameter)  # type: ignore[func-returns-value]  # The stub is wrong.
            inverse = 1 / (2 * (ds + dt))
            slopes = [slope + (b - a) * inverse * move for slope, a, b in zip(slopes, behind, ahead, strict=True)]
        return slopes

    def height(self, value: Value) -> Float:
        """Heights without derivatives."""
        s, t = value
        return self._each(self._height, s, t, True)

    def variables(self) -> list:
        """Differentiable arrays: the differentiable parameters of the texture."""
        if not self._is_jit:
            return []
        return [value for _, value in mi.traverse(self._texture) if dr.is_diff_v(value)]

    def range(self) -> HeightRange:
        """Interval of the texels of a bitmap, which contains all heights; for other textures, of samples."""
        parameters = mi.traverse(self._texture)
        if "data" in parameters and self._texture.class_name().startswith("BitmapTexture"):
            data = np.array(parameters["data"])
            values = data @ np.array(_LUMINANCE, dtype=data.dtype) if data.shape[2] == 3 else data
            return HeightRange(float(values.min()), float(values.max()))
        centres = (np.arange(RANGE_SAMPLES) + 0.5) / RANGE_SAMPLES
        float_type = self._variant.Float if self._is_jit else dr.scalar.ArrayXf64
        s, t = (mapped(float_type, coordinate) for coordinate in np.meshgrid(centres, centres))
        values = np.array(self.height((s, t)))
        return HeightRange(float(values.min()), float(values.max()))

    def _each(self, function: Callable, s: Float, t: Float, active: Mask) -> Value:
        """Evaluate a function of s and t; point by point in scalar variants."""
        if self._is_jit or not dr.is_array_v(s):
            return function(s, t, active)
        results = np.array([function(*uv, True) for uv in zip(s, t, strict=True)])
        return type(s)(results) if results.ndim == 1 else [type(s)(column) for column in results.T]

    def _interaction(self, s: Float, t: Float) -> mi.SurfaceInteraction3f:
        si = dr.zeros(self._variant.SurfaceInteraction3f, max(dr.width(s), dr.width(t)) if self._is_jit else 1)
        si.uv = self._variant.Point2f(s, t)
        return si

    def _height(self, s: Float, t: Float, active: Mask) -> Float:
        return self._texture.eval_1(self._interaction(s, t), active)

    def _own_gradient(self, s: Float, t: Float, active: Mask) -> Vector2:
        return self._texture.eval_1_grad(self._interaction(s, t), active)

    def _corrected(self, by_s: Float, by_t: Float) -> Sequence[Float]:
        """Correct the gradient of a rotated bitmap whose sides differ in length.

        Mitsuba 3.9.1 multiplies the gradient by the resolution after applying ``to_uv`` instead of before.
        """
        sides = np.array(self._texture.resolution(), dtype=np.float64)
        if sides[0] == sides[1]:
            return by_s, by_t
        to_uv = self._to_uv()
        if (to_uv[0, 1] == 0 and to_uv[1, 0] == 0) or np.linalg.det(to_uv) == 0:
            return by_s, by_t
        (a, b), (c, d) = (to_uv.T @ np.diag(sides) @ np.linalg.inv(to_uv.T) @ np.diag(1 / sides)).tolist()
        return a * by_s + b * by_t, c * by_s + d * by_t

    def _to_uv(self) -> FloatArray:
        """``(2, 2)`` linear part of a bitmap's ``to_uv``."""
        parameters = mi.traverse(self._texture)
        if "to_uv" not in parameters:
            return np.eye(2)
        return np.array(parameters["to_uv"].matrix, dtype=np.float64).reshape(3, 3)[:2, :2]

    def _derivative(self, s: Float, t: Float, active: Mask) -> Sequence[Float]:
        gradient = []
        with dr.resume_grad():
            for direction in ((1, 0), (0, 1)):
                step = self._variant.Float(0)
                dr.enable_grad(step)
                step_s, step_t = direction
                height = self._height(dr.detach(s) + step_s * step, dr.detach(t) + step_t * step, active)
                if dr.grad_enabled(height):
                    dr.forward_from(step)
                gradient.append(dr.grad(height))
        return gradient

    def _difference(self, s: Float, t: Float, active: Mask) -> Sequence[Float]:
        return (
            (self._height(s + DIFFERENCE, t, active) - self._height(s - DIFFERENCE, t, active)) / (2 * DIFFERENCE),
            (self._height(s, t + DIFFERENCE, active) - self._height(s, t - DIFFERENCE, active)) / (2 * DIFFERENCE),
        )
