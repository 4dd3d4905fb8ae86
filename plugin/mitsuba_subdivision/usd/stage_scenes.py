"""Scenes of a whole stage: at one time, at times of its file, or of several files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageError
from ..regression.scene import LoadedScene
from ..studio.animation import load_quietly
from ..studio.frame_files import FrameFiles
from ..studio.look import Look
from ..studio.picture import MOST_SEGMENTS, MOST_TRIANGLES, outline_for, shading_for
from ..studio.stage import variant_in_use
from ..studio.view import View
from ..variants import SceneNode
from .contents import SceneContents
from .copies import with_copies
from .entries import Entries
from .limit_surfaces import Surfaces
from .loaded_shapes import LoadedShapes
from .notes import Notes
from .rates import is_chosen, triangles_for_picture, with_rate
from .sensors import sensor
from .stage_reader import StageReader
from .staging import angles_for, size_for, staged
from .texture_detail import texels_for_picture


class StageScenes:
    """A `SceneSource` of a whole stage, with the camera and the lights of the studio where it has none.

    Everything may move: shapes, their control points, instances, lights and the stage's camera. Limit surfaces whose
    topology stays keep their patches and weights. The studio's lights are there if no frame has lights.

    Parameters
    ----------
    path : str or Path
        A USD file; for frames also the name of several, with a number in it.
    look : Look
        Its view, size and samples.
    parameters : dict
        Of every shape ``subdivision``.
    time : float, optional
    camera : str, optional
        Path of the stage's camera.
    numbers : range, optional
        Times or numbers of files, if there are frames.
    """

    def __init__(
        self,
        path: str | Path,
        look: Look,
        parameters: dict[str, Any],
        *,
        time: float | None = None,
        camera: str | None = None,
        numbers: range | None = None,
    ) -> None:
        self.name = f'"{path}"'
        self._path, self._look, self._parameters = path, look, parameters
        self._time, self._camera = time, camera
        self._has_free_rates = not is_chosen(parameters)
        self._files = None if numbers is None else FrameFiles(Path(path), numbers)
        self._reader: StageReader | None = None
        self._warned: set[str] = set()
        self._surfaces = Surfaces()
        self._first: tuple[int | None, SceneContents] | None = None
        self._is_lit = False

    def at(self, number: int | None = None) -> SceneContents:
        """Visible contents of a frame; by default, at the given time.

        Raises
        ------
        CageError, OSError
            If it cannot be read, or if nothing is visible in a still picture.
        """
        if self._first is not None and self._first[0] == number:
            return self._first[1]
        path = self._path if self._files is None or number is None else self._files.file(number)
        time = self._time if self._files is None or number is None else self._files.time(number)
        if self._reader is None or (self._files is not None and self._files.are_many):
            self._reader = StageReader(path, self._camera, warned=self._warned)
        contents = self._reader.at(time)
        if number is None and not contents.shapes and not contents.instances:
            raise CageError(f"{self.name}: nothing is visible; expected visible meshes")
        self._parameters = with_rate(self._parameters, contents)
        if contents.has_surfaces:
            self._parameters = {**self._parameters, "shading": shading_for(variant_in_use(), self._parameters)}
        # Scalar variants have numbers of Python, and no programs for instances.
        if mi.Float is not float:
            contents = with_copies(contents, self._parameters.get("tessellation_rate", MOST_SEGMENTS), MOST_TRIANGLES)
        self._is_lit |= contents.is_lit
        self._first = self._first or (number, contents)
        return contents

    def framing(self, contents: SceneContents) -> tuple[str, View, tuple[int, int]]:
        """Axis that points up, view and size of the picture."""
        return contents.up, angles_for(contents, self._look), size_for(contents, self._look)

    def points(self, contents: SceneContents) -> NDArray[np.float64]:
        """Points ``(n, 3)`` of all shapes in the world; none if no mesh can be used."""
        return self._surfaces.points(contents)

    def has_studio(self, contents: SceneContents) -> bool:
        """Whether the stage lacks a camera or lights."""
        return contents.camera is None or not contents.is_lit

    def scene(
        self, contents: SceneContents, points: NDArray[np.float64] | None = None, *, follows_sensor: bool = False
    ) -> SceneNode:
        """Entries of a scene, with polygon meshes for `with_meshes`.

        Raises
        ------
        CageError
            If no mesh can be used.
        """
        notes, triangles, needed, rest = Notes(), {}, {}, None
        is_one_picture = points is None
        points = self.points(contents) if points is None else points
        if len(points):
            rest = staged(contents, points, self._is_lit, self._look, notes)
            seen = (outline_for(rest["sensor"]), rest["sensor"]["near_clip"]) if is_one_picture else None
            if seen and follows_sensor:
                needed = texels_for_picture(contents, *seen)
            if seen and self._has_free_rates and contents.has_surfaces:
                triangles = triangles_for_picture(
                    contents, self._surfaces, *seen, self._parameters, follows_sensor=follows_sensor
                )
        made = Entries(contents, notes, self._parameters, self._surfaces, triangles, needed, self._look.texture_size)
        notes.warn(self.name, self._warned)
        if rest is None:
            raise CageError(f"{self.name}: none of the meshes can be used; expected one")
        return {**made.scene, **rest}

    def frames(
        self, numbers: Sequence[int], points: NDArray[np.float64], filter_name: str | None
    ) -> Iterator[LoadedScene]:
        """The scenes of some frames; limit surfaces of which only the points move stay loaded."""
        self._surfaces = Surfaces()
        first = self._first[1] if self._first else self.at(numbers[0])
        shapes = LoadedShapes(self._parameters)
        for number in numbers:
            contents, notes = self.at(number), Notes()
            shapes.begin_frame()
            made = Entries(
                contents,
                notes,
                self._parameters,
                shapes.surfaces,
                texture_size=self._look.texture_size,
                loaded=shapes,
            )
            rest = staged(first, points, self._is_lit, self._look, notes)
            if contents.camera is not None:
                rest["sensor"] = sensor(contents.camera, size_for(first, self._look), self._look.spp, notes)
            notes.warn(self.name, self._warned)
            yield load_quietly({**made.scene, **rest}, filter_name)
