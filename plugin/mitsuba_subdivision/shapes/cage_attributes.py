"""Texture coordinates and attributes of the cage as differentiable parameters of the shape.

    attribute_parameters.py  reads them from a scene
    cage_attributes.py       exposes them to `traverse` and fills the mesh's buffers: this module
    exact_shading.py         evaluates them at hits
    displacement.py          uses them as heights

The parameter ``cage_NAME`` holds the control values of attribute NAME, flat. The buffer ``vertex_NAME`` holds its
values at the vertices of the tessellation: a sparse weight matrix times the control values. In spectral variants, it
holds spectra of colours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import take_over
from ..kernels.array_types import FloatBuffer
from ..mesh.shared import SharedArray
from ..variants import Variant
from .attribute_parameters import mesh_name
from .device_state import is_recording
from .moving_vertices import Watched, computed_ones, warn_of_lost
from .parameter_table import errors_about
from .spectral_colors import SpectralUpsampling, holds_spectra

if TYPE_CHECKING:
    from ..patches import Channel
    from ..surface import LimitSurface
    from ..tessellation import AttributeTable, VertexTable

PREFIX = "cage_"

# Called with an attribute's name and the gradient with respect to its values, after reverse mode has reached them.
OnBackward = Callable[[str, FloatBuffer], None]


class CageAttributes:
    """Control values of texture coordinates and attributes, and the mesh buffers computed from them.

    Weights are computed when a value first changes, so a shape with constant values never needs them.
    """

    # See `WeightedValues`.
    UPLOADED_LATER = ("all_weights",)

    def __init__(
        self,
        variant: Variant,
        surface: LimitSurface,
        names: Iterable[str],  # Of the attributes that `traverse` exposes
    ) -> None:
        self._source = surface.cage.source.name
        self._float = variant.Float if dr.is_jit_v(variant.Float) else None
        self._channels: dict[str, Channel] = {name: surface.channel(name) for name in names}
        # Meshes of equal values share their memory until one is assigned.
        self._given = {name: self._upload(channel.values) for name, channel in self._channels.items()}
        kind = self._float or dr.scalar.ArrayXf
        # By the parameters' names, such as "cage_texcoords"
        self.values: dict[str, FloatBuffer] = {
            f"{PREFIX}{name}": kind(given.array) for name, given in self._given.items()
        }
        self.moving: set[str] = set()  # Names of the parameters that move vertices
        self._colors = {
            name
            for name, channel in self._channels.items()
            if holds_spectra(variant, mesh_name(name), channel.values.shape[1])
        }
        self._upsampling = SpectralUpsampling.shared(variant) if self._colors else None
        self._followers: list[tuple[str, Callable[[FloatBuffer], None]]] = []
        # Attributes that differ from their loaded values, with their derivatives.
        self._moved: dict[str, FloatBuffer] = {}
        self._computed: dict[str, set[int]] = {}

    def add_follower(self, name: str, take: Callable[[FloatBuffer], None], *, moves: bool = False) -> None:
        """Call a function with each new array of an attribute's values; `moves` says whether they move vertices."""
        self._followers.append((name, take))
        if moves:
            self.moving.add(f"{PREFIX}{name}")

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the parameters."""
        flags = mi.ParamFlags
        for name, values in self.values.items():
            moves = flags.Discontinuous if name in self.moving else flags.Differentiable
            callback.put(name, values, flags.Differentiable | moves)

    def set_triangles(self, table: VertexTable, attributes: AttributeTable) -> None:
        """Set the vertices of a tessellation."""
        self._loaded = attributes.values
        shown = {name: values for name, values in self._loaded.items() if name in self._channels}
        self._uploaded = {name: self._upload(values.astype(np.float32)) for name, values in shown.items()}
        self._locations = attributes.locate or table.locations
        self._weights: dict[tuple, Any] = {}

    def update(self, keys: Iterable[str], on_backward: OnBackward) -> list[str]:
        """Read the attributes that are named in ``keys`` again.

        Returns list of str: names of their attributes. Raises ValueError if the number of values has changed, or one is
        not finite.
        """
        names = [name for name in self._channels if f"{PREFIX}{name}" in keys]
        for name in names:
            with errors_about(f"{PREFIX}{name}"):
                self._require_values(name)
        for name in names:
            values = self.values[f"{PREFIX}{name}"]
            self._computed[name] = computed_ones(values) if dr.grad_enabled(values) else set()
            self._move(name, on_backward)
        return names

    def renew(self, name: str, gradient: FloatBuffer, on_backward: OnBackward) -> None:
        """Attach the arrays computed from an attribute to its values again, after reverse mode has reached them."""
        lost = self._computed[name] - computed_ones(self.values[f"{PREFIX}{name}"])
        if lost and not is_recording() and dr.any(gradient != 0):
            warn_of_lost(self._source, f"{PREFIX}{name}")
        self._move(name, on_backward)

    def buffers(self, names: Iterable[str] | None = None) -> dict[str, FloatBuffer]:
        """Mesh buffers of some attributes, by default of all, keyed by buffer name."""
        chosen = self._channels if names is None else names
        return {mesh_name(name): self._stored(name) for name in chosen if name in self._loaded}

    def _upload(self, values: NDArray[np.floating]) -> SharedArray:
        """Values, flat; in JIT variants, meshes with equal values share one array."""
        if self._float is None:
            return SharedArray(values.ravel())
        from ..kernels.array_types import ArrayTypes

        return ArrayTypes.of(self._float).shared_floats(values)

    def _stored(self, name: str) -> FloatBuffer:
        values = self._at_vertices(name)
        return self._upsampling.stored(values) if self._upsampling and name in self._colors else values

    def _at_vertices(self, name: str) -> FloatBuffer:
        if name not in self._moved:
            return self._uploaded[name].array
        values, channel = self._moved[name], self._channels[name]
        weights = self._weights_of(channel)
        size = channel.values.shape[1]
        if self._float is not None:
            return weights(values, size)
        found = weights @ np.array(values, dtype=np.float64).reshape(-1, size)
        return np.asarray(found, dtype=np.float32).ravel()

    @property
    def all_weights(self) -> dict[tuple, Any]:
        """Weights of all attributes."""
        for name in self._uploaded:
            self._weights_of(self._channels[name])
        return self._weights

    def _weights_of(self, channel: Channel) -> Any:
        # Attributes that share control vertices and patches share weights.
        key = type(channel), id(channel.patches), channel.value_index.tobytes()
        if key not in self._weights:
            weights: Any = channel.weights(*self._locations())
            if self._float is not None:
                from ..kernels.control_values import WeightedValues

                weights = WeightedValues(weights, self._float)
            self._weights[key] = weights
        return self._weights[key]

    def _move(self, name: str, on_backward: OnBackward) -> None:
        values = self.values[f"{PREFIX}{name}"]
        if dr.grad_enabled(values):
            values = dr.custom(Watched, {name: values}, lambda gradients: on_backward(name, gradients[name]))[name]
        self._moved[name] = values
        for follows, take in self._followers:
            if follows == name:
                take(values)

    def _require_values(self, name: str) -> None:
        values, (count, size) = self.values[f"{PREFIX}{name}"], self._channels[name].values.shape
        if dr.width(values) != count * size:
            raise ValueError(
                f"{dr.width(values)} numbers; expected {count * size}, {size} for each of {count} values at the cage"
            )
        if is_recording():
            return
        take_over(values)
        if not dr.all(dr.isfinite(values)):
            wrong = np.flatnonzero(~np.isfinite(np.array(dr.detach(values))))
            raise ValueError(f"number {wrong[0]} is not finite; expected finite numbers ({len(wrong)} such in all)")
