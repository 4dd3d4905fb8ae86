"""Whole stages as the command ``render`` shows them: pictures, turntables, and times of a USD file.

Each has what the classes of `studio.animation` have: ``scene``, and ``loaded`` or ``numbers`` and ``frames``, which
give scenes as `regression.scene.load_scene` loads them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageError
from ..studio.animation import load_quietly, move, places_of
from ..studio.camera import outermost
from ..studio.frame_files import FrameFiles
from ..studio.turns import Turns
from .bounds import Points
from .contents import SceneContents
from .entries import Entries, is_lit, prepared, with_meshes
from .loaded_shapes import LoadedShapes
from .notes import Notes
from .scene import stage_scene
from .sensors import sensor
from .stage_reader import StageReader
from .staging import RIG, View, staged
from .surfaces import Surfaces


class StagePicture:
    """A whole stage at one time.

    Parameters
    ----------
    path : Path
    mi : module
        ``mitsuba`` with a variant set.
    view : View
    parameters : dict
        Of every shape ``subdivision``.
    time : float, optional
    follows_sensor : bool
        Whether the scene's own sensor is the only one that is going to see it.

    Attributes
    ----------
    scene : dict
        With polygon meshes as in `Entries`, for `save_scene`.
    """

    def __init__(
        self,
        path: Path,
        mi: Any,
        view: View,
        parameters: dict[str, Any],
        time: float | None = None,
        *,
        follows_sensor: bool = True,
    ) -> None:
        reader = StageReader(path)
        self._mi = mi
        contents = reader.require_shapes(reader.at(time))
        self.scene = stage_scene(path, contents, mi, view, parameters, follows_sensor=follows_sensor)

    def loaded(self, filter_name: str | None) -> Any:
        """The scene, loaded."""
        return load_quietly(with_meshes(self.scene, self._mi), filter_name)


class StageTurntable:
    """A whole stage that turns around once before the camera.

    It turns around the middle of its bounds, with its own lights. Nothing of it moves in Mitsuba: the camera goes
    around it the other way, with the lights and the backdrop of the studio if the stage has none. With the stage's own
    camera, frame 1 is the picture of the stage. The studio's camera sees the stage at all times.

    Parameters
    ----------
    path, mi, view, parameters, time
        As for `StagePicture`.
    count : int
        Number of frames.
    """

    def __init__(
        self,
        path: Path,
        mi: Any,
        view: View,
        parameters: dict[str, Any],
        time: float | None,
        count: int,
    ) -> None:
        reader = StageReader(path)
        contents = reader.require_shapes(reader.at(time))

        def turned(points: NDArray[np.float64]) -> NDArray[np.float64]:
            turns = Turns(points, contents.up, view.angles_for(contents), view.size_for(contents), count)
            self.numbers, self.matrix = turns.numbers, turns.matrix
            return turns.points

        self.scene = stage_scene(path, contents, mi, view, parameters, turned)
        self._mi = mi

    def frames(self, numbers: Sequence[int], filter_name: str | None) -> Iterator[Any]:
        """The scene at each of these frames; it is loaded once."""
        loaded = load_quietly(with_meshes(self.scene, self._mi), filter_name)
        names = [f"{name}.to_world" for name in ("sensor", *RIG) if name in self.scene]
        places = places_of(loaded.scene, names)
        for number in numbers:
            around = np.linalg.inv(self.matrix(number))
            matrices = {name: (around @ place).tolist() for name, place in places.items()}
            move(loaded.scene, {name: self._mi.ScalarTransform4f(matrix) for name, matrix in matrices.items()})
            yield loaded


class StageFrames:
    """A whole stage at times of its file, or stages of several files.

    Everything may move: shapes, their control points, instances, lights and the stage's camera. Limit surfaces whose
    topology stays keep their patches and weights. Where the stage has no camera, that of the studio stands still and
    sees all frames, and so do its lights where there are none in any frame.

    Parameters
    ----------
    path : Path
        A USD file, or the name of several with a number in it.
    mi, view, parameters
        As for `StagePicture`.
    numbers : range
        Times, or numbers of files.

    Raises
    ------
    CageError, OSError
        If a frame cannot be read, or there is nothing to be seen in any of them.
    """

    def __init__(self, path: Path, mi: Any, view: View, parameters: dict[str, Any], numbers: range) -> None:
        self.numbers, self._mi, self._view = numbers, mi, view
        self._files, self._path = FrameFiles(path, numbers), path
        self._reader: StageReader | None = None
        self._told: set[str] = set()
        self._parameters = parameters
        self._first, self._parameters = self._at(numbers[0])
        self._is_lit = is_lit(self._first)
        self._points = Points(Surfaces()).of(self._first)
        if self._first.camera is None or not self._is_lit or not len(self._points):
            self._points = self._survey()
        if not len(self._points):
            raise CageError(f'"{path}": there is nothing to be seen in any frame; expected visible meshes')

    @property
    def scene(self) -> dict[str, Any]:
        """The first frame, with polygon meshes as in `Entries`."""
        notes = Notes()
        made = Entries(self._first, self._mi, notes, self._parameters, Surfaces())
        return {**made.scene, **self._staged(self._first, notes)}

    def frames(self, numbers: Sequence[int], filter_name: str | None) -> Iterator[Any]:
        """The scene at each of these frames."""
        shapes = LoadedShapes(self._mi, self._parameters)
        for number in numbers:
            contents = self._first if number == self.numbers[0] else self._at(number)[0]
            notes = Notes()
            shapes.begin_frame()
            made = Entries(contents, self._mi, notes, self._parameters, Surfaces(), maker=shapes)
            scene = {**made.scene, **self._staged(contents, notes)}
            notes.tell(f'"{self._path}"', self._told)
            yield load_quietly(scene, filter_name)

    def _at(self, number: int) -> tuple[SceneContents, dict[str, Any]]:
        """What is to be seen in a frame, and parameters of its limit surfaces."""
        if self._reader is None or self._files.are_many:
            self._reader = StageReader(self._files.file(number), told=self._told)
        return prepared(self._reader.at(self._files.time(number)), self._mi, self._parameters)

    def _survey(self) -> NDArray[np.float64]:
        """Those points of all frames that decide what the camera frames; notes whether any frame has lights."""
        evaluated, found = Points(Surfaces()), []
        angles, size = self._view.angles_for(self._first), self._view.size_for(self._first)
        for number in self.numbers:
            contents = self._first if number == self.numbers[0] else self._at(number)[0]
            self._is_lit |= is_lit(contents)
            points = evaluated.of(contents)
            if len(points):
                found.append(outermost(points, self._first.up, angles, size))
        return np.concatenate([*found, np.zeros((0, 3))])

    def _staged(self, contents: SceneContents, notes: Notes) -> dict[str, Any]:
        """Camera of this frame, and the studio of all frames."""
        found = staged(self._first, self._points, self._is_lit, self._view, self._mi, notes)
        if contents.camera is not None:
            size = self._view.size_for(self._first)
            found["sensor"] = sensor(contents.camera, size, self._view.spp, self._mi, notes)
        return found
