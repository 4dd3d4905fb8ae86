"""The command ``render``: Mitsuba scenes, and models in the studio."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..files.formats import FORMATS
from ..messages import counted, print_remark, print_result
from ..regression.image import METADATA_ATTRIBUTE
from ..regression.scene import BOX, kept_search_folders, load_scene
from ..shapes.parameter_table import SHADINGS
from ..studio.picture import require_denoiser
from ..studio.studio_entries import DEFAULT_VIEW, UP_AXES, VIEWS
from ..variants import set_variant
from ..whole_file import require_writable, whole_file
from .arguments import CommandParser, above_zero, add_cage_options, add_variant, finite, index, positive, seed
from .compare import TOLERANCES, add_tolerances
from .pictures import pictures, render_by_passes, render_picture

IMAGE_SUFFIXES = (".exr", ".png", ".jpg", ".hdr")
VIDEO_SUFFIXES = (".gif", ".mp4")
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
# Sides of the pictures in an MP4 file are multiples of this; others lose a row or a column.
EVEN = 2


def render(parser: CommandParser) -> None:
    """Add the options of ``render``."""
    parser.description = (
        "Render a Mitsuba scene, which may have subdivision shapes; or a model, an OBJ, PLY or USD file, in a neutral "
        "studio."
    )
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
    _add_model_options(parser.add_argument_group("models"))
    text = (
        "Frames are written as NAME_0001.png and so on. Existing frames are kept, so that an interrupted command can "
    )
    _add_frame_options(parser.add_argument_group("frames of models", f"{text}be repeated."))
    add("--filter", help='reconstruction filter instead of the scene\'s; "box" is deterministic')
    text = "The image is an OpenEXR file with the variance and the number of samples of each pixel."
    _add_pass_options(parser.add_argument_group("rendering by passes", text))
    parser.set_defaults(run=_render)


def _add_model_options(group: argparse._ArgumentGroup) -> None:
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


def _add_frame_options(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--turntable", type=positive, metavar="N", help="turn the model around once, in N frames")
    text = "times of a USD file, or numbers of files whose name has %%04d in it"
    add("--frames", type=_frame_range, metavar="FIRST:LAST[:STEP]", help=text)
    text = "motion blur of a USD file: mean of N times while the shutter of its camera is open (default: none)"
    add("--shutter", type=positive, metavar="N", help=text)
    add("--fps", type=above_zero, metavar="N", help=f"frames per second of a video (default: {DEFAULT_FPS})")


def _add_pass_options(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--pass", dest="share", type=_share, metavar="I/N", help='render only pass I of N; "merge" puts them together')
    add("--passes", type=positive, metavar="N", help="render N passes one after the other, and merge")
    text = "render the passes, or the frames of a model, on the Dask cluster of this scheduler"
    add("--dask", metavar="ADDRESS", help=text)
    add("--batch", type=positive, metavar="N", help="samples per pixel that are rendered with one seed (default: 64)")
    text = 'write a reference for "compare": with the box filter, geometry AOVs and tolerances'
    add("--reference", action="store_true", help=text)
    add_tolerances(group, "tolerance to store with the reference; can be repeated")


def _render(options: argparse.Namespace) -> None:
    suffix = options.scene.suffix.lower()
    is_model = suffix in FORMATS
    if not is_model and suffix != SCENE_SUFFIX and not options.scene.is_file():
        expected = f"a Mitsuba scene ({SCENE_SUFFIX}) or a model ({', '.join(FORMATS)})"
        raise ValueError(f'"{options.scene}" is not a file; expected {expected}')
    # A worker of a cluster renders a frame as a whole.
    on_cluster = options.dask and not (options.frames or options.turntable or options.shutter)
    by_passes = bool(options.share or options.passes or options.reference or on_cluster)
    _validate(options, is_model)
    _validate_passes(options, by_passes)
    if options.denoise:
        require_denoiser()
        options.filter = BOX
    _validate_output(options)
    set_variant(options.variant)
    with _settings(options):
        (_render_model if is_model else _render_scene)(options, by_passes)


def _validate(options: argparse.Namespace, is_model: bool) -> None:
    """Refuse options that have no effect with this input."""
    what, useless = ("model", _OF_SCENES) if is_model else ("scene", (*_OF_MODELS, *_OF_FRAMES, "save_scene"))
    other = "a Mitsuba scene, which --save-scene writes" if is_model else "a model"
    for name in useless:
        given = getattr(options, name)
        # An angle or a sensor may be 0.
        if given is not None and given is not False and given != []:
            flags = {"parameters": "-D", "share": "--pass", "tolerances": "--tolerance"}
            flag = flags.get(name, f"--{name.replace('_', '-')}")
            raise ValueError(f'{flag} was given for the {what} "{options.scene}"; expected it for {other}')


def _validate_passes(options: argparse.Namespace, by_passes: bool) -> None:
    """Refuse options for passes that contradict each other, or have no effect with the others."""
    has_other_filter = options.filter not in (None, BOX)
    all_options = "--pass, --passes, --dask or --reference"
    if by_passes and options.output.suffix.lower() != ".exr":
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
    if options.sensor and by_passes:
        raise ValueError(f"--sensor is for whole images; expected no {all_options} beside it")
    if options.batch and not by_passes:
        raise ValueError(f"--batch is for passes; expected {all_options} beside it")
    if options.tolerances and not options.reference:
        raise ValueError("--tolerance is stored with a reference; expected --reference beside it")


def _validate_output(options: argparse.Namespace) -> None:
    """Refuse outputs of an unknown kind, and options for frames that contradict each other."""
    suffix, has_frames = options.output.suffix.lower(), options.turntable or options.frames
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


def _render_scene(options: argparse.Namespace, by_passes: bool) -> None:
    if options.scene.is_file():  # Otherwise loading refuses the scene, before a folder is made.
        require_writable(options.output, [options.scene])
    if by_passes:
        render_by_passes(options)
        return
    loaded = load_scene(options.scene, dict(options.parameters), options.filter, options.sensor or 0)
    require_writable(options.output, loaded.file_paths)
    if loaded.scene.integrator() is None:  # Mitsuba would raise a bare Exception.
        raise ValueError(f'scene "{options.scene}" has no integrator; expected one')
    if options.output.suffix.lower() != ".exr" and loaded.scene.integrator().aov_names():
        raise ValueError(f'output "{options.output}"; expected a name ending in .exr, as the integrator has AOVs')
    _write_image(options, render_picture(options, [loaded], options.spp), options.output)


def _render_model(options: argparse.Namespace, by_passes: bool) -> None:
    if not options.frames:
        if not options.scene.is_file():
            hint = ", or --frames for a name of several files" if "%" in options.scene.name else ""
            raise FileNotFoundError(f'"{options.scene}": there is no such file; expected a model{hint}')
        require_writable(options.output, [options.scene])
    if by_passes:
        render_by_passes(options, is_model=True)
    elif options.frames or options.turntable:
        _write_frames(options)
    else:
        _, image = next(pictures(options, [1]))
        _write_image(options, image, options.output)


def _write_frames(options: argparse.Namespace) -> None:
    """Render the missing frames, and join all to a video if requested."""
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
    rendered = pictures(options, missing)
    for _ in counted(missing, "Frames"):
        number, image = next(rendered)
        _write_image(options, image, paths[number])
    if is_video:
        _write_video(options.output, list(paths.values()), options.fps or DEFAULT_FPS)
        print_result(options.output)


def _write_image(options: argparse.Namespace, image: NDArray[np.float32], path: Path) -> None:
    with whole_file(path) as beside:
        in_8_bits = path.suffix.lower() in (".png", ".jpg")
        bitmap = mi.util.convert_to_bitmap(image, uint8_srgb=in_8_bits)
        if options.denoise:
            bitmap.metadata()[METADATA_ATTRIBUTE] = json.dumps({"denoised": True})
        bitmap.write(str(beside))
    print_result(path)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if not match or not all(map(int, match.groups())):
        raise argparse.ArgumentTypeError(f'"{text}"; expected width and height of 1 or more, such as 1280x720')
    return int(match[1]), int(match[2])


def _frame_range(text: str) -> range:
    match = re.fullmatch(r"(-?\d+):(-?\d+)(?::(\d+))?", text)
    step = int(match[3] or 1) if match else 0
    if not match or not step or int(match[1]) > int(match[2]):
        raise argparse.ArgumentTypeError(f'"{text}"; expected FIRST:LAST or FIRST:LAST:STEP, such as 1:24')
    return range(int(match[1]), int(match[2]) + 1, step)


def _assignment(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f'"{text}"; expected NAME=VALUE')
    return name, value


def _share(text: str) -> tuple[int, int]:
    number, _, count = text.partition("/")
    if not (number.isdigit() and count.isdigit() and 1 <= int(number) <= int(count)):
        raise argparse.ArgumentTypeError(f'"{text}"; expected I/N with I from 1 to N, such as 2/8')
    return int(number), int(count)


def _require_encoder(path: Path) -> None:
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


def _write_video(path: Path, frames: Sequence[Path], fps: float) -> None:
    """Write PNG files of one size as a video, an animated GIF that repeats or an MP4 file."""
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
