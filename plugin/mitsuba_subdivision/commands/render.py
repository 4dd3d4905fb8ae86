"""The command ``render``: Mitsuba scenes, and models in the studio, here or on the workers of a cluster."""

from __future__ import annotations

import argparse
import json
import pickle
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from itertools import islice
from math import inf, isfinite
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageWarning, warn
from ..files import require_usd
from ..files.formats import FORMATS, is_usd
from ..messages import counted, print_remark, print_result
from ..regression import renders
from ..regression.image import METADATA_ATTRIBUTE, save_image
from ..regression.scene import BOX, LoadedScene, kept_search_folders, load_scene, render_image
from ..regression.tiers import Tolerances
from ..shapes.parameter_table import SHADINGS
from ..studio import AOVS, DEFAULT_VIEW, Look, sampler
from ..studio.animation import FrameRange, SceneSource, StillPicture, Turntable
from ..studio.cage_scenes import CageScenes
from ..studio.picture import denoised, require_denoiser, shading_for, weigh_lights
from ..studio.saving import save_scene
from ..studio.studio_entries import LENGTHS, UP_AXES, VIEWS
from ..variants import set_variant, threads_set, variant_problem
from ..whole_file import require_writable, whole_file
from .arguments import CommandParser, above_zero, add_cage_options, add_variant, checked, finite, index, positive, seed
from .cluster import cluster, render_on_cluster, results
from .compare import TOLERANCES, add_tolerances

IMAGE_SUFFIXES, VIDEO_SUFFIXES, SCENE_SUFFIX = (".exr", ".png", ".jpg", ".hdr"), (".gif", ".mp4"), ".xml"
DEFAULT_FPS = 24
# Options that select one mesh of a USD file, and those of whole ones.
_OF_ONE_MESH = ("up", "scheme", "prim", "checker", "cage")
_OF_STAGES = ("shutter", "texture_size", "camera", "over")
_OF_SCENES = ("parameters", "sensor", "share", "reference", "tolerances")  # Options about scenes in files
# Options that `Look` has by the same names.
_OF_LOOK = ("up", "size", "spp", "rate", "checker", "cage", "texture_size", "transparent", "aovs")
# Suffixes of files that Blender converts to USD files.
_OF_BLENDER = (".blend", ".fbx", ".gltf", ".glb", ".abc", ".dae", ".stl", ".3ds")
SUB_FRAMES = 16  # In an interval
_Animation = FrameRange | Turntable | StillPicture
_Shown = tuple[_Animation, SceneSource[Any]]
_WITH_ALPHA = (".exr", ".png")
EVEN = 2  # Sides of the pictures in an MP4 file are multiples of this; others lose a row or a column


class Picture(NamedTuple):
    """Pixels of a rendered picture, with its colour and its AOVs, and the parts of it that render products have."""

    pixels: NDArray[np.float32]  # (height, width, channels)
    channels: tuple[str, ...]
    products: dict[str, list[str]]  # Names of AOVs of products, by their names; "" is the colour


def _numbers(text: str) -> range:
    first, last, *step = map(int, text.split(":"))
    return range(first, last + 1, *step)


def _integers(separator: str) -> Callable[[str], tuple[int, ...]]:
    return lambda text: tuple(map(int, text.split(separator)))


def _shutter_of(text: str) -> tuple[int, tuple[float, float] | None]:
    """Number of sub-frames, and time codes from the frame to opening and closing; None for those of the camera."""
    numbers = text.split(":")
    count = int(numbers[0] if len(numbers) == 1 else numbers[2] if len(numbers) == 3 else SUB_FRAMES)
    return count, None if len(numbers) == 1 else (float(numbers[0]), float(numbers[1]))


def _environment_of(text: str) -> dict[str, Any]:
    """Values of `Look` for an environment."""
    path, turn, strength = re.fullmatch(r"(.+?)(?:,turn=([^,]*))?(?:,strength=([^,]*))?", text).groups()  # type: ignore[union-attr]
    return {"environment": Path(path), "turn": float(turn or 0), "strength": float(strength or 1)}


