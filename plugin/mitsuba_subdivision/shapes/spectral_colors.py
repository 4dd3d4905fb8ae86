"""Colours in spectral variants: coefficients of smooth spectra, which Mitsuba's meshes store instead of colours.

Mitsuba looks them up in a table when an attribute is added to a mesh [Jakob and Hanika 2019]. Here they are looked up
in kernels, because colours may change and be differentiated.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..device_arrays import upload
from ..kernels.array_types import Float, FloatBuffer, Index, Mask, Value
from ..mesh.shared import Shared
from ..variants import Variant

TABLE = "data/srgb.coeff"
# Sizes in bytes of the magic number at the beginning of the file, and of the resolution that follows.
_MARK, _WORD = 4, 4
# Last coefficient of the spectra of black and white; the others are zero.
_BLACK, _WHITE = -8192.0, 8192.0
# Lower bound of the largest component of a colour, by which the other components are divided.
_DARKEST = 1e-6


def holds_spectra(variant: Variant, mesh_name: str, size: int) -> bool:
    """Whether Mitsuba stores spectra for a mesh attribute of this name and number of components.

    Mitsuba looks for "color" only; USD's "displayColor" is a colour, too.
    """
    return bool(variant.is_spectral) and size == 3 and "color" in mesh_name.lower()


class SpectralUpsampling:
    """Conversion of colours to coefficients of spectra, differentiable in JIT variants."""

    @classmethod
    def shared(cls, variant: Variant) -> SpectralUpsampling:
        """The object of a variant, shared by its shapes while it is referenced."""
        return _UPSAMPLING.get(variant, lambda: cls(variant))

    def __init__(
        self,
        variant: Variant,  # Spectral variant
    ) -> None:
        self._variant = variant
        if not dr.is_jit_v(variant.Float):
            return
        # Mitsuba's stub declares this function as an object.
        file_resolver: Any = mi.file_resolver
        with open(str(file_resolver().resolve(TABLE)), "rb") as file:
            content = file.read()
        self._resolution = size = int(np.frombuffer(content, "<u4", 1, _MARK)[0])
        values = np.frombuffer(content, "<f4", size + 9 * size**3, _MARK + _WORD)
        self._levels, self._table = (upload(variant.Float, array) for array in (values[:size], values[size:]))

    def stored(self, colors: FloatBuffer) -> FloatBuffer:
        """Convert a mesh's flat buffer of colours to a flat buffer of coefficients."""
        variant = self._variant
        if dr.is_jit_v(variant.Float):
            return dr.ravel(variant.Color3f(self(dr.unravel(variant.Color3f, colors))))
        mesh = variant.Mesh("", len(colors) // 3, 0)
        mesh.add_attribute("vertex_color", 3, np.asarray(colors).tolist())
        return np.array(mesh.attribute_buffer("vertex_color"))

    def __call__(self, color: Value) -> Value:
        """Convert colours to coefficients on the device."""
        variant, last = self._variant, self._resolution - 1
        r, g, b = (dr.clip(component, 0, 1) for component in color)
        # The table has a part for each component that is the largest, or the last one of the largest.
        is_blue = b >= dr.maximum(r, g)
        is_green = ~is_blue & (g >= r)
        largest = dr.maximum(dr.select(is_blue, b, dr.select(is_green, g, r)), _DARKEST)
        first = dr.select(is_blue, r, dr.select(is_green, b, g)) * (last / largest)
        second = dr.select(is_blue, g, dr.select(is_green, r, b)) * (last / largest)

        index = variant.UInt32
        x = dr.minimum(index(dr.detach(first)), last - 1)
        y = dr.minimum(index(dr.detach(second)), last - 1)
        z = self._interval(dr.detach(largest))
        level = dr.gather(variant.Float, self._levels, z)
        height = (largest - level) / (dr.gather(variant.Float, self._levels, z + 1) - level)
        part = dr.select(is_blue, index(2), dr.select(is_green, index(1), index(0)))

        def along_x(y: Index, z: Index) -> Value:
            row = ((part * (last + 1) + z) * (last + 1) + y) * (last + 1) + x
            begin, end = (dr.gather(variant.Color3f, self._table, row + i) for i in range(2))
            return dr.lerp(begin, end, first - x)

        def along_y(z: Index) -> Value:
            return dr.lerp(along_x(y, z), along_x(y + 1, z), second - y)

        coefficients = dr.lerp(along_y(z), along_y(z + 1), height)
        # Greys have constant spectra with a closed form.
        is_grey = (r == g) & (g == b)
        grey = dr.replace_grad(self._grey(dr.detach(b)), coefficients)  # type: ignore[func-returns-value]  # The stub is wrong.
        return dr.select(is_grey, grey, coefficients)

    def _interval(self, largest: Float) -> Index:
        """Index of the last level that is not above ``largest``."""
        last = self._resolution - 1

        def is_above(level: Index) -> Mask:
            return dr.gather(self._variant.Float, self._levels, level) <= largest

        return dr.binary_search(1, last, is_above) - 1

    def _grey(self, value: Float) -> Value:
        is_inside = (value > 0) & (value < 1)
        clamped = dr.select(is_inside, value, 0.5)
        constant = dr.select(is_inside, (clamped - 0.5) / dr.sqrt(clamped * (1 - clamped)), 0)
        constant = dr.select(value <= 0, _BLACK, dr.select(value >= 1, _WHITE, constant))
        return self._variant.Color3f(0, 0, constant)


_UPSAMPLING: Shared[SpectralUpsampling] = Shared()
