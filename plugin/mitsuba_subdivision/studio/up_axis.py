"""Up axis of a model's file."""

from __future__ import annotations

from pathlib import Path

from ..cage.errors import warn
from ..files.formats import FORMATS


def up_axis_of(path: Path) -> str:
    """Axis of a model's file that points up: "y" or "z".

    Raises
    ------
    CageError
        If a USD file cannot be opened.

    Warns
    -----
    CageWarning
        If USD files are read in a process of their own, which does not read the axis.
    """
    found = FORMATS.get(path.suffix.lower())
    if found is not None and found.up is not None:
        return found.up
    from ..files.usd_process import ENVIRONMENT_VARIABLE, seconds_in_process
    from ..files.usd_stage import stage_up_axis

    if seconds_in_process() is not None:
        warn(f'"{path}": the up axis is not read while {ENVIRONMENT_VARIABLE} is set; y is used')
        return "y"
    return stage_up_axis(path)