_shutter = checked(
    _shutter_of,
    lambda shutter: shutter[0] > 0 and (shutter[1] is None or -inf < shutter[1][0] < shutter[1][1] < inf),
    "a number of sub-frames, or OPEN:CLOSE or OPEN:CLOSE:N, such as -0.25:0.25",
)
_environment = checked(
    _environment_of,
    lambda given: isfinite(given["turn"]) and 0 <= given["strength"] < inf,
    "a picture, such as sky.exr or sky.exr,turn=90,strength=2",
)
_aovs = checked(
    lambda text: {name: AOVS.get(name) for name in text.split(",")},
    lambda aovs: None not in aovs.values(),
    f"some of {', '.join(AOVS)}, such as normals,depth",
)
_size = checked(
    _integers("x"), lambda size: len(size) == 2 and min(size) > 0, "width and height of 1 or more, such as 1280x720"
)
_frame_range = checked(_numbers, lambda numbers: len(numbers) > 0, "FIRST:LAST or FIRST:LAST:STEP, such as 1:24")
_share = checked(
    _integers("/"), lambda share: len(share) == 2 and 1 <= share[0] <= share[1], "I/N with I from 1 to N, such as 2/8"
)
_assignment = checked(lambda text: text.split("=", 1), lambda pair: len(pair) == 2 and pair[0] != "", "NAME=VALUE")


