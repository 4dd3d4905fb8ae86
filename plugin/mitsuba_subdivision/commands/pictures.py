"""Pictures and scene files that the options of ``render`` ask for, here or on the workers of a cluster."""

from __future__ import annotations

import argparse
import pickle
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any
from uuid import uuid4

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageWarning, warn
from ..regression.scene import LoadedScene, render_image
from ..studio.animation import FrameRange, SceneSource, StillPicture, Turntable
from ..studio.cage_scenes import CageScenes
from ..studio.camera import DEFAULT_VIEW, VIEWS
from ..studio.denoising import denoised
from ..studio.picture import shading_for
from ..studio.scene_parts import SceneParts
from ..studio.studio_entries import Look, variant_in_use
from ..variants import SceneNode
from ..whole_file import require_writable, write_text

# Options that select one mesh of a USD file.
_OF_ONE_MESH = ("up", "scheme", "prim", "checker", "cage")

_NUMBERS = re.compile(r"<(float|rgb|lookat|scale|matrix|translate|rotate|point|vector) [^>]*>")
_NUMBER = re.compile(r"-?\d+\.\d+(?:e[-+]?\d+)?")
# Significant digits where single precision is not enough.
DIGITS = 9
_MATRIX = re.compile(r'( *)<matrix value="([^"]+)"/>')
# Tolerance for the orthogonality of a matrix that is written as a scale and a direction.
_ORTHOGONAL = 1e-6


def render_picture(
    options: argparse.Namespace, scenes: Iterable[LoadedScene], spp: int | None = None
) -> NDArray[np.float32]:
    """Render a scene, or the mean of the scenes of a frame's sub-frames, which share no samples."""
    count = options.shutter or 1
    total: Any = 0.0
    for part, loaded in enumerate(scenes):
        seed = (options.seed * count + part) % 2**32
        with threads(options.threads):
            found = render_image(loaded, spp or loaded.sensor.sampler().sample_count(), seed)
            if options.denoise:
                # Each by itself, as its albedo and normals are those of its time.
                found = denoised(loaded, found, seed)
        total = total + found / count
    return total


def pictures(options: argparse.Namespace, numbers: Sequence[int]) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Frames of a model, or its picture as number 1, with their numbers, as they are finished."""
    if options.dask:
        return _on_cluster(options, numbers)
    shown = _shown(options)
    if options.save_scene:
        save_scene(shown.scene, options.save_scene, [options.scene])
    scenes = shown.frames(numbers, options.filter)
    return ((number, render_picture(options, islice(scenes, options.shutter or 1))) for number in numbers)


def load_still(given: dict[str, Any]) -> LoadedScene:
    """The scene of a model's picture, by options `as_data`."""
    options = argparse.Namespace(**given)
    return next(_shown(options).frames([1], options.filter))


def as_data(options: argparse.Namespace) -> dict[str, Any]:
    """Options by which another process, in another folder, renders the same pictures."""
    given = {name: value for name, value in vars(options).items() if name not in ("run", "parser")}
    return given | {"scene": options.scene.resolve()}


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Render with so many threads. With one, nothing may be read or written meanwhile; see `set_variant`."""
    before = dr.thread_count()
    dr.set_thread_count(count or before)
    try:
        yield
    finally:
        dr.set_thread_count(before)


def _on_cluster(options: argparse.Namespace, numbers: Sequence[int]) -> Iterator[tuple[int, NDArray[np.float32]]]:
    from ..regression.passes import cluster, results

    # The command's own number: files may change until the next one.
    command = pickle.dumps(as_data(options) | {"command": uuid4().hex})
    warned: set[str] = set()
    with cluster(options.dask) as client:
        for number, (image, messages) in results(client, partial(_frame, command), str(mi.variant()), numbers):
            for message in dict.fromkeys(messages):
                if message not in warned:
                    warn(message)
            warned.update(messages)
            yield number, image


def _frame(command: bytes, number: int) -> tuple[NDArray[np.float32], list[str]]:
    """A picture, and the messages of warnings; runs on a worker."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CageWarning)
        options, shown = _kept(command)
        image = render_picture(options, shown.frames([number], options.filter))
    return image, [str(each.message) for each in caught if issubclass(each.category, CageWarning)]


@lru_cache(maxsize=1)
def _kept(command: bytes) -> tuple[argparse.Namespace, FrameRange | Turntable | StillPicture]:
    """Options and what they show: a worker reads it once for all of its frames."""
    options = argparse.Namespace(**pickle.loads(command))
    return options, _shown(options)


def _shown(options: argparse.Namespace) -> FrameRange | Turntable | StillPicture:
    """What a model's pictures show."""
    source = _source(options)
    if options.frames or options.shutter:
        return FrameRange(source, options.frames or range(1, 2))
    if options.turntable:
        return Turntable(source, options.turntable, follows_sensor=not options.save_scene)
    return StillPicture(source, follows_sensor=not options.save_scene)


