"""Derivatives of what a shape computes from its parameters, which Dr.Jit forgets after each reverse-mode pass."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any
from weakref import WeakMethod

import drjit as dr
import mitsuba as mi

from ..cage.errors import warn
from ..kernels.array_types import Float
from ..kernels.linear_maps import attached
from .device_state import is_recording

# Number of bits of a Dr.Jit variable index. The index of its derivative is in the bits above.
_HALF = 32


def watched(
    arrays: dict[str, Any],  # Differentiated
    method: WeakMethod,  # Weak, as the arrays must not keep the shape alive
    *arguments: Any,
) -> dict[str, Any]:
    """The same arrays. Calls a method with gradients by name after reverse mode has passed through them."""

    def backward(*gradients: Any) -> tuple:
        call = method()
        if call is not None:
            call(*arguments, dict(zip(arrays, gradients, strict=True)))
        return gradients

    given = tuple(arrays.values())
    through = attached(tuple(map(dr.detach, given)), given, lambda changes: changes, backward)
    return dict(zip(arrays, through, strict=True))


def warn_of_lost(
    name: str,
    parameters: str,
    arrays: Iterable[Any],  # Of the parameters
    computed: set[int],  # Their `computed_ones` at the last update
    gradients: Iterable[Any],  # Zero for shapes of scenes that are no longer used
) -> None:
    """Warn if a gradient has reached parameters of a shape, but not the variables that they were computed from."""
    is_lost = bool(computed - computed_ones(*arrays)) and not is_recording()
    if is_lost and any(dr.any(gradient != 0, axis=None) for gradient in gradients):
        warn(
            f"{name}: gradients came to {parameters} a second time since the last update, and could not go on to the "
            "variables that these were computed from, as Dr.Jit forgets a computation once gradients have passed "
            "through it; assign the parameters and update before each view, or differentiate one loss of all views, "
            "as loss_of_views computes it"
        )


def loss_of_views(
    scene: mi.Scene,
    params: mi.SceneParameters,
    loss: Callable[[mi.TensorXf, int], Float],
    sensors: Sequence[int | mi.Sensor] | None = None,
    *,
    seed: int = 0,
    **options: Any,
) -> Float:
    """Render a scene through several sensors, and sum a loss of each image.

    ``dr.backward`` of the sum reaches all variables that the scene's parameters were computed from. With one call of
    ``dr.backward`` per view, only the first one would: Dr.Jit then forgets how the parameters were computed.

    Parameters
    ----------
    scene : mi.Scene
    params : mi.SceneParameters
        Parameters of the scene, updated.
    loss : callable
        Function of an image, ``(height, width, channels)``, and the index of its view; returns a differentiable number.
    sensors : sequence of int or mi.Sensor, optional
        By default all sensors of the scene.
    seed : int
        Each pair of a seed and a view has different random numbers.
    **options
        As for ``mi.render``: ``spp``, ``spp_grad``, ``integrator``.

    Returns
    -------
    Dr.Jit float

    Raises
    ------
    ValueError
        If there is no sensor.
    """
    # Mitsuba's stub only accepts an array as seed.
    render: Any = mi.render
    sensors = range(len(scene.sensors())) if sensors is None else sensors
    if not len(sensors):
        raise ValueError("no views: expected a scene with sensors, or some sensors")
    return sum(
        loss(render(scene, params, sensor=sensor, seed=seed * len(sensors) + view, **options), view)
        for view, sensor in enumerate(sensors)
    )


def computed_ones(*values: Any) -> set[int]:
    """Find arrays whose derivatives depend on other variables in Dr.Jit's graph.

    A variable whose gradient was enabled directly has no such dependence, nor has an array after a gradient has passed
    through its computation, which Dr.Jit then removes by default.

    Returns set of int: Dr.Jit's indices of the arrays' derivatives.
    """
    derivatives = {index >> _HALF for value in values for index in dr.detail.collect_indices(value)} - {0}
    graph = str(dr.graphviz_ad(as_string=True))
    return {index for index in derivatives if f" {index} -> " in graph}