def render(parser: CommandParser) -> None:
    """Add the options of ``render``."""
    parser.description = "Render a Mitsuba scene; or a model, an OBJ, PLY or USD file, in a neutral studio."
    parser.epilog = TOLERANCES
    add = parser.add_argument
    add("scene", type=Path, metavar="FILE", help="Mitsuba scene (.xml), or a model: a control cage")
    text = "image to write: .exr, .png, .jpg or .hdr; of frames also .gif or .mp4"
    add("-o", "--output", type=Path, required=True, metavar="FILE", help=text)
    add("--spp", type=positive, metavar="N", help="samples per pixel (default: the scene's; models: 64)")
    add("--seed", type=seed, default=0, metavar="N", help="seed of the samples (default: %(default)s)")
    many: dict[str, Any] = {"action": "append", "default": []}
    text = "value of a parameter of the scene; can be repeated"
    add("-D", "--define", dest="parameters", metavar="NAME=VALUE", type=_assignment, help=text, **many)
    add("-s", "--sensor", type=index, metavar="N", help="sensor of the scene, from 0 on (default: 0)")
    add("--denoise", action="store_true", help="render with the box filter, and remove noise by Open Image Denoise")
    add_variant(parser, "-m", "--mode")
    add("-t", "--threads", type=positive, metavar="N", help="threads to render with (default: all)")
    add("-a", "--append", metavar="PATHS", help='folders to search for files, separated by ";"', **many)
    add("-v", "--verbose", action="count", default=0, help="print messages of Mitsuba; repeat for more")
    models = parser.add_argument_group("models")
    add = models.add_argument
    add("--view", choices=list(VIEWS), help=f"view of the camera (default: {DEFAULT_VIEW})")
    add("--azimuth", type=finite, metavar="DEG", help="azimuth instead of --view: front 0, +x 90")
    add("--elevation", type=finite, metavar="DEG", help="elevation above the ground instead of --view, -90 to 90")
    add("--up", choices=UP_AXES, help="axis that points up (default: USD's own; OBJ: y; PLY: z)")
    text = "pixels of the picture (default: 640x480, or as the stage or its camera asks for)"
    add("--size", type=_size, metavar="WxH", help=text)
    text = "pixels along the sides of a stage's textures at most (default: as many as the picture shows)"
    add("--texture-size", type=positive, metavar="N", help=text)
    add("--over", type=Path, metavar="FILE", help="USD layer that is stronger than a stage, to change it")
    add("--camera", metavar="NAME", help="camera of a stage: its path, or its name (default: as the stage says)")
    text = "picture that lights in place of all lights, such as sky.exr or sky.exr,turn=90,strength=2"
    add("--environment", type=_environment, metavar="FILE", help=text)
    add("--no-studio", action="store_true", help="without lights and backdrop of the studio")
    add("--transparent", action="store_true", help="with alpha, without a background")
    add("--checker", action="store_true", help="show texture coordinates as a checkerboard")
    add("--cage", action="store_true", help="draw the control cage")
    text = "channels of the first hits in an OpenEXR file, such as normals,depth, besides those of a stage's products"
    add("--aov", dest="aovs", type=_aovs, metavar="NAMES", help=text)
    add_cage_options(models, "as many as the picture needs")
    text = "normals: interpolated between vertices, or exact (default: auto, exact where supported)"
    add("--shading", choices=SHADINGS, help=text)
    add("--save-scene", type=Path, metavar="FILE", help="also write the scene as XML, which can be edited and rendered")
    text = "Frames are named NAME_0001.png and so on. Existing ones are kept, so that an interrupted command can go on."
    frames = parser.add_argument_group("frames of models", text)
    add = frames.add_argument
    add("--turntable", type=positive, metavar="N", help="turn the model around once, in N frames")
    text = "times of a USD file, or numbers of files whose name has %%04d in it"
    add("--frames", type=_frame_range, metavar="FIRST:LAST[:STEP]", help=text)
    text = (
        "motion blur of a USD file: mean of N times while the shutter of its camera is open, or in an interval "
        f"OPEN:CLOSE or OPEN:CLOSE:N (default: none; N: {SUB_FRAMES})"
    )
    add("--shutter", type=_shutter, metavar="N", help=text)
    add("--fps", type=above_zero, metavar="N", help=f"frames per second of a video (default: {DEFAULT_FPS})")
    text = 'reconstruction filter instead of the scene\'s; "box" is deterministic'
    parser.add_argument("--filter", help=text)
    text = "The image is an OpenEXR file with the variance and the number of samples of each pixel."
    passes = parser.add_argument_group("rendering by passes", text)
    add = passes.add_argument
    add("--pass", dest="share", type=_share, metavar="I/N", help='render only pass I of N; "merge" puts them together')
    add("--passes", type=positive, metavar="N", help="render N passes one after the other, and merge")
    text = "render the passes, or the frames of a model, on the Dask cluster of this scheduler"
    add("--dask", metavar="ADDRESS", help=text)
    add("--batch", type=positive, metavar="N", help="samples per pixel that are rendered with one seed (default: 64)")
    text = 'write a reference for "compare": with the box filter, geometry AOVs and tolerances'
    add("--reference", action="store_true", help=text)
    add_tolerances(passes, "tolerance to store with the reference; can be repeated")
    of_models = [action.dest for group in (models, frames) for action in group._group_actions]
    parser.set_defaults(run=_render, of_models=of_models)


