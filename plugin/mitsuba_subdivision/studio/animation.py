"""A still picture, a turntable and a range of frames of a scene source, for the command ``render``."""

from __future__ import annotations

import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import CageError, CageWarning
from ..device_arrays import upload
from ..files.formats import is_usd
from ..mitsuba_mesh import points_at, with_meshes
from ..regression.scene import LoadedScene, load_scene
from ..variants import SceneNode
from .studio_entries import RIG, Look, View, outermost, studio_axes, turned

PATTERN = re.compile(r"%(0\d+)?d")
Contents = TypeVar("Contents")


class SceneSource(ABC, Generic[Contents]):
    """Scenes of a model, from its contents in a frame: `CageScenes` of one cage, or `StageScenes` of a USD file.

    Raises CageError if frames are neither times of a USD file nor numbered files, FileNotFoundError without a file.
    """

    factor: float | None = None  # Enlargement of the model in the scene; None before points are known

    def __init__(
        self,
        model: object,  # A cage, or a file; for frames also a pattern such as "frame_%04d.obj"
        name: str,  # Beginning of messages
        look: Look,
        time: float | None,
        numbers: range | None,  # Times or file numbers of frames, if any
    ) -> None:
        self.name, self.numbers, self._look, self._time, self._path = name, numbers, look, time, Path(str(model))
        # AOV types by channel names, and AOV names by render products.
        self.aovs, self.products = look.aovs or {}, dict[str, list[str]]()
        self._has_files = numbers is not None and bool(PATTERN.search(self._path.name))
        if numbers is None:
            return
        if not self._has_files and not is_usd(self._path):
            expected = "a name such as frame_%04d.obj"
            raise CageError(f'"{model}": frames are times of a USD file, or files; expected {expected}')
        missing = [file for number in numbers if not (file := self._file_and_time(number)[0]).is_file()]
        if missing:
            more = f" ({len(missing)} such files)" if len(missing) > 1 and self._has_files else ""
            raise FileNotFoundError(f'"{missing[0]}": there is no such file{more}; expected one for each frame')

    def _file_and_time(self, number: int | None) -> tuple[Path, float | None]:
        if number is None or self.numbers is None:
            return self._path, self._time
        if not self._has_files:
            return self._path, float(number)
        return self._path.with_name(PATTERN.sub(lambda match: match[0] % number, self._path.name, count=1)), None

    @abstractmethod
    def at(self, number: int | None = None) -> Contents:
        """Contents of a frame, or of the still picture."""

    @abstractmethod
    def framing(self, contents: Contents) -> tuple[str, View, tuple[int, int]]:
        """Axis that points up, view and size of the picture."""

    @abstractmethod
    def points(self, contents: Contents) -> NDArray[np.float64]:
        """Points ``(n, 3)`` in world space that the studio's camera must see."""

    @abstractmethod
    def scene(
        self,
        contents: Contents,
        points: NDArray[np.float64] | None = None,  # (n, 3): of all frames; by default, of the contents
        # (4, 4) each: motion of the only sensor, on which triangles and textures may depend; empty if they may not
        turns: Sequence[NDArray[np.float64]] = (),
    ) -> SceneNode:
        """Entries of a scene."""

    @abstractmethod
    def frames(
        self, numbers: Sequence[int], points: NDArray[np.float64], filter_name: str | None
    ) -> Iterator[LoadedScene]:
        """Loaded scenes of some frames, and of all their sub-frames if there is a shutter."""

    def has_studio(self, contents: Contents) -> bool:  # noqa: ARG002 - of cages, always
        """Whether the studio supplies the camera or the lights, which depend on the points."""
        return True

    def remarks(self) -> list[str]:
        """Lines about the pictures for standard error."""
        return []


class StillPicture:
    """One picture of a source, and the base of moving ones.

    Triangles may depend on the sensor if no other one renders the scene.
    """

    def __init__(self, source: SceneSource[Any], *, follows_sensor: bool = True) -> None:
        self._scene = source.scene(source.at(), turns=[np.eye(4)] if follows_sensor else [])

    @property
    def scene(self) -> SceneNode:
        """Entries of the first frame."""
        return self._scene

    def frames(self, numbers: Sequence[int], filter_name: str | None) -> Iterator[LoadedScene]:
        """Loaded scenes of some frames, one after the other."""
        return (load_quietly(self.scene, filter_name) for _ in numbers)


