"""Texture coordinates and attributes of the cage as differentiable parameters of the shape.

The parameter ``cage_NAME`` contains the control values of the attribute NAME, flat. The buffer ``vertex_NAME`` contains
its values at the vertices of the tessellation: the product of a sparse weight matrix and the control values.

In spectral variants, Mitsuba's meshes store colours as coefficients of smooth spectra. Mitsuba looks them up in a table
when an attribute is added to a mesh [Jakob and Hanika 2019]. Here they are looked up in kernels, because colours may
change and be differentiated.
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from typing import TYPE_CHECKING, Any
from weakref import WeakMethod

import drjit as dr
import mitsuba as mi
import numpy as np

from ..cage.errors import warn
from ..device_arrays import mapped, upload
from ..kernels.array_types import Float, FloatBuffer, Index, Value
from ..mesh.shared import Content, SharedArray, shared
from ..surface import LimitSurface
from ..variants import Variant
from .derivatives import BackwardPasses
from .device_state import flat_type, require_values
from .parameter_table import errors_about

if TYPE_CHECKING:
    from ..cage import ControlCage
    from ..kernels.channel_kernel import ChannelKernel
    from ..patches.channel import Channel, ChannelLayout
    from .displacement import ShapeDisplacement
    from .mesh_buffers import Triangles

PREFIX = "cage_"
# Names of attributes whose buffers would be those of every Mitsuba mesh.
RESERVED = ("positions", "normals")
# Numbers of components that Mitsuba's attribute lookups support.
WIDTHS = (1, 3)

# Mitsuba's table of the coefficients of spectra, by sRGB.
TABLE = "data/srgb.coeff"
# Sizes in bytes of the magic number at the beginning of the file, and of the resolution that follows.
_MARK, _WORD = 4, 4
# Last coefficient of the spectra of black and white; the others are zero.
_BLACK, _WHITE = -8192.0, 8192.0
# Lower bound of the largest component of a colour, by which the other components are divided.
_DARKEST = 1e-6


class CageAttributes:
    """Control values of texture coordinates and attributes, and the mesh buffers computed from them.

    Weights are computed when values first change, so a shape with constant values never needs them.
    """

    # See `SparseMatrix`.
    UPLOADED_LATER = ("all_weights",)

    def __init__(
        self,
        variant: Variant,
        surface: LimitSurface,
        names: Iterable[str],  # Names of the attributes that `traverse` exposes
        # What takes new values of attributes
        channels: dict[str, ChannelKernel],  # Attributes that are evaluated at hits
        displacement: ShapeDisplacement | None,
        # Arguments of `retessellate`
        triangles: Triangles,
        names_at_vertices: Container[str],
        # Method that is called with an attribute's name and the gradient by its values, by the same name, after reverse
        # mode has reached these
        on_backward: WeakMethod,
    ) -> None:
        self._on_backward = on_backward
        self._source = surface.cage.source.name
        self._kind, self._is_jit = flat_type(variant), dr.is_jit_v(variant.Float)
        self._channels: dict[str, Channel] = {name: surface.channel(name) for name in names}
        # Meshes with equal values share memory until values are assigned.
        self._given = {
            name: shared(_uploaded, self._kind, Content(channel.values)) for name, channel in self._channels.items()
        }
        # Control values by names of parameters, such as "cage_texcoords"
        self.values: dict[str, FloatBuffer] = {
            f"{PREFIX}{name}": self._kind(given.array) for name, given in self._given.items()
        }
        # Functions that take new values of attributes, flat, and names of the parameters that move vertices
        self._followers = {name: channel.values.set for name, channel in channels.items()}
        self.moving: set[str] = set()
        if displacement is not None:
            self._followers[displacement.attribute] = displacement.set_values
            self.moving = {f"{PREFIX}{displacement.attribute}"}
        sizes = {name: channel.values.shape[1] for name, channel in self._channels.items()}
        self._upsampling = spectral_upsampling(variant, sizes)
        # Updated values of attributes, as watched for reverse-mode passes.
        self._moved: dict[str, FloatBuffer] = {}
        # Made before any values of the parameters that are differentiated: each must be older than what it watches.
        self._passes = {
            name: BackwardPasses(self._source, f"{PREFIX}{name}", variant.Float)
            for name in (self._channels if dr.is_diff_v(variant.Float) else ())
        }
        self.retessellate(triangles, names_at_vertices)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the parameters."""
        flags = mi.ParamFlags
        for name, values in self.values.items():
            discontinuity = flags.Discontinuous if name in self.moving else flags.Differentiable
            callback.put(name, values, flags.Differentiable | discontinuity)

    def retessellate(self, triangles: Triangles, names: Container[str]) -> None:
        """Choose the vertices, which have the attributes that are among ``names``."""
        self._uploaded = {
            name: shared(_uploaded, self._kind, Content(triangles.attributes[name].astype(np.float32)))
            for name in self._channels
            if name in names
        }
        self._locations = triangles.layout.locate
        self._weights: dict[ChannelLayout, Any] = {}

    def update(self, keys: Iterable[str]) -> list[str]:
        """Apply the parameters of this object that are named in ``keys``.

        Returns list of str: names of the attributes. Raises ValueError if the number of values has changed, or one is
        not finite.
        """
        channels = {name: channel for name, channel in self._channels.items() if f"{PREFIX}{name}" in keys}
        for name, channel in channels.items():
            with errors_about(f"{PREFIX}{name}"):
                require_values(self.values[f"{PREFIX}{name}"], len(channel.values), channel.values.shape[1], "value")
        for name in channels:
            values = self.values[f"{PREFIX}{name}"]
            if dr.grad_enabled(values):
                self._passes[name].begin([values])
            self._move(name)
        return list(channels)

    def renew(self, name: str, gradient: FloatBuffer) -> None:
        """Attach an attribute's followers and buffers to its values again, after reverse mode has reached these."""
        self._passes[name].warn_of_lost([gradient])
        self._move(name)

    def buffers(self, names: Iterable[str] | None = None) -> dict[str, FloatBuffer]:
        """Mesh buffers of the given attributes, by default of all, by name of the buffer."""
        buffers = {}
        for name in self._channels if names is None else names:
            if name in self._uploaded:
                values = self._at_vertices(name)
                buffers[mesh_name(name)] = self._upsampling[name].stored(values) if name in self._upsampling else values
        return buffers

    def _at_vertices(self, name: str) -> FloatBuffer:
        if name not in self._moved:
            return self._uploaded[name].array
        values, channel = self._moved[name], self._channels[name]
        weights = self._weights_of(channel)
        size = channel.values.shape[1]
        if self._is_jit:
            return weights(values, size)
        vertex_values = weights @ np.array(values, dtype=np.float64).reshape(-1, size)
        return np.asarray(vertex_values, dtype=np.float32).ravel()

    @property
    def all_weights(self) -> dict[ChannelLayout, Any]:
        """Weights of all attributes, computed if necessary."""
        for name in self._uploaded:
            self._weights_of(self._channels[name])
        return self._weights

    def _weights_of(self, channel: Channel) -> Any:
        # Attributes of the same layout share weights.
        if channel.layout not in self._weights:
            weights: Any = channel.weights(*self._locations())
            if self._is_jit:
                from ..kernels.linear_maps import SparseMatrix

                weights = SparseMatrix(weights, self._kind)
            self._weights[channel.layout] = weights
        return self._weights[channel.layout]

    def _move(self, name: str) -> None:
        values = self.values[f"{PREFIX}{name}"]
        if dr.grad_enabled(values):
            values = self._passes[name].watched({name: values}, self._on_backward, name)[name]
        self._moved[name] = values
        if name in self._followers:
            self._followers[name](values)


