"""Pictures, frames, videos and passes of scenes and models, for the command ``render``."""

from __future__ import annotations

import argparse
import json
import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageWarning, warn
from ..files.formats import is_usd
from ..messages import counted, print_remark, print_result
from ..regression import renders
from ..regression.image import METADATA_ATTRIBUTE, save_image
from ..regression.scene import BOX, LoadedScene, load_scene, render_image
from ..regression.tiers import Tolerances
from ..studio import DEFAULT_VIEW, Look, sampler
from ..studio.animation import FrameRange, SceneSource, StillPicture, Turntable
from ..studio.cage_scenes import CageScenes
from ..studio.picture import denoised, shading_for, weigh_lights
from ..studio.saving import save_scene
from ..studio.studio_entries import LENGTHS, VIEWS
from ..variants import threads_set
from ..whole_file import require_writable, whole_file
from .cluster import cluster, render_on_cluster, results

VIDEO_SUFFIXES = (".gif", ".mp4")
DEFAULT_FPS = 24
# Options for one mesh of a USD file, and for whole USD files.
_OF_ONE_MESH = ("up", "scheme", "prim", "checker", "cage")
_OF_STAGES = ("shutter", "texture_size", "camera", "over")
# Options that are also fields of `Look`.
_OF_LOOK = ("up", "size", "spp", "rate", "checker", "cage", "texture_size", "transparent", "aovs")
EVEN = 2  # Sides of pictures in MP4 files are multiples of this; others lose a row or a column
_Shown = tuple[StillPicture, SceneSource[Any]]


class Picture(NamedTuple):
    """Pixels of a rendered picture, with its colour and AOVs, and the channels of render products."""

    pixels: NDArray[np.float32]  # (height, width, channels)
    channels: tuple[str, ...]
    products: dict[str, list[str]]  # Names of the AOVs of each product; "" is the colour


def is_stage(options: argparse.Namespace) -> bool:
    """Whether a USD file is rendered as a whole."""
    return is_usd(options.scene) and not any(getattr(options, name) for name in _OF_ONE_MESH)


def picture_of_scene(options: argparse.Namespace) -> Picture:
    """Render a Mitsuba scene of a file."""
    loaded = load_scene(options.scene, dict(options.parameters), options.filter, options.sensor or 0)
    require_writable(options.output, loaded.file_paths)
    if loaded.scene.integrator() is None:  # Mitsuba would raise a bare Exception.
        raise ValueError(f'scene "{options.scene}" has no integrator; expected one')
    if options.output.suffix.lower() != ".exr" and loaded.scene.integrator().aov_names():
        raise ValueError(f'output "{options.output}"; expected a name ending in .exr, as the integrator has AOVs')
    return _render_picture(options, [loaded], options.spp)


def write_frames(options: argparse.Namespace) -> None:
    """Render and write the missing frames of a model, and a video of all frames."""
    is_video = options.output.suffix.lower() in VIDEO_SUFFIXES
    if is_video:
        _require_encoder(options.output)
    suffix = ".png" if is_video else options.output.suffix
    numbers = options.frames or range(1, options.turntable + 1)
    paths = {n: options.output.with_name(f"{options.output.stem}_{n:04d}{suffix}") for n in numbers}
    require_writable(next(iter(paths.values())))
    missing = [number for number, path in paths.items() if not path.is_file()]
    if len(missing) < len(paths):
        there = len(paths) - len(missing)
        print_remark(f"{there} of {len(paths)} frames exist and are kept; remove them to render them again")
    rendered = model_pictures(options, missing)
    for _ in counted(missing, "Frames"):
        number, image = next(rendered)
        write_image(options, image, paths[number])
    if is_video:
        _write_video(options.output, list(paths.values()), options.fps or DEFAULT_FPS)
        print_result(options.output)


def write_image(options: argparse.Namespace, picture: Picture, path: Path) -> None:
    """Write a picture, and its products beside it, if they are several, or the picture's format has no AOVs."""
    suffix, colors = path.suffix.lower(), [name for name in picture.channels if name in "RGBA"]
    is_exr, has_aovs = suffix == ".exr", len(colors) < len(picture.channels)
    if suffix == ".jpg" and "A" in colors:
        colors.remove("A")  # The format has no alpha
    elif suffix == ".hdr" and len(colors) == 1:
        colors *= 3  # The format has no grey
    images = {path: [*picture.channels] if is_exr else colors}
    if len(picture.products) > 1 or (not is_exr and has_aovs):
        for name, layers in picture.products.items():
            chosen = [channel for channel in picture.channels if channel.rpartition(".")[0] in layers]
            images[path.with_name(f"{path.stem}_{name}.exr")] = chosen
    for file, names in images.items():
        with whole_file(file) as beside:
            pixels = picture.pixels[..., [picture.channels.index(name) for name in names]]
            bitmap = _bitmap(pixels, names, in_8_bits=file.suffix.lower() in (".png", ".jpg"))
            if options.denoise:
                bitmap.metadata()[METADATA_ATTRIBUTE] = json.dumps({"denoised": True})
            bitmap.write(str(beside))
        print_result(file)


