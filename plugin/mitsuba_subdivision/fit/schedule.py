"""Numbers that change from step to step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Real

import numpy as np

from ..schemes.domain import FloatArray

# A number, or what users may give instead.
Schedulable = float | Sequence[tuple[float, float]] | Callable[[int], float]


@dataclass(frozen=True, eq=False)
class Schedule:
    """A number at every step: one number, a line through several, or a function.

    Parameters
    ----------
    steps, values : (n,) float64
        In increasing order of the steps, counted from 0. Between two of them, the values lie on a line; on an
        exponential, if all are positive. Before the first and after the last step they stay.
    function : callable, optional
        Maps a step to its value, instead of ``steps`` and ``values``.
    """

    steps: FloatArray
    values: FloatArray
    function: Callable[[int], float] | None = None

    @classmethod
    def of(cls, given: Schedulable, name: str) -> Schedule:
        """A schedule of a number, of pairs ``(step, value)``, or of a function.

        Raises
        ------
        ValueError
            If it is none of these, or if steps do not increase; the message has the name.
        """
        if callable(given):
            return cls(np.zeros(1), np.zeros(1), given)
        if isinstance(given, Real):
            given = [(0, float(given))]
        try:
            pairs = np.array(given, dtype=np.float64)
        except (TypeError, ValueError):
            pairs = np.empty(0)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or not len(pairs) or not np.isfinite(pairs).all():
            raise ValueError(f"{name} is {given!r}; expected a number, pairs (step, value), or a function of the step")
        if (np.diff(pairs[:, 0]) <= 0).any():
            raise ValueError(f"{name} has the steps {pairs[:, 0].tolist()}; expected increasing ones")
        return cls(*pairs.T)

    def __call__(self, step: int) -> float:
        """Value at a step."""
        if self.function is not None:
            return float(self.function(step))
        if (self.values > 0).all():
            return float(np.exp(np.interp(step, self.steps, np.log(self.values))))
        return float(np.interp(step, self.steps, self.values))