def _render(options: argparse.Namespace) -> None:
    suffix = options.scene.suffix.lower()
    is_model = suffix in FORMATS
    if suffix in _OF_BLENDER:
        page = 'see the page "From Blender to a picture" of the guide, blender.md'
        what = f'"{options.scene}" is a file for programs such as Blender, which write it as USD file'
        raise ValueError(f"{what}; expected a model ({', '.join(FORMATS)}): {page}")
    if not is_model and suffix != SCENE_SUFFIX and not options.scene.is_file():
        expected = f"a Mitsuba scene ({SCENE_SUFFIX}) or a model ({', '.join(FORMATS)})"
        raise ValueError(f'"{options.scene}" is not a file; expected {expected}')
    # A worker of a cluster renders a frame as a whole.
    on_cluster = options.dask and not (options.frames or options.turntable or options.shutter)
    by_passes = bool(options.share or options.passes or options.reference or on_cluster)
    _require_effect(options, is_model)
    _refuse_contradictions(options, by_passes)
    if options.denoise:
        require_denoiser()
        options.filter = BOX
    set_variant(options.variant or _stated_variant(options))
    with _settings(options):
        if options.scene.is_file() and not options.frames:
            require_writable(options.output, [options.scene])
        elif is_model and not options.frames:
            hint = ", or --frames for a name of several files" if "%" in options.scene.name else ""
            raise FileNotFoundError(f'"{options.scene}": there is no such file; expected a model{hint}')
        if by_passes:
            _render_by_passes(options, is_model)
        elif options.frames or options.turntable:
            _write_frames(options)
        else:
            image = next(_pictures(options, [1]))[1] if is_model else _picture_of_scene(options)
            _write_image(options, image, options.output)


def _stated_variant(options: argparse.Namespace) -> str | None:
    """The variant that render settings of a stage ask for; None if they do not, or it cannot run here."""
    if not _is_stage(options):
        return None
    require_usd(f'"{options.scene}"')
    from mitsuba_usd.stage_settings import read_variant

    name = read_variant(options.scene, options.over)
    if name and (problem := variant_problem(name)):
        warn(f'"{options.scene}": mitsuba:variant of render settings is ignored: {problem}')
        return None
    return name


def _is_stage(options: argparse.Namespace) -> bool:
    """Whether a USD file is rendered as a whole."""
    return is_usd(options.scene) and not any(getattr(options, name) for name in _OF_ONE_MESH)


def _require_effect(options: argparse.Namespace, is_model: bool) -> None:
    what, useless = ("model", _OF_SCENES) if is_model else ("scene", options.of_models)
    other = "a Mitsuba scene, which --save-scene writes" if is_model else "a model"
    for name in useless:
        given = getattr(options, name)
        # An angle or a sensor may be 0.
        if given is not None and given is not False and given != []:
            flags = {"parameters": "-D", "share": "--pass", "tolerances": "--tolerance", "aovs": "--aov"}
            flag = flags.get(name, f"--{name.replace('_', '-')}")
            raise ValueError(f'{flag} was given for the {what} "{options.scene}"; expected it for {other}')


def _refuse_contradictions(options: argparse.Namespace, by_passes: bool) -> None:
    """Refuse outputs of an unknown kind, and options that contradict each other or have no effect with the others."""
    suffix, has_frames = options.output.suffix.lower(), options.turntable or options.frames
    has_other_filter = options.filter not in (None, BOX)
    all_options = "--pass, --passes, --dask or --reference"
    if by_passes and suffix != ".exr":
        raise ValueError(f'output "{options.output}"; expected a name ending in .exr, which keeps the variance')
    if options.share and (options.passes or options.dask):
        raise ValueError("--pass renders one pass, --passes and --dask render all; expected one of them")
    if options.reference and has_other_filter:
        raise ValueError(f'references have the filter "{BOX}", not "{options.filter}"')
    if options.denoise and by_passes:
        removed = "the noise that passes and references measure"
        raise ValueError(f"--denoise removes {removed}; expected no {all_options} beside it")
    if options.denoise and has_other_filter:
        raise ValueError(f'--denoise needs the filter "{BOX}", not "{options.filter}"')
    if options.batch and not by_passes:
        raise ValueError(f"--batch is for passes; expected {all_options} beside it")
    if options.tolerances and not options.reference:
        raise ValueError("--tolerance is stored with a reference; expected --reference beside it")
    if options.aovs and suffix != ".exr":
        raise ValueError(f'output "{options.output}" has no AOVs; expected a name ending in .exr')
    if options.transparent and by_passes:
        raise ValueError(f"--transparent is for pictures; expected no {all_options} beside it")
    if options.transparent and suffix not in _WITH_ALPHA:
        raise ValueError(f'output "{options.output}" has no alpha; expected one ending in {" or ".join(_WITH_ALPHA)}')
    if options.environment and not options.environment["environment"].is_file():
        raise FileNotFoundError(f'"{options.environment["environment"]}": there is no such file; expected a picture')
    known = (*IMAGE_SUFFIXES, *(VIDEO_SUFFIXES if has_frames else ()))
    if suffix not in known:
        more = ", or --turntable or --frames for a video" if suffix in VIDEO_SUFFIXES else ""
        raise ValueError(f'output "{options.output}"; expected a name ending in one of {", ".join(known)}{more}')
    if options.turntable and options.frames:
        raise ValueError("--turntable turns one model, --frames shows several; expected only one of them")
    if options.fps and suffix not in VIDEO_SUFFIXES:
        raise ValueError(f"--fps is for videos; expected an output ending in one of {', '.join(VIDEO_SUFFIXES)}")
    if options.passes and has_frames:
        raise ValueError("--passes are of one picture; expected no --frames or --turntable beside it")
    if options.save_scene and (options.dask or options.passes):
        raise ValueError("--save-scene writes a scene that is rendered at once; expected no --dask or --passes")
    if options.time is not None and options.frames:
        raise ValueError("--time is one time, --frames are several; expected only one of them")
    if options.shutter and (options.turntable or (options.time is None and not options.frames)):
        not_turntable = ", not --turntable" if options.turntable else ""
        raise ValueError(f"--shutter opens at a time of a USD file; expected --time or --frames{not_turntable}")


