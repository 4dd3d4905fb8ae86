"""The displacement of a shape: its heights, the channel that they depend on, their scale, and displaced vertices.

In object space, a surface point S is displaced to S + scale h N, along the unit limit normal N. A point without a
normal is not displaced. `kernels.displacement` has the formulas, and the displaced surface that rays intersect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import mapped
from ..evaluation.equations import AT_EXTRAORDINARY_POINT
from ..kernels.algebra import unit
from ..kernels.array_types import Float, FloatBuffer, Mask, Value
from ..kernels.channel_kernel import ChannelKernel
from ..kernels.displacement import Displacement, Heights, displaced
from ..kernels.linear_maps import SparseMatrix
from ..kernels.locations import Location
from ..kernels.piece_kernel import PatchValues
from ..kernels.surface_kernel import SurfaceKernel
from ..mesh.connectivity import IntArray
from ..patches.channel import contracts_alike
from ..patches.patch_samples import PatchSampler
from ..schemes.domain import FloatArray
from ..surface import TEXCOORDS, LimitSurface
from ..tessellation.criterion import HeightsAt
from ..variants import Variant
from .cage_attributes import mesh_name
from .device_state import flat_type, is_recording

if TYPE_CHECKING:
    from scipy import sparse

    from ..patches.channel import Channel
    from ..tessellation.attribute_table import AttributeLayout
    from .parameters import Parameters

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


class ShapeDisplacement:
    """Displacement of a shape's surface: heights, the channel that they depend on, and their scale.

    Raises ValueError if the cage lacks the channel that heights depend on, or heights are not scalar.
    """

    def __init__(
        self,
        variant: Variant,
        parameters: Parameters,
        kernel: SurfaceKernel | None,  # The surface on the device, which is displaced, too; None in scalar variants
        channels: dict[str, ChannelKernel],  # Attributes that are evaluated at hits
    ) -> None:
        surface, given, scale = parameters.surface, parameters.displacement, parameters.displacement_scale
        # Name of the channel that the heights depend on: an attribute, or "texcoords".
        self.attribute = _attribute_named(given, surface) if isinstance(given, str) else TEXCOORDS
        if self.attribute not in surface.attribute_names:
            raise ValueError(
                f"a texture was given, and {surface.cage.source.name} has no texture coordinates; expected a cage with "
                "some, or the name of an attribute"
            )
        self.heights = Heights() if isinstance(given, str) else TextureHeights(variant, given)
        # The channel with its current values on the host; after an update, these are read when they are needed.
        self._channel, self._updated = surface.channel(self.attribute), None
        # The parameter ``displacement_scale``: a flat array of one number.
        self.scale = flat_type(variant)([scale])
        self.kernel = kernel
        if kernel is not None:
            channel = channels.get(self.attribute) or ChannelKernel(self._channel, variant.Float)
            kernel.displacement = Displacement(channel, self.heights, scale)
        self.require_scale()
        self.take_scale()

    def require_scale(self) -> None:
        """Raise ValueError if ``displacement_scale`` is not a finite number, unless it cannot be read."""
        if is_recording():
            return
        values = np.array(self.scale).ravel()
        if len(values) != 1 or not np.isfinite(values[0]):
            raise ValueError(f"{values.tolist()} was given; expected a finite number")

    def take_scale(self) -> None:
        """Apply ``displacement_scale``."""
        if dr.is_jit_v(self.scale):
            # Dr.Jit compiles literals into kernels.
            dr.make_opaque(self.scale)
        # The scale that is applied: a copy, because users assign the parameter in place before it is checked.
        self.factor = type(self.scale)(self.scale)
        if self.kernel is not None and self.kernel.displacement is not None:
            self.kernel.displacement.scale = self.factor

    @property
    def host_scale(self) -> float:
        """The applied scale."""
        return float(np.array(dr.detach(self.factor)).item())

    @property
    def channel(self) -> Channel:
        """The channel with its current values, on the host."""
        if self._updated is not None:
            values = np.array(self._updated, dtype=np.float64).reshape(self._channel.values.shape)
            self._channel, self._updated = replace(self._channel, values=values), None
        return self._channel

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the scale; Mitsuba exposes a texture as an attribute of the shape."""
        flags = mi.ParamFlags
        callback.put("displacement_scale", self.scale, flags.Differentiable | flags.Discontinuous)

    def set_values(self, values: FloatBuffer) -> None:
        """Set values, flat, of the channel that the heights depend on."""
        self._updated = dr.detach(values)
        if self.kernel is not None and self.kernel.displacement is not None:
            self.kernel.displacement.channel.values.set(values)

    def variables(self) -> list[FloatBuffer]:
        """Differentiable arrays of the heights and the scale."""
        return [self.scale, *self.heights.variables()]

    def in_world(self, to_world: FloatArray) -> tuple[HeightsAt, float]:
        """`heights` and `highest` of a `Criterion` in world space: the scaled heights by location, and their bound."""
        # The spectral norm is the largest factor by which the linear map scales a length.
        channel, scale = self.channel, self.host_scale * float(np.linalg.norm(to_world[:3, :3], 2))
        float_type = dr.scalar.ArrayXf64 if self.kernel is None else self.kernel.types.float

        def heights_at(start: IntArray, uv: FloatArray) -> FloatArray:
            columns = [mapped(float_type, column) for column in channel.evaluate(start, uv).T]
            heights = self.heights.height(columns[0] if len(columns) == 1 else columns)
            # A constant texture returns one number for all samples.
            return np.broadcast_to(scale * np.array(heights, dtype=np.float64), len(uv))

        return heights_at, max(map(abs, self.heights.range(channel))) * abs(scale)