def _uploaded(kind: type, values: Content) -> SharedArray:
    # Copied to memory of Dr.Jit, as frozen functions may replace the array.
    return SharedArray(dr.opaque(mapped(kind, values.array)) if dr.is_jit_v(kind) else np.ravel(values.array))


def mesh_name(name: str) -> str:
    """Name of the mesh attribute for an attribute of the cage."""
    return f"vertex_{name}"


def mesh_attributes(cage: ControlCage) -> dict[str, int]:
    """Attributes of a cage that a Mitsuba mesh can store, with their numbers of components. Warns about others."""
    sizes = {}
    for name, attribute in cage.attributes.items():
        size = attribute.values.shape[1]
        if name in RESERVED:
            warn(f'{cage.source.name}: attribute "{name}" is left out; every Mitsuba mesh has "{name}" already')
        elif size not in WIDTHS:
            warn(
                f'{cage.source.name}: attribute "{name}" has {size} numbers per value and is left out; '
                "Mitsuba evaluates attributes of 1 or 3"
            )
        else:
            sizes[name] = size
    return sizes


def spectral_upsampling(variant: Variant, sizes: dict[str, int]) -> dict[str, SpectralUpsampling]:
    """Conversion of each attribute for which Mitsuba stores spectra, by names and numbers of components.

    Mitsuba looks for "color" only; USD's "displayColor" is a colour, too.
    """
    colors = [name for name, size in sizes.items() if size == 3 and "color" in name.lower()]
    if not (colors and variant.is_spectral):
        return {}
    return dict.fromkeys(colors, shared(SpectralUpsampling, variant))


class SpectralUpsampling:
    """Conversion of colours to coefficients of spectra, differentiable in JIT variants."""

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
        # The last level that is not above the largest component.
        z = dr.binary_search(1, last, lambda z: dr.gather(variant.Float, self._levels, z) <= dr.detach(largest)) - 1
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

    def _grey(self, value: Float) -> Value:
        is_inside = (value > 0) & (value < 1)
        clamped = dr.select(is_inside, value, 0.5)
        constant = dr.select(is_inside, (clamped - 0.5) / dr.sqrt(clamped * (1 - clamped)), 0)
        constant = dr.select(value <= 0, _BLACK, dr.select(value >= 1, _WHITE, constant))
        return self._variant.Color3f(0, 0, constant)
