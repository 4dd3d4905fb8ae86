"""Frames of a turntable, and of models that move: what moves from frame to frame, and what is loaded once."""

from __future__ import annotations

import pickle
import tempfile
import warnings
import weakref
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import CageWarning
from ..cage.contents import CageContents
from ..cage.errors import warn
from ..cage.sameness import same_topology
from ..files.formats import read_file
from ..regression.scene import LoadedScene, load_scene
from .camera import outermost
from .frame_files import FrameFiles
from .model import Model
from .scene import Look, compose, frame_points
from .turns import Turns


def load_quietly(scene: Mapping[str, Any], filter_name: str | None = None) -> LoadedScene:
    """Load the scene of a model that has been read before, and whose warnings have been told."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CageWarning)
        return load_scene(scene, None, filter_name)


class Picture:
    """A model as it is, in the studio; see `compose`."""

    def __init__(self, model: Model, look: Look, *, follows_sensor: bool = True) -> None:
        self.scene = compose(model, look, frame_points(model, look), follows_sensor=follows_sensor)

    def loaded(self, filter_name: str | None) -> LoadedScene:
        """The scene, loaded."""
        return load_quietly(self.scene, filter_name)


class Turntable:
    """A model that turns around once, before a camera that sees all of it at all times.

    Parameters
    ----------
    model : Model
    look : Look
    count : int
        Number of frames, as for `Turns`.
    """

    def __init__(self, model: Model, look: Look, count: int) -> None:
        self._turns = Turns(frame_points(model, look), look.up or model.up, look.view, look.size, count)
        self.numbers, self.matrix = self._turns.numbers, self._turns.matrix
        self.scene = compose(model, look, self._turns.points)
        self._names = ["surface.to_world", *(["cage.to_world"] if look.cage else [])]

    def frames(self, numbers: Sequence[int], filter_name: str | None) -> Iterator[LoadedScene]:
        """The scene at each of these frames; it is loaded once."""
        loaded = load_quietly(self.scene, filter_name)
        for number in numbers:
            if number != 1:
                matrix = self.matrix(number).tolist()
                move(loaded.scene, {name: mi.ScalarTransform4f(matrix) for name in self._names})
            yield loaded


class FrameRange:
    """A model whose control points move: at times of a USD file, or in one file for each frame.

    The camera stands still, and sees all frames. Where frames have the same topology, the shape that is loaded gets
    other control points; its patches and weights stay. Each file is read once: what the pictures need of it waits in a
    temporary file.

    Parameters
    ----------
    path : Path
        A USD file, or a name with a number in it, such as "frame_%04d.obj".
    numbers : range
        Times or numbers of files.
    look : Look
    prim, scheme : optional
        As for `ControlCage.from_file`.

    Raises
    ------
    CageError, OSError
        If a frame cannot be read, or the name has no number in it.
    """

    def __init__(
        self, path: Path, numbers: range, look: Look, *, prim: str | None = None, scheme: str | None = None
    ) -> None:
        self.numbers, self._look, self._prim, self._scheme = numbers, look, prim, scheme
        self._files = FrameFiles(path, numbers)
        self._first: CageContents | None = None
        self._model: Model
        # Control points of each frame, or all that its file holds where the topology is another.
        self._waiting = tempfile.TemporaryFile()  # noqa: SIM115 - it is closed with the object
        weakref.finalize(self, self._waiting.close)
        self._places: dict[int, int] = {}
        points = []
        for number in numbers:
            model, positions = self._read(number)
            up = look.up or self._model.up
            points.append(outermost(frame_points(model, look, positions), up, look.view, look.size))
        self.scene = compose(self._model, look, np.concatenate(points))

    def frames(self, numbers: Sequence[int], filter_name: str | None) -> Iterator[LoadedScene]:
        """The scene at each of these frames."""
        loaded = None
        for number in numbers:
            self._waiting.seek(self._places[number])
            found = pickle.load(self._waiting)
            if isinstance(found, CageContents):
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", CageWarning)
                    model = self._model_of(number, found)
                yield load_quietly({**self.scene, **self._shapes(model)}, filter_name)
                continue
            if loaded is None:
                loaded = load_quietly({**self.scene, **self._shapes(self._model)}, filter_name)
            move(loaded.scene, self._control_points(found))
            yield loaded

    def _read(self, number: int) -> tuple[Model, NDArray[np.float64]]:
        """Read the file of a frame: a model of its topology, and its control points."""
        rules = {"scheme": self._scheme} if self._scheme else {}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", CageWarning)
            contents = read_file(self._files.file(number), self._prim, self._files.time(number), rules)
        self._places[number] = self._waiting.seek(0, 2)
        if self._first is not None and same_topology(contents, self._first):
            positions = np.asarray(contents.positions, dtype=np.float64)
            pickle.dump(positions, self._waiting)
            return self._model, positions
        # What is told of other frames is told of the first one, too.
        for each in caught:
            warn(str(each.message))
        model = self._model_of(number, contents)
        if self._first is None:
            self._first, self._model = contents, model
            pickle.dump(model.cage.positions, self._waiting)
        else:
            pickle.dump(contents, self._waiting)
        return model, model.cage.positions

    def _model_of(self, number: int, contents: CageContents) -> Model:
        time = self._files.time(number)
        return Model(self._files.file(number), prim=self._prim, time=time, scheme=self._scheme, contents=contents)

    def _control_points(self, positions: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        found = {"surface.control_points": positions}
        return {**found, "cage.control_points": self._model.wire.positions(positions)} if self._look.cage else found

    def _shapes(self, model: Model) -> dict[str, Any]:
        """Entries of a model, whose file is not read again."""
        scene = compose(model, self._look, frame_points(model, self._look))
        kept = {name: value for name, value in scene["surface"].items() if name not in ("filename", "prim", "time")}
        surface = {"type": kept.pop("type"), **model.in_memory(), **kept}
        return {"surface": surface, **({"cage": scene["cage"]} if "cage" in scene else {})}


def places_of(scene: Any, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Transforms of a loaded scene, by the names of their parameters: ``(4, 4)`` float64."""
    parameters = mi.traverse(scene)
    return {name: np.array(parameters[name].matrix, dtype=np.float64).reshape(4, 4) for name in names}


def move(part: Any, values: Mapping[str, Any]) -> None:
    """Give parameters of a scene or a shape other values: control points ``(n, 3)``, or transforms."""
    parameters = mi.traverse(part)
    for name, value in values.items():
        kind = type(parameters[name])
        flat = np.ascontiguousarray(value, np.float32).ravel() if isinstance(value, np.ndarray) else value
        parameters[name] = kind(flat)
    parameters.update()
