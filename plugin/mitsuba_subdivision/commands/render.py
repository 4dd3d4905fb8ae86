"""The command ``render``: Mitsuba scenes, and models in the studio."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..files.formats import FORMATS
from ..messages import print_remark, print_result
from ..progress import counted
from ..regression.image import METADATA_ATTRIBUTE
from ..regression.scene import BOX, kept_search_folders, load_scene
from ..shapes.parameter_table import SHADINGS
from ..studio.camera import DEFAULT_VIEW, UP_AXES, VIEWS
from ..studio.denoising import require_denoiser
from ..whole_file import require_writable, whole_file
from .arguments import Commands, add_cage_options, add_variant, finite, positive, seed, set_variant
from .passes import add_pass_options, render_by_passes, validate_pass_options, wants_passes
from .pictures import as_data, load_still, pictures, render_picture

IMAGE_SUFFIXES = (".exr", ".png", ".jpg", ".hdr")
SCENE_SUFFIX = ".xml"
DEFAULT_FPS = 24
# Options about models, by the names that they have after parsing; others are about every scene.
_OF_MODELS = (
    "view", "azimuth", "elevation", "up", "size", "scheme", "prim", "time", "rate", "shading", "checker", "cage",
    "texture_size",
)  # fmt: skip
_OF_FRAMES = ("turntable", "frames", "shutter", "fps")
# Options that do not apply to a model's scene.
_OF_SCENES = ("parameters", "sensor", "share", "reference", "tolerances")

VIDEO_SUFFIXES = (".gif", ".mp4")
# Sides of the pictures in an MP4 file are multiples of this; others lose a row or a column.
EVEN = 2


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    render = commands.add_parser(
        "render",
        help="render a scene, or a model in a studio",
        description="Render a Mitsuba scene, which may have subdivision shapes; or a model, an OBJ, PLY or USD file, "
        "in a neutral studio.",
    )
    add = render.add_argument
    add("scene", type=Path, metavar="FILE", help="Mitsuba scene (.xml), or a model: a control cage")
    text = "image to write: .exr, .png, .jpg or .hdr; of frames also .gif or .mp4"
    add("-o", "--output", type=Path, required=True, metavar="FILE", help=text)
    add("--spp", type=positive, metavar="N", help="samples per pixel (default: the scene's; models: 64)")
    add("--seed", type=seed, default=0, metavar="N", help="seed of the samples (default: %(default)s)")
    many: dict[str, Any] = {"action": "append", "default": []}
    text = "value of a parameter of the scene; can be repeated"
    add("-D", "--define", dest="parameters", metavar="NAME=VALUE", type=_assignment, help=text, **many)
    add("-s", "--sensor", type=_index, metavar="N", help="sensor of the scene, from 0 on (default: 0)")
    add("--denoise", action="store_true", help="render with the box filter, and remove noise by Open Image Denoise")
    add_variant(render, "-m", "--mode")
    add("-t", "--threads", type=positive, metavar="N", help="threads to render with (default: all)")
    text = 'folders to search for files, separated by ";"'
    add("-a", "--append", metavar="PATHS", help=text, **many)
    add("-v", "--verbose", action="count", default=0, help="print messages of Mitsuba; repeat for more")
    _add_model_options(render)
    _add_frame_options(render)
    add_pass_options(render)
    render.set_defaults(run=_render, parser=render)


def _add_model_options(render: argparse.ArgumentParser) -> None:
    group = render.add_argument_group("models")
    add = group.add_argument
    add("--view", choices=list(VIEWS), help=f"view of the camera (default: {DEFAULT_VIEW})")
    add("--azimuth", type=finite, metavar="DEG", help="azimuth instead of --view: front 0, +x 90")
    add("--elevation", type=finite, metavar="DEG", help="elevation above the ground instead of --view, -90 to 90")
    add("--up", choices=UP_AXES, help="axis that points up (default: USD's own; OBJ: y; PLY: z)")
    text = "pixels of the picture (default: 640x480, or as the stage or its camera asks for)"
    add("--size", type=_size, metavar="WxH", help=text)
    text = "pixels along the sides of a stage's textures at most (default: as many as the picture shows)"
    add("--texture-size", type=positive, metavar="N", help=text)
    add("--checker", action="store_true", help="show texture coordinates as a checkerboard")
    add("--cage", action="store_true", help="draw the control cage")
    add_cage_options(group, "as many as the picture needs")
    text = "normals: interpolated between vertices, or exact (default: auto, exact where supported)"
    add("--shading", choices=SHADINGS, help=text)
    add("--save-scene", type=Path, metavar="FILE", help="also write the scene as XML, which can be edited and rendered")


def _add_frame_options(render: argparse.ArgumentParser) -> None:
    group = render.add_argument_group(
        "frames of models",
        "Frames are written as NAME_0001.png and so on. Existing frames are kept, so that an "
        "interrupted command can be repeated.",
    )
    group.add_argument("--turntable", type=positive, metavar="N", help="turn the model around once, in N frames")
    text = "times of a USD file, or numbers of files whose name has %%04d in it"
    group.add_argument("--frames", type=_frame_range, metavar="FIRST:LAST[:STEP]", help=text)
    text = "motion blur of a USD file: mean of N times while the shutter of its camera is open (default: none)"
    group.add_argument("--shutter", type=positive, metavar="N", help=text)
    group.add_argument("--fps", type=_fps, metavar="N", help=f"frames per second of a video (default: {DEFAULT_FPS})")


def _render(options: argparse.Namespace) -> None:
    suffix = options.scene.suffix.lower()
    is_model = suffix in FORMATS
    if not is_model and suffix != SCENE_SUFFIX and not options.scene.is_file():
        expected = f"a Mitsuba scene ({SCENE_SUFFIX}) or a model ({', '.join(FORMATS)})"
        raise ValueError(f'"{options.scene}" is not a file; expected {expected}')
    _validate(options, is_model)
    set_variant(options.variant)
    with _settings(options):
        (_render_model if is_model else _render_scene)(options)


def _validate(options: argparse.Namespace, is_model: bool) -> None:
    """Refuse options that have no effect with this input, and outputs of an unknown kind."""
    what, useless = ("model", _OF_SCENES) if is_model else ("scene", (*_OF_MODELS, *_OF_FRAMES, "save_scene"))
    other = "a Mitsuba scene, which --save-scene writes" if is_model else "a model"
    for name in useless:
        given = getattr(options, name)
        # An angle or a sensor may be 0.
        if given is not None and given is not False and given != []:
            flags = {"parameters": "-D", "share": "--pass", "tolerances": "--tolerance"}
            flag = flags.get(name, f"--{name.replace('_', '-')}")
            raise ValueError(f'{flag} was given for the {what} "{options.scene}"; expected it for {other}')
    validate_pass_options(options)
    if options.denoise:
        require_denoiser()
        options.filter = BOX
    has_frames = options.turntable or options.frames
    known = (*IMAGE_SUFFIXES, *(VIDEO_SUFFIXES if has_frames else ()))
    if options.output.suffix.lower() not in known:
        is_video = options.output.suffix.lower() in VIDEO_SUFFIXES
        more = ", or --turntable or --frames for a video" if is_video else ""
        raise ValueError(f'output "{options.output}"; expected a name ending in one of {", ".join(known)}{more}')
    if options.turntable and options.frames:
        raise ValueError("--turntable turns one model, --frames shows several; expected only one of them")
    if options.fps and options.output.suffix.lower() not in VIDEO_SUFFIXES:
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
    """Set search folders and log level by the options, and restore them afterwards."""
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


def _render_scene(options: argparse.Namespace) -> None:
    if options.scene.is_file():  # Otherwise loading refuses the scene, before a folder is made.
        require_writable(options.output, [options.scene])
    if wants_passes(options):
        render_by_passes(options)
        return
    loaded = load_scene(options.scene, dict(options.parameters), options.filter, options.sensor or 0)
    require_writable(options.output, loaded.file_paths)
    if loaded.scene.integrator() is None:  # Mitsuba would raise a bare Exception.
        raise ValueError(f'scene "{options.scene}" has no integrator; expected one')
    if options.output.suffix.lower() != ".exr" and loaded.scene.integrator().aov_names():
        raise ValueError(f'output "{options.output}"; expected a name ending in .exr, as the integrator has AOVs')
    _write_image(options, render_picture(options, [loaded], options.spp), options.output)


def _render_model(options: argparse.Namespace) -> None:
    if not options.frames:
        if not options.scene.is_file():
            hint = ", or --frames for a name of several files" if "%" in options.scene.name else ""
            raise FileNotFoundError(f'"{options.scene}": there is no such file; expected a model{hint}')
        require_writable(options.output, [options.scene])
    if wants_passes(options):
        render_by_passes(options, partial(load_still, as_data(options)))
        return
    if options.frames or options.turntable:
        _write_frames(options)
        return
    _, image = next(pictures(options, [1]))
    _write_image(options, image, options.output)


def _write_frames(options: argparse.Namespace) -> None:
    """Render the missing frames, and join all to a video if requested."""
    is_video = options.output.suffix.lower() in VIDEO_SUFFIXES
    if is_video:
        require_encoder(options.output)
    suffix = ".png" if is_video else options.output.suffix
    numbers = options.frames or range(1, options.turntable + 1)
    paths = {n: options.output.with_name(f"{options.output.stem}_{n:04d}{suffix}") for n in numbers}
    require_writable(next(iter(paths.values())))
    missing = [number for number, path in paths.items() if not path.is_file()]
    if len(missing) < len(paths):
        there = len(paths) - len(missing)
        print_remark(f"{there} of {len(paths)} frames exist and are kept; remove them to render them again")
    found = pictures(options, missing)
    for _ in counted(missing, "Frames"):
        number, image = next(found)
        _write_image(options, image, paths[number])
    if is_video:
        write_video(options.output, list(paths.values()), options.fps or DEFAULT_FPS)
        print_result(options.output)


def _write_image(options: argparse.Namespace, image: NDArray[np.float32], path: Path) -> None:
    with whole_file(path) as beside:
        in_8_bits = path.suffix.lower() in (".png", ".jpg")
        bitmap = mi.util.convert_to_bitmap(image, uint8_srgb=in_8_bits)
        if options.denoise:
            bitmap.metadata()[METADATA_ATTRIBUTE] = json.dumps({"denoised": True})
        bitmap.write(str(beside))
    print_result(path)


def _index(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f'"{text}"; expected an integer, 0 or more')
    return int(text)


def _fps(text: str) -> float:
    number = finite(text)
    if number <= 0:
        raise argparse.ArgumentTypeError(f'"{text}"; expected a number above 0')
    return number


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if not found or not all(map(int, found.groups())):
        raise argparse.ArgumentTypeError(f'"{text}"; expected width and height of 1 or more, such as 1280x720')
    return int(found[1]), int(found[2])


def _frame_range(text: str) -> range:
    found = re.fullmatch(r"(-?\d+):(-?\d+)(?::(\d+))?", text)
    step = int(found[3] or 1) if found else 0
    if not found or not step or int(found[1]) > int(found[2]):
        raise argparse.ArgumentTypeError(f'"{text}"; expected FIRST:LAST or FIRST:LAST:STEP, such as 1:24')
    return range(int(found[1]), int(found[2]) + 1, step)


def _assignment(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f'"{text}"; expected NAME=VALUE')
    return name, value


def require_encoder(path: Path) -> None:
    """Raise ValueError if a package that writes a video is missing, before frames are rendered."""
    try:
        import imageio.v2  # noqa: F401 - only to find out whether it is there

        if path.suffix.lower() == ".mp4":
            import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise ValueError(
            f'output "{path}": the package {error.name}, which writes videos, is missing; pip install '
            '"mitsuba-subdivision[video]", or name a .png file for frames only'
        ) from None


def write_video(
    path: Path,
    frames: Sequence[Path],  # PNG files of one size
    fps: float,  # Frames per second
) -> None:
    """Write images as a video, an animated GIF that repeats or an MP4 file."""
    import imageio.v2 as imageio

    # A GIF file repeats for ever, and its durations are milliseconds.
    is_gif = path.suffix.lower() == ".gif"
    settings: dict[str, Any] = {"duration": 1000 / fps, "loop": 0} if is_gif else {"fps": fps, "macro_block_size": EVEN}
    with whole_file(path) as beside:
        video: Any = imageio.get_writer(beside, **settings)
        with video:
            for frame in frames:
                pixels = imageio.imread(frame)[..., :3]
                height, width = (side if is_gif else side // EVEN * EVEN for side in pixels.shape[:2])
                video.append_data(pixels[:height, :width])
