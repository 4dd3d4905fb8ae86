"""One loss of several views of a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mitsuba as mi


def loss_of_views(
    scene: Any,
    params: Any,
    loss: Callable[[Any, int], Any],
    sensors: Sequence[Any] | None = None,
    *,
    seed: int = 0,
    **options: Any,
) -> Any:
    """Render a scene by several sensors, and add up what a function makes of the pictures.

    One ``dr.backward`` of the sum reaches whatever parameters have been computed from. With one of each view, only the
    first would: Dr.Jit forgets a way that gradients have taken.

    Parameters
    ----------
    scene : mi.Scene
    params : mi.SceneParameters
        Of the scene, updated.
    loss : callable
        Makes a differentiable number of a picture, ``(height, width, channels)``, and the number of its view.
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
    sensors = range(len(scene.sensors())) if sensors is None else sensors
    if not len(sensors):
        raise ValueError("no views: expected a scene with sensors, or some sensors")
    return sum(
        loss(mi.render(scene, params, sensor=sensor, seed=seed * len(sensors) + view, **options), view)
        for view, sensor in enumerate(sensors)
    )
