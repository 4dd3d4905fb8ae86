"""A stage that is opened once and read at several times."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

from ..cage.errors import CageError, CageWarning, warn
from ..files.usd_process import call_in_process, seconds_in_process
from .contents import TYPES, SceneContents
from .stage_walk import OpenStage, read_stage


class StageReader:
    """Reads a stage in this process, or at each time in a process of its own; see `files.usd_process`.

    What is told at one time is not told again at another.

    Parameters
    ----------
    path : str or Path
    camera : str, optional
        Path of the camera; by default, that of the stage's render settings, or its first one.
    told : set of str, optional
        What has been told of other files, without their names; what is told of this one is added.

    Raises
    ------
    OSError
        If the file cannot be read.
    """

    def __init__(self, path: str | Path, camera: str | None = None, told: set[str] | None = None) -> None:
        with Path(path).open("rb"):
            pass  # So that a missing file is an OSError, as for other formats.
        self._path, self._camera = path, camera
        self._seconds = seconds_in_process()
        self._stage: OpenStage | None = None
        self._told = set() if told is None else told

    def at(self, time: float | None = None) -> SceneContents:
        """What the stage holds at a time code; by default, at the first one of each value.

        Raises
        ------
        CageError
            As `read_stage`; also if the process crashes or takes longer.
        ValueError
            If the time is not finite.
        """
        if time is not None and not math.isfinite(time):
            raise ValueError(f'"{self._path}": time {time}; expected a finite number, a time code')
        code = None if time is None else float(time)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", CageWarning)
            contents = self._read(code)
        for message in (str(each.message) for each in caught):
            what = message.replace(str(self._path), "")
            if what not in self._told:
                self._told.add(what)
                warn(message)
        return contents

    def require_shapes(self, contents: SceneContents) -> SceneContents:
        """The contents, if there is something to be seen.

        Raises
        ------
        CageError
            If there is not.
        """
        if not contents.shapes and not contents.instances:
            raise CageError(f'"{self._path}": there is nothing to be seen; expected visible meshes')
        return contents

    def _read(self, time: float | None) -> SceneContents:
        if self._seconds is None:
            self._stage = self._stage or OpenStage(self._path)
            return self._stage.at(time, self._camera)
        arguments: dict[str, Any] = {"time": time, "camera": self._camera}
        return call_in_process(read_stage, self._path, arguments, self._seconds, TYPES)