class DisplacedVertices:
    """Displacement of the vertices of a mesh.

    Copies of a vertex along creases and seams are displaced by the mean of their displacements, so that they stay
    bitwise equal. Each copy has the normal of its side. In JIT variants, differentiable with respect to control points,
    the scale, and the texture or control values of the heights.
    """

    def __init__(
        self,
        displacement: ShapeDisplacement,
        surface: LimitSurface,
        layout: AttributeLayout,  # Vertices with copies along all seams, whose different displacements are averaged
        weld_target: NDArray[np.uint32] | None,  # Their `split_weld_targets`
        *,
        has_normals: bool,  # Whether the mesh has normals at its vertices
    ) -> None:
        self._displacement, self._surface, self._has_normals = displacement, surface, has_normals
        # (n,) int64: corner of an element from which parameters are seen, a half-edge of `PatchTable.elements`; and
        # (n, 2) float64: parameters. Samples at corners of elements have (0, 0).
        self._corner, self._uv = corner, uv = layout.locate()
        self._mean: Any = None if weld_target is None else _mean_over_copies(weld_target)
        # (n,) bool: whether the slope of heights along the surface exists. It does not exist at an extraordinary point
        # where a seam ends, as positions and values contract at different rates.
        self._has_slope: Any = np.ones(len(corner), dtype=bool)
        corners = np.flatnonzero((uv == 0).all(axis=1))
        samples = self._sampler(self._surface.cage.positions).evaluate(corner[corners], uv[corners])
        points = corners[samples.level == AT_EXTRAORDINARY_POINT]
        self._has_slope[points] = contracts_alike(displacement.channel, self._surface.patches, corner[points])
        if displacement.kernel is not None:
            types = displacement.kernel.types
            self._location = Location(types.indices(corner), *map(types.floats, uv.T))
            self._has_slope = types.indices(self._has_slope.astype(np.uint32)) != 0
            dr.eval(self._has_slope)
            self._mean = self._mean if self._mean is None else SparseMatrix(self._mean, types.float)

    def __call__(
        self,
        positions: FloatBuffer,
        normals: FloatBuffer,
        points: FloatBuffer,  # Control points of the surface
    ) -> tuple[FloatBuffer, FloatBuffer]:
        """Displace flat positions and normals of the vertices."""
        given, kernel = self._displacement, cast("Any", self._displacement.kernel)
        if kernel is None:
            return self._on_host(np.reshape(positions, (-1, 3)), np.reshape(normals, (-1, 3)), points)
        n, (value, _, _) = dr.unravel(kernel.types.vector3, normals), kernel.displacement.channel(self._location)
        steps = dr.ravel(given.heights.height(value) * given.factor * n)
        positions = positions + (steps if self._mean is None else self._mean(steps, 3))
        if self._has_normals:
            displaced_normal = kernel.at(self._location).n
            exists = self._has_slope & (dr.squared_norm(n) > 0) & (dr.squared_norm(displaced_normal) > 0)
            normals = dr.ravel(dr.select(exists, displaced_normal, n))
        return positions, normals

    def _on_host(self, positions: NDArray, normals: NDArray, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        given, scale = self._displacement, self._displacement.host_scale
        rows_of_channel = given.channel.with_derivatives(self._corner, self._uv)
        value, du, dv = (_columns(rows) if rows.shape[1] > 1 else _columns(rows)[0] for rows in rows_of_channel)
        steps = np.array(given.heights.height(value))[:, None] * scale * normals
        positions = positions + (steps if self._mean is None else self._mean @ steps).astype(np.float32)
        if self._has_normals:
            h, h_u, h_v = (scale * component for component in given.heights(value, du, dv))
            # Second derivatives do not exist at extraordinary points.
            sampler = self._sampler(np.array(points, dtype=np.float64).reshape(-1, 3))
            samples = sampler.evaluate(self._corner, self._uv, derivatives=2)
            p, dp_du, dp_dv, *second = (_columns(rows) for rows in np.nan_to_num([*samples[:3], *samples[5:8]]))
            surface = PatchValues(p, dp_du, dp_dv, _columns(samples.n), tuple(second))
            n = unit(displaced(surface, (h, h_u, h_v)).normal)
            displaced_normal = np.stack([np.array(column) for column in n], axis=1)
            exists = self._has_slope & normals.any(axis=1) & displaced_normal.any(axis=1)
            normals = np.where(exists[:, None], displaced_normal, normals).astype(np.float32)
        return positions.ravel(), normals.ravel()

    def _sampler(self, points: FloatArray) -> PatchSampler:
        return PatchSampler(self._surface.patches, points)


def _mean_over_copies(weld_target: NDArray[np.uint32]) -> sparse.csr_array:
    """Matrix that replaces the vector of each vertex by the mean over its copies, from the first copy of each."""
    from scipy import sparse

    count = len(weld_target)
    first_copy = sparse.csr_array((np.ones(count), weld_target, np.arange(count + 1)), (count, count))
    copies = (first_copy @ first_copy.T).sorted_indices()
    return sparse.csr_array(sparse.diags_array(1 / copies.sum(axis=1)) @ copies)


def _columns(rows: NDArray) -> list[Float]:
    return [mapped(dr.scalar.ArrayXf64, column) for column in rows.T]


def _attribute_named(given: str, surface: LimitSurface) -> str:
    """Return the name in the cage of the attribute that the parameter names.

    Raises ValueError if there is no such attribute, or its values are not scalar.
    """
    names = {mesh_name(name): name for name in surface.cage.attributes}
    widths = {given: surface.cage.attributes[name].values.shape[1] for given, name in names.items()}
    if given not in widths:
        possible = [f'"{name}"' for name, width in widths.items() if width == 1]
        expected = f"one of {', '.join(possible)}" if possible else "a cage with an attribute of one number per value"
        raise ValueError(f'{surface.cage.source.name} has no attribute "{given}"; expected {expected}, or a texture')
    if widths[given] != 1:
        raise ValueError(f'"{given}" has {widths[given]} numbers per value; expected an attribute of one')
    return names[given]


class TextureHeights(Heights):
    """Heights of a texture, with derivatives by the chain rule: for arrays of a kernel, single points, and on the host.

    The texture's gradient is Mitsuba's ``eval_1_grad`` if the texture implements it, as bitmaps do. Otherwise, it is
    Dr.Jit's derivative of ``eval_1``, or central differences over `DIFFERENCE` in variants without derivatives. The
    derivatives of a bitmap's gradient by texture coordinates are differences over a texel.

    Raises ValueError if the texture is not a function of texture coordinates, or not scalar.
    """

    def __init__(self, variant: Variant, texture: mi.Texture) -> None:
        self._variant, self._texture = variant, texture
        self._height, self._gradient = partial(self._at, texture.eval_1), partial(self._at, texture.eval_1_grad)
        name = texture.class_name()
        if name in _ELSEWHERE:
            raise ValueError(f'a texture of the kind "{name}" was given; expected {_ELSEWHERE[name]}')
        try:
            self._height(0.5, 0.5)
        except RuntimeError as error:
            raise ValueError(
                f'a texture of the kind "{name}" cannot be evaluated as a single number; expected a scalar texture, '
                f'such as a bitmap that is "raw" ({error})'
            ) from None
        try:
            self._gradient(0.5, 0.5)
            self._has_gradient = True
        except RuntimeError:
            self._has_gradient = False

    def __call__(self, value: Value, du: Value, dv: Value, active: Mask = True) -> tuple[Float, Float, Float]:
        """See `Heights`."""
        s, t = value
        moves = self._has_gradient and dr.is_jit_v(s) and dr.grad_enabled(s, t)
        by_s, by_t = (self._moving_slopes if moves else self._slopes)(s, t, active)
        return self._height(s, t, active), by_s * du[0] + by_t * du[1], by_s * dv[0] + by_t * dv[1]

    def height(self, value: Value) -> Float:
        """Heights without derivatives."""
        return self._height(*value)

    def variables(self) -> list:
        """Differentiable arrays: the differentiable parameters of the texture."""
        return [value for _, value in mi.traverse(self._texture) if dr.is_jit_v(value) and dr.is_diff_v(value)]

    def range(self, _channel: Channel | None = None) -> tuple[float, float]:
        """Interval of the texels of a bitmap, which contains all heights; for other textures, of samples."""
        parameters = mi.traverse(self._texture)
        if "data" in parameters and self._texture.class_name().startswith("BitmapTexture"):
            values = np.array(parameters["data"])
            if values.shape[2] == 3:
                values = values @ np.array(_LUMINANCE, dtype=values.dtype)
        else:
            centres = (np.arange(RANGE_SAMPLES) + 0.5) / RANGE_SAMPLES
            float_type = self._variant.Float if dr.is_jit_v(self._variant.Float) else dr.scalar.ArrayXf64
            values = np.array(self._height(*(mapped(float_type, grid) for grid in np.meshgrid(centres, centres))))
        return float(values.min()), float(values.max())

    def _at(self, evaluate: Callable, s: Float, t: Float, active: Mask = True) -> Value:
        """Call a method of the texture; point by point in scalar variants."""
        variant, is_jit = self._variant, dr.is_jit_v(self._variant.Float)
        if not is_jit and dr.is_array_v(s):
            results = np.array([self._at(evaluate, *uv) for uv in zip(s, t, strict=True)])
            return type(s)(results) if results.ndim == 1 else [type(s)(column) for column in results.T]
        si = dr.zeros(variant.SurfaceInteraction3f, max(dr.width(s), dr.width(t)) if is_jit else 1)
        si.uv = variant.Point2f(s, t)
        return evaluate(si, active)

    def _slopes(self, s: Float, t: Float, active: Mask) -> Sequence[Float]:
        if not self._has_gradient:
            is_diff = dr.is_diff_v(self._variant.Float)
            return (self._derivatives if is_diff else self._differences)(s, t, active)
        by_s, by_t = self._gradient(s, t, active)
        # Mitsuba 3.9.1 multiplies the gradient by the resolution after applying ``to_uv`` instead of before, which
        # differs where a bitmap's sides differ in length and ``to_uv`` turns it.
        sides = np.array(self._texture.resolution(), dtype=np.float64)
        if sides[0] == sides[1]:
            return by_s, by_t
        to_uv = self._to_uv()
        if (to_uv[0, 1] == 0 and to_uv[1, 0] == 0) or np.linalg.det(to_uv) == 0:
            return by_s, by_t
        (a, b), (c, d) = (to_uv.T @ np.diag(sides) @ np.linalg.inv(to_uv.T) @ np.diag(1 / sides)).tolist()
        return a * by_s + b * by_t, c * by_s + d * by_t

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

    def _to_uv(self) -> FloatArray:
        parameters = mi.traverse(self._texture)
        if "to_uv" not in parameters:
            return np.eye(2)
        return np.array(parameters["to_uv"].matrix, dtype=np.float64).reshape(3, 3)[:2, :2]

    def _derivatives(self, s: Float, t: Float, active: Mask) -> Sequence[Float]:
        gradient = []
        with dr.resume_grad():
            for step_s, step_t in ((1, 0), (0, 1)):
                step = self._variant.Float(0)
                dr.enable_grad(step)
                height = self._height(dr.detach(s) + step_s * step, dr.detach(t) + step_t * step, active)
                if dr.grad_enabled(height):
                    dr.forward_from(step)
                gradient.append(dr.grad(height))
        return gradient

    def _differences(self, s: Float, t: Float, active: Mask) -> Sequence[Float]:
        slopes = []
        for ds, dt in ((DIFFERENCE, 0), (0, DIFFERENCE)):
            ahead, behind = self._height(s + ds, t + dt, active), self._height(s - ds, t - dt, active)
            slopes.append((ahead - behind) / (2 * DIFFERENCE))
        return slopes