class Turntable(StillPicture):
    """A cage or a stage that turns once, in frames 1 to ``count``, around the middle of its bounds.

    In Mitsuba, the camera turns around the model the other way, with the lights and the backdrop of the studio. The
    studio's camera sees the whole model in all frames. Frame 1 is the still picture; in later frames, the model and its
    own lights are turned counter-clockwise, seen from above.
    """

    def __init__(self, source: SceneSource[Any], count: int, *, follows_sensor: bool = True) -> None:
        self._count, contents = count, source.at()
        points, framing = source.points(contents), source.framing(contents)
        self._axes = studio_axes(framing[0])
        in_studio = points @ self._axes
        bounds = np.stack([in_studio.min(axis=0), in_studio.max(axis=0)]) if len(points) else np.zeros((2, 3))
        self._pivot = self._axes @ bounds.mean(axis=0)
        numbers = range(1, count + 1)
        if len(points):
            turned_points = (points_at(points, self.matrix(number)) for number in numbers)
            points = np.concatenate([outermost(frame, *framing) for frame in turned_points])
        turns = [self.matrix(2 - number) for number in numbers] if follows_sensor else []
        self._scene = source.scene(contents, points, turns=turns)

    def matrix(self, number: float) -> NDArray[np.float64]:
        """Transform ``(4, 4)`` of the contents in frame ``number``."""
        linear = self._axes @ turned(360 * (number - 1) / self._count) @ self._axes.T
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = linear, self._pivot - linear @ self._pivot
        return matrix

    def frames(self, numbers: Sequence[float], filter_name: str | None) -> Iterator[LoadedScene]:
        """Loaded scenes of some frames; the scene is loaded once."""
        loaded = load_quietly(self.scene, filter_name)
        parameters = mi.traverse(loaded.scene)
        names = [f"{name}.to_world" for name in ("sensor", *RIG) if name in self.scene]
        first = {name: np.array(parameters[name].matrix, dtype=np.float64).reshape(4, 4) for name in names}
        for number in numbers:
            around = np.linalg.inv(self.matrix(number))
            moved = {name: mi.ScalarTransform4f((around @ matrix).tolist()) for name, matrix in first.items()}
            set_parameters(loaded.scene, moved)
            yield loaded


class FrameRange(StillPicture):
    """Times of a USD file, or the files of frames. The studio's camera stands still, and sees all frames.

    Raises CageError, OSError if a frame cannot be read, or nothing is visible in any of them.
    """

    def __init__(self, source: SceneSource[Any], numbers: range) -> None:
        self.numbers, self._source = numbers, source
        contents = source.at(numbers[0])
        framing, self._points = source.framing(contents), source.points(contents)
        if not len(self._points) or source.has_studio(contents):
            points = (source.points(source.at(number)) for number in numbers)
            outer = [outermost(frame, *framing) for frame in points if len(frame)]
            self._points = np.concatenate([np.zeros((0, 3)), *outer])
        if not len(self._points):
            raise CageError(f"{source.name}: nothing is visible in any frame; expected visible meshes")

    @cached_property
    def scene(self) -> SceneNode:
        return self._source.scene(self._source.at(self.numbers[0]), self._points)

    def frames(self, numbers: Sequence[int], filter_name: str | None) -> Iterator[LoadedScene]:
        return self._source.frames(numbers, self._points, filter_name)


def load_quietly(scene: SceneNode, filter_name: str | None = None) -> LoadedScene:
    """Load a scene without warnings of its cages, which were issued when they were read."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CageWarning)
        return load_scene(with_meshes(scene), None, filter_name)


def set_parameters(part: mi.Object, values: Mapping[str, Any]) -> None:
    """Update parameters of a scene or a shape: control points ``(n, 3)``, or transforms."""
    parameters = mi.traverse(part)
    for name, value in values.items():
        kind = type(parameters[name])
        parameters[name] = upload(kind, value) if isinstance(value, np.ndarray) else kind(value)
    parameters.update()
