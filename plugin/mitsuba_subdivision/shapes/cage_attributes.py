"""Texture coordinates and attributes at the cage, as parameters that the shape follows.

    attribute_parameters.py  reads what a scene gives
    cage_attributes.py       what `traverse` shows of it, and the mesh's buffers: this module
    exact_shading.py         values at hits
    displacement.py          heights

An attribute NAME is the parameter ``cage_NAME``: all its values at the cage, flat. Its values at the tessellation are
weights times these, and are the buffer ``vertex_NAME``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..kernels.alignment import aligned
from ..mesh.shared import Content, Shared
from ..schemes.domain import FloatArray
from .attribute_parameters import mesh_name
from .moving_vertices import Watched, computed_ones, warn_of_lost
from .parameter_table import errors_about
from .triangles import SharedArray

if TYPE_CHECKING:
    from scipy import sparse

    from ..patches import Channel
    from ..surface import LimitSurface
    from ..tessellation import AttributeTable, VertexTable

PREFIX = "cage_"


_UPLOADED: Shared[SharedArray] = Shared()

# Called with an attribute's name and a gradient by its values, when that has come back to them.
OnBackward = Callable[[str, Any], None]


class CageAttributes:
    """Values of a cage's texture coordinates and attributes, and the buffers that follow them.

    Weights are made when a value first changes: shapes whose values stay do without.

    Parameters
    ----------
    variant : module
    surface : LimitSurface
    names : iterable of str
        Of the attributes that `traverse` shows.

    Attributes
    ----------
    values : dict of str to flat array
        By the parameters' names, such as "cage_texcoords".
    moving : set of str
        Names of those parameters that move vertices.
    """

    def __init__(self, variant: Any, surface: LimitSurface, names: Iterable[str]) -> None:
        self._source = surface.cage.source.name
        self._float = variant.Float if dr.is_jit_v(variant.Float) else None
        self._channels: dict[str, Channel] = {name: surface.channel(name) for name in names}
        kind = self._float or dr.scalar.ArrayXf
        self.values: dict[str, Any] = {
            f"{PREFIX}{name}": kind(channel.values.ravel()) for name, channel in self._channels.items()
        }
        self.moving: set[str] = set()
        self._followers: list[tuple[str, Callable[[Any], None]]] = []
        # Of those that are not what was loaded any more: as derivatives see them.
        self._moved: dict[str, Any] = {}
        self._computed: dict[str, set[int]] = {}

    def add_follower(self, name: str, take: Callable[[Any], None], *, moves: bool = False) -> None:
        """Have a function called with all other values that an attribute takes, and maybe vertices move by them."""
        self._followers.append((name, take))
        if moves:
            self.moving.add(f"{PREFIX}{name}")

    def traverse(self, callback: Any) -> None:
        """Show the parameters."""
        flags = mi.ParamFlags
        for name, values in self.values.items():
            moves = flags.Discontinuous if name in self.moving else flags.Differentiable
            callback.put(name, values, flags.Differentiable | moves)

    def set_triangles(self, table: VertexTable, attributes: AttributeTable) -> None:
        """Take over the vertices of a tessellation."""
        self._loaded = attributes.values
        shown = {name: values for name, values in self._loaded.items() if name in self._channels}
        self._uploaded = {name: self._upload(values) for name, values in shown.items()}
        self._locations = attributes.locate or table.locations
        self._weights: dict[tuple, Any] = {}

    def update(self, keys: Iterable[str], on_backward: OnBackward) -> list[str]:
        """Take over the parameters among some keys.

        Returns
        -------
        list of str
            Names of their attributes.

        Raises
        ------
        ValueError
            If there are more or fewer values than before, or one is no finite number.
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

    def renew(self, name: str, gradient: Any, on_backward: OnBackward) -> None:
        """Attach what follows an attribute to its values once more, after a gradient has come to them."""
        if self._computed[name] - computed_ones(self.values[f"{PREFIX}{name}"]) and dr.any(gradient != 0):
            warn_of_lost(self._source, f"{PREFIX}{name}")
        self._move(name, on_backward)

    def buffers(self, names: Iterable[str] | None = None) -> dict[str, Any]:
        """Those of the mesh that hold some attributes, by default all, by the buffers' names."""
        chosen = self._channels if names is None else names
        return {mesh_name(name): self._at_vertices(name) for name in chosen if name in self._loaded}

    def _upload(self, values: FloatArray) -> SharedArray:
        """A mesh's buffer of values; in JIT variants the array that meshes of the same values have."""

        def make() -> SharedArray:
            # Rendering reads texture coordinates in packets.
            found = aligned(values, dtype=np.float32)
            return SharedArray(found if self._float is None else self._float(found.ravel()))

        return make() if self._float is None else _UPLOADED.get((self._float, Content(values)), make)

    def _at_vertices(self, name: str) -> Any:
        if name not in self._moved:
            return self._uploaded[name].array
        values, channel = self._moved[name], self._channels[name]
        # Attributes whose values are of the same vertices of the same mesh have the same weights.
        key = type(channel), id(channel.patches), channel.value_index.tobytes()
        if key not in self._weights:
            self._weights[key] = self._weights_of(channel)
        size = channel.values.shape[1]
        if self._float is not None:
            return self._weights[key](values, size)
        found = self._weights[key] @ np.array(values, dtype=np.float64).reshape(-1, size)
        return aligned(found, dtype=np.float32)

    def _weights_of(self, channel: Channel) -> Any:
        weights: sparse.csr_array = channel.weights(*self._locations())
        if self._float is None:
            return weights
        from ..kernels.control_values import WeightedValues

        return WeightedValues(weights, self._float)

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
        if not dr.all(dr.isfinite(values)):
            wrong = np.flatnonzero(~np.isfinite(np.array(dr.detach(values))))
            raise ValueError(f"number {wrong[0]} is not finite; expected finite numbers ({len(wrong)} such in all)")
