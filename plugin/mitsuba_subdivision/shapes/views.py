"""One loss of several views of a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mitsuba as mi

from ..kernels.types import Float


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

    ``dr.backward`` of the sum reaches all variables that the scene's parameters were computed from. With one
    ``dr.backward`` per view, only the first would: after it, Dr.Jit forgets how the parameters were computed.

    Parameters
    ----------
    scene : mi.Scene
    params : mi.SceneParameters
        Of the scene, updated.
    loss : callable
        Takes a picture, ``(height, width, channels)``, and the index of its view; returns a differentiable number.
    sensors : sequence of int or mi.Sensor, optional
        By default all sensors of the scene.
    seed : int
        Each view of each seed has random numbers of its own.
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
    # Mitsuba's stub wants an array for the seed, but a number does.
    render: Any = mi.render
    sensors = range(len(scene.sensors())) if sensors is None else sensors
    if not len(sensors):
        raise ValueError("no views: expected a scene with sensors, or some sensors")
    return sum(
        loss(render(scene, params, sensor=sensor, seed=seed * len(sensors) + view, **options), view)
        for view, sensor in enumerate(sensors)
    )
