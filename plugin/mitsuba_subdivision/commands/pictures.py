"""Pictures and passes that the options of ``render`` ask for, here or on the workers of a cluster."""

from __future__ import annotations

import argparse
import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import islice
from typing import Any
from uuid import uuid4

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageWarning, warn
from ..messages import print_result
from ..regression.scene import BOX, LoadedScene, load_scene, render_image
from ..regression.tiers import Tolerances
from ..studio.animation import FrameRange, StillPicture, Turntable
from ..studio.cage_scenes import CageScenes
from ..studio.picture import denoised, shading_for
from ..studio.saving import save_scene
from ..studio.studio_entries import DEFAULT_VIEW, VIEWS, Look, sampler, variant_in_use
from ..variants import threads_set
from ..whole_file import require_writable

# Options that select one mesh of a USD file.
_OF_ONE_MESH = ("up", "scheme", "prim", "checker", "cage")


def render_picture(
    options: argparse.Namespace, scenes: Iterable[LoadedScene], spp: int | None = None
) -> NDArray[np.float32]:
    """Render a scene, or the mean of the scenes of a frame's sub-frames, which share no samples."""
    count = options.shutter or 1
    total: Any = 0.0
    for part, loaded in enumerate(scenes):
        seed = (options.seed * count + part) % 2**32
        with threads_set(options.threads):
            image = render_image(loaded, spp or loaded.sensor.sampler().sample_count(), seed)
            if options.denoise:
                # Each by itself, as its albedo and normals are those of its time.
                image = denoised(loaded, image, seed)
        total = total + image / count
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


def render_by_passes(options: argparse.Namespace, *, is_model: bool = False) -> None:
    """Render by passes, in the current variant, here or on a cluster, and write the image.

    Raises RegressionError if there are fewer batches than passes, or no cluster answers.
    """
    from ..regression.image import save_image
    from ..regression.passes import BATCH, LEAST_BATCHES, Sampling, merge_passes, render_on_cluster, render_pass
    from ..regression.references import REFERENCE_SPP, as_reference

    # Workers get it, too, and may be in another folder.
    load: Callable[[], LoadedScene] = partial(_load_still, _as_data(options))
    if not is_model:
        path = options.scene.resolve() if options.dask else options.scene
        load = partial(load_scene, path, dict(options.parameters), BOX if options.reference else options.filter)
    loaded = load()
    require_writable(options.output, loaded.file_paths)
    spp = options.spp or (REFERENCE_SPP if options.reference else loaded.sensor.sampler().sample_count())
    tolerances = Tolerances().with_values(dict(options.tolerances))
    number, count = options.share or (1, options.passes or 1)
    batch = options.batch or min(BATCH, max(1, spp // max(LEAST_BATCHES, count)))
    if is_model:
        # Mitsuba would round each batch up, and more samples than recorded would count.
        batch = sampler(batch)["sample_count"]
    sampling = Sampling(max(1, -(-spp // batch)), batch, options.seed)
    settings = {"with_probe": options.reference}
    with threads_set(options.threads):
        if options.dask:
            variant = str(mi.variant())
            image = render_on_cluster(options.dask, load, variant, sampling, options.passes or 0, **settings)
        elif options.share:
            image = render_pass(loaded, sampling, number, count, **settings)
        else:
            image = merge_passes([render_pass(loaded, sampling, i, count, **settings) for i in range(1, count + 1)])
    if options.reference:
        image = as_reference(image, options.scene, options.output, sampling, tolerances)
    save_image(options.output, image)
    print_result(options.output)


def _as_data(options: argparse.Namespace) -> dict[str, Any]:
    """Options by which another process, in another folder, renders the same pictures."""
    given = {name: value for name, value in vars(options).items() if name not in ("run", "parser")}
    return given | {"scene": options.scene.resolve()}


def _load_still(given: dict[str, Any]) -> LoadedScene:
    """The scene of a model's picture, by options `_as_data`."""
    options = argparse.Namespace(**given)
    return next(_shown(options).frames([1], options.filter))


def _on_cluster(options: argparse.Namespace, numbers: Sequence[int]) -> Iterator[tuple[int, NDArray[np.float32]]]:
    from ..regression.passes import cluster, results

    # The command's own number: files may change until the next one.
    command = pickle.dumps(_as_data(options) | {"command": uuid4().hex})
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
    return image, [str(warning.message) for warning in caught if issubclass(warning.category, CageWarning)]


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


def _source(options: argparse.Namespace) -> Any:
    """Scene source of one mesh, or of a whole USD file."""
    azimuth, elevation = VIEWS[options.view or DEFAULT_VIEW]
    azimuth = azimuth if options.azimuth is None else options.azimuth
    elevation = elevation if options.elevation is None else options.elevation
    chosen = {name: getattr(options, name) for name in ("up", "size", "spp", "rate", "checker", "cage", "texture_size")}
    look = Look(view=(azimuth, elevation), **{name: value for name, value in chosen.items() if value is not None})
    which = {"time": options.time, "numbers": options.frames}
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
