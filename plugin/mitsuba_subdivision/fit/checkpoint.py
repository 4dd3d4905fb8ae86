"""The state of a fit, saved to a file and resumed from it."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import upload
from ..whole_file import whole_file

# Raised with the layout of the file.
FORMAT = 1

# Arrays by their names.
State = Mapping[str, NDArray]


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A fit after some steps."""

    # How often the cage was refined, and steps since the last time
    refinements: int
    since: int
    losses: NDArray[np.float64]  # (n,) float64
    states: Mapping[str, State]  # What the steps have changed, as arrays by their names

    def save(self, path: Path) -> None:
        """Write a NumPy file, ``.npz``."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in ("refinements", "since", "losses")}
        arrays["format"] = FORMAT
        for name, state in self.states.items():
            arrays.update({f"{name}: {field}": values for field, values in state.items()})
        with whole_file(path) as unfinished, unfinished.open("wb") as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> Checkpoint:
        """Read a file that `save` has written. Raises ValueError if it is none."""
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        except (ValueError, AttributeError, zipfile.BadZipFile, EOFError) as error:
            raise ValueError(f'"{path}" is no checkpoint of a fit: {error}') from error
        if "format" not in arrays or int(arrays["format"]) != FORMAT:
            raise ValueError(f'"{path}" is no checkpoint of a fit, or one of another version of this package')
        states: dict[str, dict[str, NDArray]] = {}
        for key, values in arrays.items():
            name, _, field = key.rpartition(": ")
            if name:
                states.setdefault(name, {})[field] = values
        return cls(int(arrays["refinements"]), int(arrays["since"]), arrays["losses"], states)

    def state(self, name: str, like: State) -> State:
        """A state. Raises ValueError if there is none of that name, or its arrays have other shapes than these."""
        found = self.states.get(name, {})
        shapes = [{field: np.shape(values) for field, values in each.items()} for each in (found, like)]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f'the checkpoint has no "{name}" of this fit; expected that of a fit with the same arguments'
            )
        return found


def adam_state(optimizer: mi.ad.Optimizer, name: str) -> State:
    """A variable of ``mi.ad.Adam``, with the moving averages of its gradient and of that squared."""
    value, _, _, (steps, first, second, *_) = optimizer.state[name]
    return {"value": np.array(value), "steps": np.array(steps), "first": np.array(first), "second": np.array(second)}


def restore_adam(optimizer: mi.ad.Optimizer, name: str, state: State) -> None:
    """Give a state to a variable of ``mi.ad.Adam``."""
    value, _, _, (steps, first, second, *_) = optimizer.state[name]
    optimizer[name] = upload(type(value), state["value"])
    value, promoted, rate, (*_, more) = optimizer.state[name]
    moments = [upload(type(now), state[key]) for key, now in (("steps", steps), ("first", first), ("second", second))]
    optimizer.state[name] = value, promoted, rate, (*moments, more)
