"""The displacement of a shape: heights, their channel and their scale, on the device and on the host.

    parameters.py            checks ``displacement`` and ``displacement_scale``
    heights.py               heights and their slopes, of a texture or an attribute; their range
    displacement.py          displacement of a shape: this module
    displaced_vertices.py    displaced vertices of a tessellation, with exact normals
    exact_shading.py         hits on the displaced surface
    kernels/displacement.py  formulas, and the displaced surface that rays intersect

In object space, a surface point S is displaced to S + scale h N, along the unit limit normal N. A point without a
normal is not displaced.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..device_arrays import mapped
from ..kernels.array_types import FloatBuffer
from ..kernels.channel_kernel import channel_kernel
from ..kernels.displacement import Displacement
from ..kernels.linear_maps import ControlValues
from ..kernels.surface_kernel import SurfaceKernel
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from ..surface import TEXCOORDS, LimitSurface
from ..tessellation import DisplacementBound
from ..variants import Variant
from .device_state import is_recording
from .heights import AttributeHeights, HeightRange, TextureHeights

if TYPE_CHECKING:
    from ..patches import Channel
    from .exact_shading import ExactShading

# Prefix of an attribute's name in the parameter, as in the texture `mesh_attribute`.
PREFIX = "vertex_"


class ShapeDisplacement:
    """Displacement of a shape's surface: heights, their channel, and the scale.

    Raises ValueError if the cage lacks the channel that heights depend on, or heights are not scalar.
    """

    def __init__(
        self,
        variant: Variant,
        surface: LimitSurface,
        positions: FloatArray,  # (n, 3) float64: control points, relative to the centre of `RecentredPoints`
        given: Any,  # Value of the parameter ``displacement``
        scale: float,
        exact: ExactShading | None = None,  # Exact shading of the shape, whose surface is displaced, too
    ) -> None:
        self._is_jit = dr.is_jit_v(variant.Float)
        # ``self.attribute`` is the name of the channel that the heights depend on: an attribute, or "texcoords".
        self.heights: AttributeHeights | TextureHeights
        if isinstance(given, str):
            self.attribute = _attribute_named(given, surface)
            self._loaded = surface.channel(self.attribute)
            self.heights = AttributeHeights(self._loaded)
        else:
            if TEXCOORDS not in surface.attribute_names:
                raise ValueError(
                    f"a texture was given, and {surface.cage.source.name} has no texture coordinates; expected a cage "
                    "with some, or the name of an attribute"
                )
            self.attribute, self._loaded = TEXCOORDS, surface.channel(TEXCOORDS)
            self.heights = TextureHeights(variant, given)
        # Updated values of the channel on the device; None until the first update.
        self._values: FloatBuffer = None
        # The parameter ``displacement_scale``: a flat array of one number.
        self.scale = variant.Float(scale) if self._is_jit else dr.scalar.ArrayXf([scale])
        # The displaced surface on the device, shared with exact shading. None in scalar variants without exact shading.
        self.kernel: SurfaceKernel | None = None
        # Values of the channel on the device; None with exact shading, whose values `CageAttributes` updates.
        self._own_values: ControlValues | None = None
        if exact is not None:
            self.kernel, channel = exact.kernel, exact.channel(self.attribute)
        elif self._is_jit:
            self.kernel = SurfaceKernel(surface.pieces(), variant.Float)
            self.kernel.values.load(positions)
            channel = channel_kernel(self._loaded, self.kernel.walk, variant.Float)
            self._own_values = channel.values
        if self.kernel is not None:
            self.kernel.displacement = Displacement(channel, self.heights, scale)
        self.take_scale(self.checked_scale())

    def checked_scale(self) -> float:
        """The value of ``displacement_scale``; NaN while a frozen function is recorded, when it cannot be read.

        Raises ValueError if it is not a finite number.
        """
        if is_recording():
            return np.nan
        values = np.array(self.scale).ravel()
        if len(values) != 1 or not np.isfinite(values[0]):
            raise ValueError(f"{values.tolist()} was given; expected a finite number")
        return float(values[0])

    def take_scale(self, checked: float) -> None:
        """Apply ``displacement_scale``, whose `checked_scale` is ``checked``."""
        if self._is_jit:
            # Dr.Jit compiles literals into kernels.
            dr.make_opaque(self.scale)
        # A copy, because users assign the parameter in place before it is checked.
        self._scale = type(self.scale)(self.scale) if self._is_jit else checked
        if self.kernel is not None and self.kernel.displacement is not None:
            self.kernel.displacement.scale = self._scale

    @property
    def host_scale(self) -> float:
        return float(np.array(dr.detach(self._scale)).item())

    @property
    def channel(self) -> Channel:
        """The channel with its current values, read from the device."""
        if self._values is None:
            return self._loaded
        values = np.array(self._values, dtype=np.float64).reshape(self._loaded.values.shape)
        return replace(self._loaded, values=values)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the scale; Mitsuba exposes a texture as an attribute of the shape."""
        flags = mi.ParamFlags
        callback.put("displacement_scale", self.scale, flags.Differentiable | flags.Discontinuous)

    def set_values(self, values: FloatBuffer) -> None:
        """Set values, flat, of the channel that the heights depend on."""
        self._values = dr.detach(values)
        if not self._is_jit:
            self._loaded, self._values = self.channel, None
        if self._own_values is not None:
            self._own_values.set(values)

    def variables(self) -> list[FloatBuffer]:
        """Differentiable arrays of the heights and the scale."""
        return [self.scale, *self.heights.variables()]

    def bound(self) -> DisplacementBound:
        """Scaled heights as a function of the location, and their bound, for adaptive tessellation."""
        heights = self.range()
        return DisplacementBound(self._heights_at, max(abs(heights.low), abs(heights.high)))

    def _heights_at(self, start: IntArray, uv: FloatArray) -> FloatArray:
        float_type = type(self.scale) if self._is_jit else dr.scalar.ArrayXf64
        columns = [mapped(float_type, column) for column in self.channel.evaluate(start, uv).T]
        heights = self.heights.height(columns[0] if len(columns) == 1 else columns)
        # A constant texture returns one number for all samples.
        return np.broadcast_to(self.host_scale * np.array(heights, dtype=np.float64), len(uv))

    def range(self) -> HeightRange:
        """Interval of the scaled heights."""
        heights = AttributeHeights(self.channel) if isinstance(self.heights, AttributeHeights) else self.heights
        unscaled = heights.range()
        low, high = sorted((unscaled.low * self.host_scale, unscaled.high * self.host_scale))
        return HeightRange(low, high)


def _attribute_named(given: str, surface: LimitSurface) -> str:
    """Return the name in the cage of the attribute that the parameter names.

    Raises ValueError if there is no such attribute, or its values are not scalar.
    """
    attributes = surface.cage.attributes
    widths = {f"{PREFIX}{name}": attribute.values.shape[1] for name, attribute in attributes.items()}
    if given not in widths:
        possible = [f'"{name}"' for name, width in widths.items() if width == 1]
        expected = f"one of {', '.join(possible)}" if possible else "a cage with an attribute of one number per value"
        raise ValueError(f'{surface.cage.source.name} has no attribute "{given}"; expected {expected}, or a texture')
    if widths[given] != 1:
        raise ValueError(f'"{given}" has {widths[given]} numbers per value; expected an attribute of one')
    return given.removeprefix(PREFIX)
