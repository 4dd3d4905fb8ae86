"""The options of the command ``render`` and their checks; `pictures` renders."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import inf, isfinite
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..cage.errors import warn
from ..files import require_usd
from ..files.formats import FORMATS
from ..regression.scene import BOX, kept_search_folders
from ..shapes.parameter_table import SHADINGS
from ..studio import AOVS, DEFAULT_VIEW
from ..studio.picture import require_denoiser
from ..studio.studio_entries import UP_AXES, VIEWS
from ..variants import set_variant, variant_problem
from ..whole_file import require_writable
from . import pictures
from .arguments import CommandParser, above_zero, add_cage_options, add_variant, checked, finite, index, positive, seed
from .compare import TOLERANCES, add_tolerances

IMAGE_SUFFIXES, SCENE_SUFFIX = (".exr", ".png", ".jpg", ".hdr"), ".xml"
_OF_SCENES = ("parameters", "sensor", "share", "reference", "tolerances")  # Options for Mitsuba scenes
# Suffixes of files that Blender can convert to USD.
_OF_BLENDER = (".blend", ".fbx", ".gltf", ".glb", ".abc", ".dae", ".stl", ".3ds")
SUB_FRAMES = 16  # In an interval
_WITH_ALPHA = (".exr", ".png")


def _numbers(text: str) -> range:
    first, last, *step = map(int, text.split(":"))
    return range(first, last + 1, *step)


def _integers(separator: str) -> Callable[[str], tuple[int, ...]]:
    return lambda text: tuple(map(int, text.split(separator)))


def _shutter_of(text: str) -> tuple[int, tuple[float, float] | None]:
    """Number of sub-frames, and opening and closing times relative to the frame; None for the camera's."""
    numbers = text.split(":")
    count = int(numbers[0] if len(numbers) == 1 else numbers[2] if len(numbers) == 3 else SUB_FRAMES)
    return count, None if len(numbers) == 1 else (float(numbers[0]), float(numbers[1]))


def _environment_of(text: str) -> dict[str, Any]:
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
    text = "size in pixels (default: 640x480, or that of the stage or its camera)"
    add("--size", type=_size, metavar="WxH", help=text)
    text = "most pixels along a side of a stage's textures (default: as many as the picture shows)"
    add("--texture-size", type=positive, metavar="N", help=text)
    add("--over", type=Path, metavar="FILE", help="USD layer that changes a stage, stronger than its own layers")
    add("--camera", metavar="NAME", help="camera of a stage: its path, or its name (default: the stage's)")
    text = "environment map in place of all lights, such as sky.exr or sky.exr,turn=90,strength=2"
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
    text = "Frames are named NAME_0001.png and so on. Existing frames are kept: repeat a command to resume it."
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
    add("--fps", type=above_zero, metavar="N", help=f"frames per second of a video (default: {pictures.DEFAULT_FPS})")
    parser.add_argument("--filter", help='reconstruction filter instead of the scene\'s; "box" is deterministic')
    text = "The image is an OpenEXR file with the variance and the number of samples of each pixel."
    passes = parser.add_argument_group("rendering by passes", text)
    add = passes.add_argument
    add("--pass", dest="share", type=_share, metavar="I/N", help='render only pass I of N; "merge" combines them')
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
        what = f'"{options.scene}" is a file for programs such as Blender, which can convert it to USD'
        raise ValueError(f"{what}; expected a model ({', '.join(FORMATS)}): {page}")
    if not is_model and suffix != SCENE_SUFFIX and not options.scene.is_file():
        expected = f"a Mitsuba scene ({SCENE_SUFFIX}) or a model ({', '.join(FORMATS)})"
        raise ValueError(f'"{options.scene}" is not a file; expected {expected}')
    # A worker of a cluster renders whole frames.
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
            pictures.render_by_passes(options, is_model)
        elif options.frames or options.turntable:
            pictures.write_frames(options)
        else:
            image = next(pictures.model_pictures(options, [1]))[1] if is_model else pictures.picture_of_scene(options)
            pictures.write_image(options, image, options.output)


def _stated_variant(options: argparse.Namespace) -> str | None:
    """The variant of a stage's render settings; None if they have none, or it cannot run here."""
    if not pictures.is_stage(options):
        return None
    require_usd(f'"{options.scene}"')
    from mitsuba_usd.stage_settings import read_variant

    name = read_variant(options.scene, options.over)
    if name and (problem := variant_problem(name)):
        warn(f'"{options.scene}": mitsuba:variant of render settings is ignored: {problem}')
        return None
    return name


def _require_effect(options: argparse.Namespace, is_model: bool) -> None:
    what, useless = ("model", _OF_SCENES) if is_model else ("scene", options.of_models)
    other = "a Mitsuba scene, which --save-scene writes" if is_model else "a model"
    for name in useless:
        given = getattr(options, name)
        if given is not None and given is not False and given != []:  # Angles and sensors may be 0
            flags = {"parameters": "-D", "share": "--pass", "tolerances": "--tolerance", "aovs": "--aov"}
            flag = flags.get(name, f"--{name.replace('_', '-')}")
            raise ValueError(f'{flag} was given for the {what} "{options.scene}"; expected it for {other}')


def _refuse_contradictions(options: argparse.Namespace, by_passes: bool) -> None:
    suffix, has_frames = options.output.suffix.lower(), options.turntable or options.frames
    has_other_filter, videos = options.filter not in (None, BOX), pictures.VIDEO_SUFFIXES
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
    known = (*IMAGE_SUFFIXES, *(videos if has_frames else ()))
    if suffix not in known:
        more = ", or --turntable or --frames for a video" if suffix in videos else ""
        raise ValueError(f'output "{options.output}"; expected a name ending in one of {", ".join(known)}{more}')
    if options.turntable and options.frames:
        raise ValueError("--turntable turns one model, --frames shows several; expected only one of them")
    if options.fps and suffix not in videos:
        raise ValueError(f"--fps is for videos; expected an output ending in one of {', '.join(videos)}")
    if options.passes and has_frames:
        raise ValueError("--passes are of one picture; expected no --frames or --turntable beside it")
    if options.save_scene and (options.dask or options.passes):
        raise ValueError("--save-scene writes a scene that this process renders; expected no --dask or --passes")
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