def _source(options: argparse.Namespace) -> SceneSource[Any]:
    """One mesh, or a whole USD file."""
    look, which = _look(options), {"time": options.time, "numbers": options.frames}
    is_usd = options.scene.suffix.lower().startswith(".usd")
    if is_usd and not any(getattr(options, name) for name in _OF_ONE_MESH):
        from mitsuba_usd import StageScenes

        given = {"tessellation_rate": options.rate, "shading": options.shading}
        parameters = {name: value for name, value in given.items() if value is not None}
        return StageScenes(options.scene, look, parameters, shutter=options.shutter, **which)
    what = f'one cage of "{options.scene}"'
    if options.shutter:
        raise ValueError(f"--shutter was given for {what}, which has no camera; expected a whole USD file")
    if options.texture_size:
        raise ValueError(f"--texture-size was given for {what}; expected it for a whole USD file")
    shading = shading_for(variant_in_use(), {"shading": options.shading or "auto"})
    return CageScenes(options.scene, replace(look, shading=shading), prim=options.prim, scheme=options.scheme, **which)


def _look(options: argparse.Namespace) -> Look:
    azimuth, elevation = VIEWS[options.view or DEFAULT_VIEW]
    azimuth = azimuth if options.azimuth is None else options.azimuth
    elevation = elevation if options.elevation is None else options.elevation
    given = {name: getattr(options, name) for name in ("up", "size", "spp", "rate", "checker", "cage", "texture_size")}
    return Look(view=(azimuth, elevation), **{name: value for name, value in given.items() if value is not None})


def save_scene(
    # As for `mi.load_dict`; a polygon mesh may have the type "ply" and, as `mesh`, an object with a method `save`
    # that takes a path
    scene: SceneNode,
    path: Path,
    inputs: Iterable[Path] = (),  # Files that must not be written to, besides those that the scene names
) -> list[Path]:
    """Write a scene as XML, so that it renders to the same picture.

    Names of files in it become relative to it. Data in memory is written beside it, as ``NAME_ENTRY``
    with a suffix: cages as OBJ files, or as PLY or USD files if they have data that OBJ files cannot hold; polygon
    meshes as PLY files; pictures as PNG or EXR files.
    Returns list of Path: the files that were written; the scene is the last. Raises ValueError if the path does not end
    in .xml, something in memory can be written to no file, or a file to write is one that the scene reads. Nothing has
    been written then. Raises OSError if a file cannot be written.
    """
    if path.suffix.lower() != ".xml":
        raise ValueError(f'scene "{path}"; expected a name ending in .xml')
    named = [Path(entry["filename"]) for entry in scene.values() if isinstance(entry, Mapping) and "filename" in entry]
    require_writable(path, inputs)
    parts = SceneParts(path, [*named, *inputs])
    entries = {
        name: parts.in_files(name, dict(entry)) if isinstance(entry, Mapping) else entry
        for name, entry in scene.items()
    }
    config = mi.parser.ParserConfig(str(mi.variant()))
    text = _readable(mi.parser.write_string(mi.parser.parse_dict(config, entries)))
    written = parts.write()
    write_text(path, f'<?xml version="1.0"?>\n{text}')
    return [*written, path]


def _readable(text: str) -> str:
    """The text that Mitsuba writes, with transforms as look-at, and without digits beyond single precision.

    The difference of a look-at's points is a direction: they get more digits.
    """

    def shortened(tag: re.Match[str]) -> str:
        if tag[1] == "lookat":
            return _NUMBER.sub(lambda found: f"{float(found[0]):.{DIGITS}g}", tag[0])
        return _NUMBER.sub(lambda found: str(np.float32(float(found[0]))).removesuffix(".0"), tag[0])

    return _NUMBERS.sub(shortened, _MATRIX.sub(_placed, text))


def _placed(found: re.Match[str]) -> str:
    matrix = np.array(found[2].split(), dtype=np.float64).reshape(4, 4)
    linear, origin = matrix[:3, :3], matrix[:3, 3]
    if np.array_equal(linear, np.diag(np.diag(linear))):
        return f"{found[1]}{_tag('scale', np.diag(linear))}\n{found[1]}{_tag('translate', origin)}"
    sides = np.linalg.norm(linear, axis=0)
    axes = linear / sides
    if np.abs(axes.T @ axes - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(axes) < 0:
        return found[0]
    vectors = {"origin": origin, "target": origin + axes[:, 2], "up": axes[:, 1]}
    directions = " ".join(f'{name}="{", ".join(map(str, vector))}"' for name, vector in vectors.items())
    return f"{found[1]}{_tag('scale', sides)}\n{found[1]}<lookat {directions}/>"


def _tag(name: str, values: NDArray[np.float64]) -> str:
    coordinates = " ".join(f'{axis}="{value}"' for axis, value in zip("xyz", values.tolist(), strict=True))
    return f"<{name} {coordinates}/>"
