"""Frames of a turntable, and of models that move: what moves from frame to frame, and what is loaded once."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import CageError, CageWarning
from ..cage.attributes import Attribute
from ..cage.contents import CageContents
from ..cage.formats import read_file
from ..regression.scene import LoadedScene, load_scene
from .camera import outermost
from .model import Model
from .placed_points import points_at
from .scene import Look, compose, frame_points, wire_of
from .view import angles_of, studio_axes, turned
from .wire import CageWire

PATTERN = re.compile(r"%(0\d+)?d")


def load_quietly(scene: Mapping[str, Any], filter_name: str | None = None) -> LoadedScene:
    """Load the scene of a model that has been read before, and whose warnings have been told."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CageWarning)
        return load_scene(scene, None, filter_name)


class Turntable:
    """A model that turns around once, before a camera that sees all of it at all times.

    Parameters
    ----------
    model : Model
    look : Look
    count : int
        Number of frames. Frame 1 is the model as it is; the next ones are turned counter-clockwise from above.
    """

    def __init__(self, model: Model, look: Look, count: int) -> None:
        self.count = count
        axes = studio_axes(look.up or model.up)
        points = frame_points(model, look, model.cage.positions) @ axes
        self._pivot = axes @ ((points.min(axis=0) + points.max(axis=0)) / 2)
        self._axes, self._has_wire = axes, look.cage
        azimuth, elevation = angles_of(look.view)
        all_turned = [points_at(points @ axes.T, self.matrix(number)) for number in self.numbers]
        seen = [outermost(each @ axes, azimuth, elevation, look.size) @ axes.T for each in all_turned]
        self.scene = compose(model, look, np.concatenate(seen))

    @property
    def numbers(self) -> range:
        return range(1, self.count + 1)

    def matrix(self, number: int) -> NDArray[np.float64]:
        """Where frame ``number`` has the model: ``(4, 4)``."""
        linear = self._axes @ turned(360 * (number - 1) / self.count) @ self._axes.T
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = linear, self._pivot - linear @ self._pivot
        return matrix

    def frames(self, numbers: Sequence[int], filter_name: str | None) -> Iterator[LoadedScene]:
        """The scene at each of these frames; it is loaded once."""
        loaded = load_quietly(self.scene, filter_name)
        names = ["surface.to_world", *(["cage.to_world"] if self._has_wire else [])]
        for number in numbers:
            if number != 1:
                matrix = self.matrix(number).tolist()
                _move(loaded, {name: mi.ScalarTransform4f(matrix) for name in names})
            yield loaded


class FrameRange:
    """A model whose control points move: at times of a USD file, or in one file for each frame.

    The camera stands still, and sees all frames. Where frames have the same topology, the shape that is loaded gets
    other control points; its patches and weights stay.

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
        self.numbers, self._look, self._prim = numbers, look, prim
        self._path, self._scheme = path, scheme
        self._is_pattern = bool(PATTERN.search(path.name))
        if not self._is_pattern and not path.suffix.lower().startswith(".usd"):
            raise CageError(
                f'"{path}": frames are times of a USD file, or files; expected a name such as frame_%04d.obj'
            )
        missing = [file for number in numbers if not (file := self.file(number)).is_file()]
        if missing:
            more = f" ({len(missing)} such files)" if len(missing) > 1 else ""
            raise FileNotFoundError(f'"{missing[0]}": there is no such file{more}; expected one for each frame')
        self._first = self._contents(numbers[0])
        self._model = self._model_at(numbers[0])
        self.scene = compose(self._model, look, self._all_points())

    def file(self, number: int) -> Path:
        """File of a frame."""
        if not self._is_pattern:
            return self._path
        return self._path.with_name(PATTERN.sub(lambda found: found[0] % number, self._path.name, count=1))

    def frames(self, numbers: Sequence[int], filter_name: str | None) -> Iterator[LoadedScene]:
        """The scene at each of these frames."""
        loaded, wire = None, None
        for number in numbers:
            contents = self._contents(number)
            if not same_topology(contents, self._first):
                yield load_quietly({**self.scene, **self._shapes(self._model_at(number))}, filter_name)
                continue
            if loaded is None:
                loaded = load_quietly(self.scene, filter_name)
                wire = wire_of(self._model) if self._look.cage else None
            _move(loaded, self._control_points(contents, wire))
            yield loaded

    def _control_points(self, contents: CageContents, wire: CageWire | None) -> dict[str, NDArray[np.float64]]:
        positions = np.asarray(contents.positions, dtype=np.float64)
        found = {"surface.control_points": positions}
        return found if wire is None else {**found, "cage.control_points": wire.positions(positions)}

    def _contents(self, number: int) -> CageContents:
        time = None if self._is_pattern else float(number)
        with warnings.catch_warnings():
            # Told when the first frame, or one of another topology, becomes a model.
            warnings.simplefilter("ignore", CageWarning)
            return read_file(self.file(number), self._prim, time, {"scheme": self._scheme} if self._scheme else {})

    def _model_at(self, number: int) -> Model:
        time = None if self._is_pattern else float(number)
        return Model(self.file(number), prim=self._prim, time=time, scheme=self._scheme)

    def _shapes(self, model: Model) -> dict[str, Any]:
        scene = compose(model, self._look, frame_points(model, self._look, model.cage.positions))
        return {name: scene[name] for name in ("surface", "cage") if name in scene}

    def _all_points(self) -> NDArray[np.float64]:
        """Those points of all frames that decide what the camera frames."""
        azimuth, elevation = angles_of(self._look.view)
        axes = studio_axes(self._look.up or self._model.up)
        found = []
        for number in self.numbers:
            contents = self._contents(number)
            is_same = same_topology(contents, self._first)
            model = self._model if is_same else self._model_at(number)
            positions = np.asarray(contents.positions, dtype=np.float64) if is_same else model.cage.positions
            points = frame_points(model, self._look, positions)
            found.append(outermost(points @ axes, azimuth, elevation, self._look.size) @ axes.T)
        return np.concatenate(found)


def same_topology(a: CageContents, b: CageContents) -> bool:
    """Whether two cages differ in their positions only."""
    if len(a.positions) != len(b.positions) or dict(a.rules) != dict(b.rules) or a.scheme != b.scheme:
        return False
    arrays = ("face_sizes", "face_vertices", "creases", "corners", "holes")
    attributes = [{"": each.texcoords, **each.attributes} for each in (a, b)]
    return (
        all(np.array_equal(getattr(a, name), getattr(b, name)) for name in arrays)
        and attributes[0].keys() == attributes[1].keys()
        and all(_same_attribute(attributes[0][name], attributes[1][name]) for name in attributes[0])
    )


def _same_attribute(a: Attribute | None, b: Attribute | None) -> bool:
    if a is None or b is None:
        return a is b
    has_indices = a.indices is not None and b.indices is not None
    same_indices = np.array_equal(a.indices, b.indices) if has_indices else a.indices is b.indices  # type: ignore[arg-type]
    return a.interpolation == b.interpolation and np.array_equal(a.values, b.values) and bool(same_indices)


def _move(loaded: LoadedScene, values: Mapping[str, Any]) -> None:
    parameters = mi.traverse(loaded.scene)
    for name, value in values.items():
        kind = type(parameters[name])
        flat = np.ascontiguousarray(value, np.float32).ravel() if isinstance(value, np.ndarray) else value
        parameters[name] = kind(flat)
    parameters.update()