def _bitmap(image: NDArray[np.float32], channels: list[str], *, in_8_bits: bool) -> mi.Bitmap:
    if not in_8_bits and any("." in name for name in channels):
        return mi.Bitmap(image, mi.Bitmap.PixelFormat.MultiChannel, channels)
    if not in_8_bits or image.shape[2] != 4:
        return mi.util.convert_to_bitmap(image, uint8_srgb=in_8_bits)
    rgba, straight = mi.Bitmap.PixelFormat.RGBA, mi.Bitmap.AlphaTransform.Unpremultiply  # PNG files have straight alpha
    return mi.Bitmap(image, rgba).convert(rgba, mi.Struct.Type.UInt8, True, straight)


def _render_picture(
    options: argparse.Namespace,
    scenes: Iterable[LoadedScene],
    spp: int | None = None,
    source: SceneSource[Any] | None = None,
) -> Picture:
    """Picture of one scene, or mean of a frame's sub-frames, with different samples."""
    count, _ = options.shutter or (1, None)
    total: Any = 0.0
    for part, loaded in enumerate(scenes):
        seed = (options.seed * count + part) % 2**32
        with threads_set(options.threads):
            weigh_lights(loaded.scene, loaded.sensor_index)
            image = render_image(loaded, spp or loaded.sensor.sampler().sample_count(), seed)
            if options.denoise:
                image = denoised(loaded, image, seed)  # Denoised separately, with the albedo and normals of its time
        total = total + image / count
    channels = loaded.channel_names(total.shape[2])
    if source is None:
        return Picture(total, channels, {})
    # Small models are enlarged.
    lengths = [name for name, kind in source.aovs.items() if kind in LENGTHS]
    total[..., [channel.rpartition(".")[0] in lengths for channel in channels]] /= source.factor or 1.0
    return Picture(total, channels, source.products)


def model_pictures(options: argparse.Namespace, numbers: Sequence[int]) -> Iterator[tuple[int, Picture]]:
    """Frames of a model, or its picture as number 1, with their numbers, in the order of completion."""
    if options.dask:
        return _on_cluster(options, numbers)
    shown, source = _shown(options)
    if options.save_scene:
        save_scene(shown.scene, options.save_scene, [options.scene])
    scenes, (sub_frames, _) = shown.frames(numbers, options.filter), options.shutter or (1, None)
    return ((number, _render_picture(options, islice(scenes, sub_frames), source=source)) for number in numbers)