@contextmanager
def _settings(options: argparse.Namespace) -> Iterator[None]:
    level = mi.log_level()
    with kept_search_folders() as resolver:
        for folder in filter(None, ";".join(options.append).split(";")):
            resolver.append(folder)
        if options.verbose:
            levels = (mi.LogLevel.Info, mi.LogLevel.Debug, mi.LogLevel.Trace)
            mi.set_log_level(levels[min(options.verbose, len(levels)) - 1])
        try:
            yield
        finally:
            mi.set_log_level(level)


def _picture_of_scene(options: argparse.Namespace) -> Picture:
    loaded = load_scene(options.scene, dict(options.parameters), options.filter, options.sensor or 0)
    require_writable(options.output, loaded.file_paths)
    if loaded.scene.integrator() is None:  # Mitsuba would raise a bare Exception.
        raise ValueError(f'scene "{options.scene}" has no integrator; expected one')
    if options.output.suffix.lower() != ".exr" and loaded.scene.integrator().aov_names():
        raise ValueError(f'output "{options.output}"; expected a name ending in .exr, as the integrator has AOVs')
    return _render_picture(options, [loaded], options.spp)


def _write_frames(options: argparse.Namespace) -> None:
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
    rendered = _pictures(options, missing)
    for _ in counted(missing, "Frames"):
        number, image = next(rendered)
        _write_image(options, image, paths[number])
    if is_video:
        _write_video(options.output, list(paths.values()), options.fps or DEFAULT_FPS)
        print_result(options.output)


def _write_image(options: argparse.Namespace, picture: Picture, path: Path) -> None:
    """Write a picture, and its products beside it, if they are several, or the picture's format has no AOVs."""
    colors = [name for name in picture.channels if name in "RGBA"]
    is_exr = path.suffix.lower() == ".exr"
    images = {path: [*picture.channels] if is_exr else colors}
    if len(picture.products) > 1 or (not is_exr and len(colors) < len(picture.channels)):
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
    # PNG files have colours that are not multiplied by alpha.
    rgba, straight = mi.Bitmap.PixelFormat.RGBA, mi.Bitmap.AlphaTransform.Unpremultiply
    return mi.Bitmap(image, rgba).convert(rgba, mi.Struct.Type.UInt8, True, straight)


