"""The base of all fits of cages: steps, refinement, checkpoints, schedules."""

from __future__ import annotations

import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..messages import counted
from ..refinement.cage_refinement import CageRefinement
from ..schemes.domain import FloatArray
from ..surface import LimitSurface
from ..whole_file import whole_file

if TYPE_CHECKING:
    from typing_extensions import Self

# Steps in a mean of the loss, and relative decrease between two means below which the loss has stopped falling.
STEPS_OF_MEAN, LEAST_FALL = 10, 0.02

FORMAT = 2  # Version of checkpoints; their coordinates of control points depend on λ of large steps

State = Mapping[str, NDArray]  # State of a fit: arrays by name, "variable: field"
Schedulable = float | Sequence[tuple[float, float]] | Callable[[int], float]  # A number, or a schedule of users


class Fit(ABC):
    """Base class of `CageFit` and `PointFit`.

    Attributes
    ----------
    losses : list of float
        Loss before each step.
    refinements : int
        Number of refinements so far.
    """

    def __init__(
        self,
        cage: ControlCage,
        scheme: str | None,
        refine: Sequence[int] | int,
        callbacks: Sequence[Callable[[Any], None]],
    ) -> None:
        self._refine, self._callbacks, self._scheme = refine, tuple(callbacks), scheme
        self.losses: list[float] = []
        self.refinements = 0
        self._since = 0  # Steps since the last refinement
        self._start = cage  # With the initial control points, refined like the cage
        self._load(LimitSurface(cage, scheme), cage.positions)

    @abstractmethod
    def _load(self, start: LimitSurface, positions: FloatArray) -> None:
        """Start from control points of a cage whose initial surface is `start`."""

    @abstractmethod
    def _step(self, number: int) -> float:
        """Take a step, numbered from 0, and return the loss before it."""

    def _follow(self, refinement: CageRefinement) -> None:  # noqa: B027 - not all fits have any
        """Update the state after a refinement, except control points; `_load` comes next."""

    @abstractmethod
    def _state(self) -> State:
        """State that steps change."""

    @abstractmethod
    def _restore(self, state: State) -> None:
        """Restore `_state`, with arrays of the same shapes."""

    @property
    @abstractmethod
    def control_points(self) -> FloatArray:
        """``(n, 3)`` current control points."""

    @property
    def cage(self) -> ControlCage:
        """The current cage, with its tags."""
        return self._start.with_positions(self.control_points)

    def step(self) -> float:
        """Take a step, and return the loss before it.

        Raises CageError and SchemeError as `ControlCage.refinement` if the cage is due to be refined.
        """
        number = len(self.losses)
        if self._is_time_to_refine(number):
            self.refine()
        loss = self._step(number)
        self._since += 1
        self.losses.append(loss)
        for callback in self._callbacks:
            callback(self)
        return loss

    def run(self, steps: int, checkpoint: str | Path | None = None, every: int = 50) -> Self:
        """Take some steps, and count them on a terminal.

        Parameters
        ----------
        steps : int
        checkpoint : path, optional
            File for `save_checkpoint` after every ``every`` steps, at the end, and of the last whole step after Ctrl-C.
        every : int
        """
        if every < 1:
            raise ValueError(f"every {every}; expected 1 or more")
        if checkpoint is None:
            for _ in counted(range(steps), "Steps"):
                self.step()
            return self
        complete = self._arrays()
        try:
            for number in counted(range(1, steps + 1), "Steps"):
                self.step()
                complete = self._arrays()
                if number % every == 0 or number == steps:
                    _save(checkpoint, complete)
        except (KeyboardInterrupt, RuntimeError):  # Ctrl-C is the cause of a RuntimeError where Dr.Jit traces a render.
            # Interruptions of callbacks come after the step.
            _save(checkpoint, self._arrays() if len(self.losses) > len(complete["losses"]) else complete)
            raise
        return self

    def _is_time_to_refine(self, number: int) -> bool:
        if not isinstance(self._refine, int):
            return number in self._refine and (self._since > 0 or number == self.refinements == 0)
        if self.refinements >= self._refine or self._since < 2 * STEPS_OF_MEAN:
            return False
        before, now = np.mean(np.reshape(self.losses[-2 * STEPS_OF_MEAN :], (2, -1)), axis=1)
        return bool(now > (1 - LEAST_FALL) * before)

    def refine(self) -> None:
        """Refine the cage once: the same surface, with about four times as many control points.

        Raises CageError and SchemeError as `ControlCage.refinement`.
        """
        refinement = self.cage.refinement(self._scheme)
        self._follow(refinement)
        self._start = refinement.cage.with_positions(refinement.matrix @ self._start.positions)
        self.refinements += 1
        self._since = 0
        self._load(LimitSurface(self._start, self._scheme), refinement.cage.positions)

    def save_checkpoint(self, path: str | Path) -> None:
        """Write the state for `resume`. If the file cannot be written, raises OSError; an existing one is unchanged."""
        _save(path, self._arrays())

    def _arrays(self) -> dict[str, Any]:
        counts = {"refinements": self.refinements, "since": self._since}
        # A copy, as later steps extend the list.
        return {"format": FORMAT, "losses": list(self.losses), **counts, **self._state()}

    def resume(self, path: str | Path) -> Self:
        """Resume from a checkpoint of a fit with the same arguments.

        Raises
        ------
        ValueError
            If the file is no checkpoint of such a fit.
        OSError
            If the file cannot be read.
        """
        path = Path(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        except (ValueError, AttributeError, zipfile.BadZipFile, EOFError) as error:
            raise ValueError(f'"{path}" is no checkpoint of a fit: {error}') from error
        if "format" not in arrays or int(arrays["format"]) != FORMAT:
            raise ValueError(f'"{path}" is no checkpoint of a fit, or one of another version of this package')
        refinements, own = int(arrays["refinements"]), self.refinements
        if own > refinements:
            raise ValueError(f'"{path}" was saved after {refinements} refinements; this fit has {own}')
        while self.refinements < refinements:
            self.refine()
        for name, values in self._state().items():
            if name not in arrays or arrays[name].shape != np.shape(values):
                lacking = f'the checkpoint has no "{name.partition(":")[0]}" of this fit'
                raise ValueError(f"{lacking}; expected that of a fit with the same arguments")
        self._restore(arrays)
        self.losses, self._since = arrays["losses"].tolist(), int(arrays["since"])
        return self


def _save(path: str | Path, arrays: dict[str, Any]) -> None:
    with whole_file(path) as unfinished, unfinished.open("wb") as file:
        np.savez(file, **arrays)


@dataclass(frozen=True, eq=False)
class Schedule:
    """A number as a function of the step."""

    function: Callable[[int], float]

    @classmethod
    def of(cls, given: Schedulable, name: str) -> Schedule:
        """A schedule of a number, of pairs ``(step, value)``, or of a function.

        Steps increase, counted from 0. Interpolation is linear, or exponential if all values are positive. Values
        before the first and after the last step are constant.

        Raises
        ------
        ValueError
            For any other value, or if steps do not increase; the message contains the name.
        """
        if callable(given):
            return cls(given)
        if isinstance(given, Real):
            given = [(0, float(given))]
        try:
            pairs = np.array(given, dtype=np.float64)
        except (TypeError, ValueError):
            pairs = np.empty(0)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or not len(pairs) or not np.isfinite(pairs).all():
            raise ValueError(f"{name} is {given!r}; expected a number, pairs (step, value), or a function of the step")
        steps, values = pairs.T
        if (np.diff(steps) <= 0).any():
            raise ValueError(f"{name} has the steps {steps.tolist()}; expected increasing ones")
        if (values > 0).all():
            return cls(lambda step: np.exp(np.interp(step, steps, np.log(values))))
        return cls(lambda step: np.interp(step, steps, values))

    def __call__(self, step: int) -> float:
        """Value at a step."""
        return float(self.function(step))
