"""A stage that is opened once and read at several times."""

from __future__ import annotations

import math
import warnings
import weakref
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..cage.errors import CageWarning, warn
from .contents import SceneContents
from .materialx_library import library
from .stage_walk import is_still, open_checked, read_open_camera, read_open_stage

if TYPE_CHECKING:
    from pxr import Usd


class StageReader:
    """Reads a stage at several times.

    Each warning is given once, however many times it applies to. Where cameras alone move, all but them is read once.

    Parameters
    ----------
    path : str or Path
    camera : str, optional
        Path of the camera; by default, that of the stage's render settings, or its first one.
    warned : set of str, optional
        Warnings about other files, without their names; those about this one are added.

    Raises
    ------
    OSError
        If the file cannot be read.
    """

    def __init__(self, path: str | Path, camera: str | None = None, warned: set[str] | None = None) -> None:
        with Path(path).open("rb"):
            pass  # So that a missing file is an OSError, as for other formats.
        self._path, self._camera = path, camera
        self._stage: Usd.Stage | None = None
        # The first contents, and, from the second time on, whether they stay but for the camera.
        self._first: SceneContents | None = None
        self._is_still: bool | None = None
        self._warned = set() if warned is None else warned
        # It takes a dozen megabytes, which no scene needs.
        weakref.finalize(self, library.cache_clear)

    def at(self, time: float | None = None) -> SceneContents:
        """Contents of the stage at a time code; see `read_stage`.

        Raises
        ------
        CageError
            As `read_stage`.
        ValueError
            If the time is not finite.
        """
        if time is not None and not math.isfinite(time):
            raise ValueError(f'"{self._path}": time {time}; expected a finite number, a time code')
        code = None if time is None else float(time)
        caught: list[warnings.WarningMessage] = []
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", CageWarning)
                return self._contents(f'"{self._path}"', code)
        finally:
            for each in caught:
                self._pass_on(each)

    def _pass_on(self, warning: warnings.WarningMessage) -> None:
        """Give a warning that was caught, if it is not one of the cage's that has been given."""
        if not issubclass(warning.category, CageWarning):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
            return
        message = str(warning.message)
        what = message.replace(str(self._path), "")
        if what not in self._warned:
            self._warned.add(what)
            warn(message)

    def _contents(self, name: str, time: float | None) -> SceneContents:
        self._stage = self._stage or open_checked(self._path)
        if self._first is not None and self._is_still is None:
            self._is_still = is_still(self._stage)
        if self._first is None or not self._is_still:
            contents = read_open_stage(self._stage, name, time, self._camera)
            # Kept only where it may serve.
            self._first = contents if self._is_still is None else None
            return contents
        camera, resolution = read_open_camera(self._stage, name, time, self._camera)
        return replace(self._first, camera=camera, resolution=resolution)
