"""Derivatives through the computations of a shape, which Dr.Jit forgets after each reverse-mode pass."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any
from weakref import WeakMethod, ref

import drjit as dr
import mitsuba as mi

from ..cage.errors import warn
from ..kernels.array_types import Float
from ..kernels.linear_maps import attached
from .device_state import is_recording


class BackwardPasses:
    """Follows gradients to parameters of a shape, and warns if they cannot reach the variables behind these.

    Dr.Jit forgets how a variable was computed once a gradient has passed through it. It processes variables from the
    newest to the oldest, and then keeps gradients of those alone that were not computed. So a probe, a variable older
    than the parameters, finds in the first pass after an update which parameters were computed.
    """

    def __init__(
        self,
        name: str,  # Name of the shape in messages
        parameters: str,  # Their names
        float_type: type,  # Flat Dr.Jit array
    ) -> None:
        self._name, self._parameters, self._float = name, parameters, float_type
        self._sources: list[Any] = []
        self._is_lost = False
        self._probe, self._next = None, self._made()

    def begin(
        self,
        sources: Iterable[Any],  # Values of the parameters
    ) -> None:
        """Begin with updated parameters, which are differentiated."""
        self._sources, self._is_lost = [source for source in sources if dr.grad_enabled(source)], False
        self._probe, self._next = self._next, self._made()

    def watched(
        self,
        arrays: dict[str, Any],  # Differentiated, computed from the parameters
        method: WeakMethod,  # Weak, as the arrays must not keep the shape alive
        *arguments: Any,
    ) -> dict[str, Any]:
        """Return the same arrays. A method is called with gradients by name after reverse mode has passed them."""

        def backward(*gradients: Any) -> tuple:
            call = method()
            if call is not None:
                call(*arguments, dict(zip(names, gradients, strict=True)))
            return (*gradients, 0)

        # Copies, as arrays that are assigned in place would keep their own derivatives alive, and so for ever.
        names, given = tuple(arrays), tuple(type(array)(array) for array in arrays.values())
        detached, probe = tuple(map(dr.detach, given)), self._float(0) if self._probe is None else self._probe
        through = attached(detached, (*given, probe), lambda changes: changes[: len(given)], backward)
        self._probe = None
        return dict(zip(names, through, strict=True))

    def warn_of_lost(
        self,
        gradients: Iterable[Any],  # Zero for shapes of scenes that are no longer used
    ) -> None:
        """Warn if gradients have reached parameters, but not the variables that these depend on."""
        is_lost = self._is_lost and not is_recording()
        if is_lost and any(dr.any(gradient != 0, axis=None) for gradient in gradients):
            warn(
                f"{self._name}: gradients reached {self._parameters} a second time since the last update, but not the "
                "variables that these were computed from, as Dr.Jit forgets a computation after one backward pass; "
                "assign and update the parameters before each view, or differentiate the sum of loss_of_views"
            )

    def _made(self) -> Any:
        if is_recording():
            return None
        reference = ref(self)

        def backward(_gradient: Any) -> Any:
            passes = reference()
            if passes is not None:
                passes._is_lost = not all(map(_has_gradient, passes._sources))
            return 0

        start = self._float(0)
        dr.enable_grad(start)
        return attached(self._float(0), start, lambda change: change, backward)


def _has_gradient(variable: Any) -> bool:
    """Whether a variable has a gradient: Dr.Jit returns literal zeros if it has none."""
    if dr.is_tensor_v(variable):
        variable = variable.array
    if dr.depth_v(variable) > 1:
        return any(map(_has_gradient, variable))
    return dr.grad(variable).state != dr.VarState.Literal


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