def render_by_passes(options: argparse.Namespace, is_model: bool) -> None:
    """Render by passes in the current variant, in this process or on a cluster, and write the image."""
    # Workers get the path, too, and may have another working folder.
    load: Callable[[], LoadedScene] = partial(_load_still, _as_data(options))
    if not is_model:
        path = options.scene.resolve() if options.dask else options.scene
        filter_name = BOX if options.reference else options.filter
        load = partial(load_scene, path, dict(options.parameters), filter_name, options.sensor or 0)
    loaded = load()
    require_writable(options.output, loaded.file_paths)
    spp = options.spp or (renders.REFERENCE_SPP if options.reference else loaded.sensor.sampler().sample_count())
    tolerances = Tolerances().with_values(dict(options.tolerances))
    number, count = options.share or (1, options.passes or 1)
    batch = options.batch or min(renders.BATCH, max(1, spp // max(renders.LEAST_BATCHES, count)))
    if is_model:
        # Otherwise Mitsuba would round each batch up, to more samples than recorded.
        batch = sampler(batch)["sample_count"]
    sampling = renders.Sampling(max(1, -(-spp // batch)), batch, options.seed)
    settings = {"with_probe": options.reference}
    with threads_set(options.threads):
        if options.dask:
            image = render_on_cluster(options.dask, load, sampling, options.passes or 0, **settings)
        elif options.share:
            image = renders.render_pass(loaded, sampling, number, count, **settings)
        else:
            passes = (renders.render_pass(loaded, sampling, i, count, **settings) for i in range(1, count + 1))
            image = renders.merge_passes(list(passes))
    if options.reference:
        image = renders.as_reference(image, options.scene, options.output, tolerances)
    save_image(options.output, image)
    print_result(options.output)


def _as_data(options: argparse.Namespace) -> dict[str, Any]:
    """Options with which a process in another folder renders the same pictures."""
    given = {name: value for name, value in vars(options).items() if name not in ("run", "parser")}
    return given | {"scene": options.scene.resolve()}


def _load_still(given: dict[str, Any]) -> LoadedScene:
    options = argparse.Namespace(**given)
    return next(_shown(options)[0].frames([1], options.filter))


def _on_cluster(options: argparse.Namespace, numbers: Sequence[int]) -> Iterator[tuple[int, Picture]]:
    # A number of this command, as files may change before the next one.
    command = pickle.dumps(_as_data(options) | {"command": uuid4().hex})
    warned: set[str] = set()
    with cluster(options.dask) as client:
        for number, (image, messages) in results(client, partial(_frame, command), numbers):
            for message in dict.fromkeys(messages):
                if message not in warned:
                    warn(message)
            warned.update(messages)
            yield number, image


def _frame(command: bytes, number: int) -> tuple[Picture, list[str]]:
    """A picture and messages of warnings; runs on a worker."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CageWarning)
        options, (shown, source) = _kept(command)
        image = _render_picture(options, shown.frames([number], options.filter), source=source)
    return image, [str(warning.message) for warning in caught if issubclass(warning.category, CageWarning)]


@lru_cache(maxsize=1)
def _kept(command: bytes) -> tuple[argparse.Namespace, _Shown]:
    """Options and their model, which a worker reads once for all of its frames."""
    options = argparse.Namespace(**pickle.loads(command))
    return options, _shown(options)


def _shown(options: argparse.Namespace) -> _Shown:
    source = _source(options)
    shown: StillPicture
    if options.frames or options.shutter:
        shown = FrameRange(source, options.frames or range(1, 2))
    elif options.turntable:
        shown = Turntable(source, options.turntable, follows_sensor=not options.save_scene)
    else:
        shown = StillPicture(source, follows_sensor=not options.save_scene)
    for remark in source.remarks():
        print_remark(remark)
    if options.save_scene and source.factor != 1:
        print_remark(f"{source.name}: lengths of the saved scene are {source.factor:g} times those of the small model")
    return shown, source


def _source(options: argparse.Namespace) -> SceneSource[Any]:
    azimuth, elevation = VIEWS[options.view or DEFAULT_VIEW]
    azimuth = azimuth if options.azimuth is None else options.azimuth
    elevation = elevation if options.elevation is None else options.elevation
    look = Look(
        view=(azimuth, elevation),
        has_studio=not options.no_studio,
        scales=True,
        **{"aovs": {}, **{name: value for name in _OF_LOOK if (value := getattr(options, name)) is not None}},
        **(options.environment or {}),
    )
    which = {"time": options.time, "numbers": options.frames}
    if is_stage(options):
        from mitsuba_usd import StageScenes

        given = {"tessellation_rate": options.rate, "shading": options.shading}
        parameters = {name: value for name, value in given.items() if value is not None}
        count, interval = options.shutter or (None, None)
        which |= {"camera": options.camera, "over": options.over, "shutter": count, "interval": interval}
        return StageScenes(options.scene, look, parameters, **which)
    for name in _OF_STAGES:
        if getattr(options, name):
            flag = f"--{name.replace('_', '-')}"
            raise ValueError(f'{flag} was given for one cage of "{options.scene}"; expected it for a whole USD file')
    shading = shading_for({"shading": options.shading or "auto"})
    return CageScenes(options.scene, replace(look, shading=shading), prim=options.prim, scheme=options.scheme, **which)


def _require_encoder(path: Path) -> None:
    try:
        import imageio.v2  # noqa: F401 - only to find out whether it is there

        if path.suffix.lower() == ".mp4":
            import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        what = f'output "{path}": the package {error.name}, which writes videos, is missing'
        instead = 'pip install "mitsuba-subdivision[video]", or name a .png file for frames only'
        raise ValueError(f"{what}; {instead}") from None


def _write_video(path: Path, frames: Sequence[Path], fps: float) -> None:
    import imageio.v2 as imageio

    is_gif = path.suffix.lower() == ".gif"  # GIF files loop for ever, with durations in milliseconds
    settings: dict[str, Any] = {"duration": 1000 / fps, "loop": 0} if is_gif else {"fps": fps, "macro_block_size": EVEN}
    with whole_file(path) as beside:
        video: Any = imageio.get_writer(beside, **settings)
        with video:
            for frame in frames:
                pixels = imageio.imread(frame)[..., :3]
                height, width = (side if is_gif else side // EVEN * EVEN for side in pixels.shape[:2])
                video.append_data(pixels[:height, :width])
