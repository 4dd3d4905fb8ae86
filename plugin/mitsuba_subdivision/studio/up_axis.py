"""Up axis of a model's file."""

from __future__ import annotations

from pathlib import Path

from ..files.formats import FORMATS


def up_axis_of(path: Path) -> str:
    """Axis of a model's file that points up: "y" or "z".

    Raises
    ------
    CageError
        If a USD file cannot be opened.
    """
    found = FORMATS.get(path.suffix.lower())
    if found is not None and found.up is not None:
        return found.up
    from ..files.usd_stage import stage_up_axis

    return stage_up_axis(path)