def _render_picture(
    options: argparse.Namespace,
    scenes: Iterable[LoadedScene],
    spp: int | None = None,
    source: SceneSource[Any] | None = None,
) -> Picture:
    """Mean picture of scenes that share no samples: one, or those of a frame's sub-frames."""
    count, _ = options.shutter or (1, None)
    total: Any = 0.0
    for part, loaded in enumerate(scenes):
        seed = (options.seed * count + part) % 2**32
        with threads_set(options.threads):
            weigh_lights(loaded.scene, loaded.sensor_index)
            image = render_image(loaded, spp or loaded.sensor.sampler().sample_count(), seed)
            if options.denoise:
                # Each by itself, as its albedo and normals are those of its time.
                image = denoised(loaded, image, seed)
        total = total + image / count
    channels = loaded.channel_names(total.shape[2])
    if source is None:
        return Picture(total, channels, {})
    # Small models are rendered as larger ones.
    lengths = [name for name, kind in source.aovs.items() if kind in LENGTHS]
    total[..., [channel.rpartition(".")[0] in lengths for channel in channels]] /= source.factor or 1.0
    return Picture(total, channels, source.products)


def _pictures(options: argparse.Namespace, numbers: Sequence[int]) -> Iterator[tuple[int, Picture]]:
    """Frames of a model, or its picture as number 1, with their numbers, as they are finished."""
    if options.dask:
        return _on_cluster(options, numbers)
    shown, source = _shown(options)
    if options.save_scene:
        save_scene(shown.scene, options.save_scene, [options.scene])
    scenes, (sub_frames, _) = shown.frames(numbers, options.filter), options.shutter or (1, None)
    return ((number, _render_picture(options, islice(scenes, sub_frames), source=source)) for number in numbers)


def _render_by_passes(options: argparse.Namespace, is_model: bool) -> None:
    """Render by passes, in the current variant, here or on a cluster, and write the image."""
    # Workers get it, too, and may be in another folder.
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
        # Mitsuba would round each batch up, and more samples than recorded would count.
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
    """Options by which another process, in another folder, renders the same pictures."""
    given = {name: value for name, value in vars(options).items() if name not in ("run", "parser")}
    return given | {"scene": options.scene.resolve()}


def _load_still(given: dict[str, Any]) -> LoadedScene:
    options = argparse.Namespace(**given)
    return next(_shown(options)[0].frames([1], options.filter))


def _on_cluster(options: argparse.Namespace, numbers: Sequence[int]) -> Iterator[tuple[int, Picture]]:
    # The command's own number: files may change until the next one.
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
    """A picture, and the messages of warnings; runs on a worker."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CageWarning)
        options, (shown, source) = _kept(command)
        image = _render_picture(options, shown.frames([number], options.filter), source=source)
    return image, [str(warning.message) for warning in caught if issubclass(warning.category, CageWarning)]


@lru_cache(maxsize=1)
def _kept(command: bytes) -> tuple[argparse.Namespace, _Shown]:
    """Options and what they show: a worker reads it once for all of its frames."""
    options = argparse.Namespace(**pickle.loads(command))
    return options, _shown(options)


def _shown(options: argparse.Namespace) -> _Shown:
    """What a model's pictures show, and the scene source."""
    source = _source(options)
    shown: _Animation
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
    if _is_stage(options):
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
    """Raise ValueError if a package that writes a video is missing, before frames are rendered."""
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

    is_gif = path.suffix.lower() == ".gif"  # A GIF file repeats for ever, and its durations are milliseconds
    settings: dict[str, Any] = {"duration": 1000 / fps, "loop": 0} if is_gif else {"fps": fps, "macro_block_size": EVEN}
    with whole_file(path) as beside:
        video: Any = imageio.get_writer(beside, **settings)
        with video:
            for frame in frames:
                pixels = imageio.imread(frame)[..., :3]
                height, width = (side if is_gif else side // EVEN * EVEN for side in pixels.shape[:2])
                video.append_data(pixels[:height, :width])
