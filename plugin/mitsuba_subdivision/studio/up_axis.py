"""Up axis of a model's file."""

from __future__ import annotations

from pathlib import Path

from ..cage.errors import warn

# What modelling programs write by default: OBJ files of Blender, Maya and Houdini have y up, PLY files of Blender z.
# USD files store it.
DEFAULT_UP = {".obj": "y", ".ply": "z"}


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
    suffix = path.suffix.lower()
    if suffix in DEFAULT_UP:
        return DEFAULT_UP[suffix]
    from ..files.usd_process import ENVIRONMENT_VARIABLE, seconds_in_process
    from ..files.usd_stage import stage_up_axis

    if seconds_in_process() is not None:
        warn(f'"{path}": the up axis is not read while {ENVIRONMENT_VARIABLE} is set; y is used')
        return "y"
    return stage_up_axis(path)
