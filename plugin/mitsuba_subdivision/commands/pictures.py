"""Pictures that the options of ``render`` ask for, here or on the workers of a cluster."""

from __future__ import annotations

import argparse
import pickle
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from itertools import islice
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from ..cage.errors import CageWarning, warn
from ..studio.view import DEFAULT_VIEW, VIEWS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..regression.scene import LoadedScene
    from ..studio.animation import FrameRange, SceneSource, StillPicture, Turntable
    from ..studio.look import Look

# Options that select one mesh of a USD file.
_OF_ONE_MESH = ("up", "scheme", "prim", "checker", "cage")


def render_picture(
    options: argparse.Namespace, scenes: Iterable[LoadedScene], spp: int | None = None
) -> NDArray[np.float32]:
    """Render a scene, or the mean of the scenes of a frame's sub-frames, which share no samples."""
    from ..regression.scene import render_image

    count = options.shutter or 1
    total: Any = 0.0
    for part, loaded in enumerate(scenes):
        seed = (options.seed * count + part) % 2**32
        with threads(options.threads):
            found = render_image(loaded, spp or loaded.sensor.sampler().sample_count(), seed)
            if options.denoise:
                from ..studio.denoising import denoised

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
        from ..studio.scene_file import save_scene

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
    import drjit as dr

    before = dr.thread_count()
    dr.set_thread_count(count or before)
    try:
        yield
    finally:
        dr.set_thread_count(before)


def _on_cluster(options: argparse.Namespace, numbers: Sequence[int]) -> Iterator[tuple[int, NDArray[np.float32]]]:
    import mitsuba as mi

    from ..regression.passes import cluster, results

    # The command's own number: files may change until the next one.
    command = pickle.dumps(as_data(options) | {"command": uuid4().hex})
    warned: set[str] = set()
    with cluster(options.dask) as client:
        for number, (image, messages) in results(client, partial(_frame, command), str(mi.variant()), numbers):
            for message in messages:
                if message not in warned:
                    warned.add(message)
                    warn(message)
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
    from ..studio.animation import FrameRange, StillPicture, Turntable

    source = _source(options)
    if options.frames or options.shutter:
        return FrameRange(source, options.frames or range(1, 2))
    if options.turntable:
        return Turntable(source, options.turntable, follows_sensor=not options.save_scene)
    return StillPicture(source, follows_sensor=not options.save_scene)


def _source(options: argparse.Namespace) -> SceneSource[Any]:
    """One mesh, or a whole USD file."""
    from ..studio.picture import shading_for
    from ..studio.studio_entries import variant_in_use

    look, which = _look(options), {"time": options.time, "numbers": options.frames}
    is_usd = options.scene.suffix.lower().startswith(".usd")
    if is_usd and not any(getattr(options, name) for name in _OF_ONE_MESH):
        from ..usd.stage_scenes import StageScenes

        given = {"tessellation_rate": options.rate, "shading": options.shading}
        parameters = {name: v for name, v in given.items() if v is not None}
        return StageScenes(options.scene, look, parameters, shutter=options.shutter, **which)
    if options.shutter:
        raise ValueError(
            f'--shutter was given for one cage of "{options.scene}", which has no camera; expected a whole USD file'
        )
    if options.texture_size:
        raise ValueError(
            f'--texture-size was given for one cage of "{options.scene}"; expected it for a whole USD file'
        )
    from ..studio.cage_scenes import CageScenes

    shading = shading_for(variant_in_use(), {"shading": options.shading or "auto"})
    return CageScenes(options.scene, replace(look, shading=shading), prim=options.prim, scheme=options.scheme, **which)


def _look(options: argparse.Namespace) -> Look:
    from ..studio.look import Look

    azimuth, elevation = VIEWS[options.view or DEFAULT_VIEW]
    azimuth = azimuth if options.azimuth is None else options.azimuth
    elevation = elevation if options.elevation is None else options.elevation
    given = {name: getattr(options, name) for name in ("up", "size", "spp", "rate", "checker", "cage", "texture_size")}
    return Look(view=(azimuth, elevation), **{name: value for name, value in given.items() if value is not None})
