"""The fit of a cage to pictures of its limit surface, step by step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from ..cage import ControlCage
from ..schemes.domain import FloatArray
from ..surface import LimitSurface
from .checkpoint import Checkpoint, State, adam_state, restore_adam
from .fitting import Fit
from .large_steps import LargeSteps
from .regularizers import DeviceRegularizer, Regularizer
from .schedule import Schedulable, Schedule
from .views import CONTROL_POINTS, Loss, Pictures, View

# What the optimiser calls the coordinates of the control points.
U = "u"


class CageFit(Fit):
    """Moves the control points of a cage until its limit surface looks like some pictures.

    Every step renders all views into one graph, differentiates it once, and moves the points by Adam, in coordinates in
    which steps are large and smooth (`LargeSteps`). From coarse to fine, the cage is refined on the way: its surface
    stays, and control points become four times as many.

    Parameters
    ----------
    cage : ControlCage
        Where to begin. Its topology, tags and rules stay, but for refinement.
    views : sequence of View
    scene : dict
        What there is in the pictures besides the surface, as for ``mi.load_dict``: emitters, other shapes, and the
        integrator if it is not to be ``direct_projective``.
    shape : dict, optional
        Parameters of the shape besides its cage, such as its ``bsdf`` and ``tessellation_rate``, 4 by default.
    scheme : str, optional
        By default that of the cage, or Catmull-Clark.
    loss : "l1", "l2" or callable
        Mean absolute or squared difference of pictures, of which noise biases the absolute one; or a differentiable
        function of a picture and the index of its view.
    learning_rate : float or schedule
        How far a step moves the points at most, about, in diagonals of the box around ``cage``.
    smoothing : float
        How far steps reach, as λ of `LargeSteps`; 0 to move each point for itself.
    laplacian : "cage" or "surface"
        Whose Laplacian smooths steps: that of the cage's edges, or of the limit surface where the fit begins.
    regularizers : dict of str to float or schedule, optional
        Weights of what keeps the cage even: "laplacian" (of the cage), "bending" (of the limit surface) and "anchor"
        (where the points began).
    others : dict of str to float or schedule, optional
        Learning rates of other parameters of the scene, by their names in `mi.traverse`. The shape's begin with
        "surface".
    refine : sequence of int, or int
        Steps before which the cage is refined; or how often, each time when the loss has stopped falling.
    spp, edge_spp : int
        Samples of each pixel, and of outlines for each pixel.
    seed : int
    callbacks : sequence of callable
        Called with the fit after each step.

    Raises
    ------
    ValueError
        If an option, a view or a parameter's name is invalid, or the variant has no derivatives.
    CageError, SchemeError
        As `LimitSurface`; from `step`, if a cage cannot be refined.
    """

    def __init__(
        self,
        cage: ControlCage,
        views: Sequence[View],
        scene: Mapping[str, Any],
        *,
        shape: Mapping[str, Any] | None = None,
        scheme: str | None = None,
        loss: Loss = "l2",
        learning_rate: Schedulable = 0.02,
        smoothing: float = 3.0,
        laplacian: Literal["cage", "surface"] = "cage",
        regularizers: Mapping[str, Schedulable] | None = None,
        others: Mapping[str, Schedulable] | None = None,
        refine: Sequence[int] | int = (),
        spp: int = 4,
        edge_spp: int = 1,
        seed: int = 0,
        callbacks: Sequence[Callable[[CageFit], None]] = (),
    ) -> None:
        if laplacian not in ("cage", "surface"):
            raise ValueError(f'laplacian "{laplacian}"; expected "cage" or "surface"')
        shape = {"tessellation_rate": 4, **(shape or {})}
        if scheme is not None:
            shape["scheme"] = scheme
        self._pictures = Pictures(views, scene, shape, loss, spp, edge_spp)
        self._size = float(np.linalg.norm(np.ptp(cage.positions, axis=0)))
        self._learning_rate = Schedule.of(learning_rate, "learning_rate")
        self._smoothing, self._laplacian, self._seed = smoothing, laplacian, seed
        self._weights = {name: Schedule.of(each, f"regularizer {name}") for name, each in (regularizers or {}).items()}
        self._other_rates = {name: Schedule.of(each, f"others {name}") for name, each in (others or {}).items()}
        super().__init__(cage, scheme, refine, callbacks)
        self._others = mi.ad.Adam(lr=1.0)
        for name in self._other_rates:
            if name not in self._pictures.params:
                raise ValueError(f'others has "{name}"; expected one of {", ".join(self._pictures.params.keys())}')
            self._others[name] = self._pictures.params[name]

    def _load(self, start: LimitSurface, positions: FloatArray) -> None:
        self._pictures.load(start.cage)
        self._steps: LargeSteps | None = None
        if self._smoothing:
            laplacian = start.cage.laplacian() if self._laplacian == "cage" else start.stiffness()
            self._steps = LargeSteps(laplacian, self._smoothing)
        self._regularizers = {name: DeviceRegularizer(Regularizer.named(name, start)) for name in self._weights}
        self._optimizer = mi.ad.Adam(lr=1.0, uniform=True)
        flat = mi.Float(positions.ravel())
        self._optimizer[U] = flat if self._steps is None else self._steps.to_differential(flat)

    @property
    def control_points(self) -> FloatArray:
        """``(n, 3)`` control points as they are now."""
        with dr.suspend_grad():
            return np.array(self._points(), dtype=np.float64).reshape(-1, 3)

    @property
    def scene(self) -> Any:
        """The scene of the last step, with its surface."""
        return self._pictures.scene

    def values(self) -> dict[str, Any]:
        """Other parameters of the scene that are fitted, as they are now."""
        return {name: dr.detach(self._others[name]) for name in self._other_rates}

    def _points(self) -> Any:
        """Flat control points, computed from what the optimiser moves."""
        u = self._optimizer[U]
        return u if self._steps is None else self._steps.from_differential(u)

    def _step(self, number: int) -> float:
        points = self._points()
        loss = self._pictures.loss({CONTROL_POINTS: points, **dict(self._others)}, self._seed + number)
        total = loss
        for name, regularizer in self._regularizers.items():
            total += dr.opaque(mi.Float, self._weights[name](number)) * regularizer(points)
        dr.backward(total)
        self._optimizer.set_learning_rate(self._learning_rate(number) * self._size)
        self._optimizer.step()
        if self._other_rates:
            self._others.set_learning_rate({name: rate(number) for name, rate in self._other_rates.items()})
            self._others.step()
        return float(np.array(loss).ravel()[0])

    def _states(self) -> dict[str, State]:
        others = {f"other {name}": adam_state(self._others, name) for name in self._other_rates}
        return {"points": adam_state(self._optimizer, U), **others}

    def _restore(self, found: Checkpoint) -> None:
        states = {name: found.state(name, own) for name, own in self._states().items()}
        restore_adam(self._optimizer, U, states["points"])
        for name in self._other_rates:
            restore_adam(self._others, name, states[f"other {name}"])
