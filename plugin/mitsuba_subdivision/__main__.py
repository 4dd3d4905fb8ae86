"""The command line: ``mitsuba-subdivision`` or ``python -m mitsuba_subdivision``."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from . import __version__
from .cage import CageWarning
from .interruption import Abandoned, interruptible
from .llvm import best_variant
from .messages import PROGRAM, USER_ERRORS, flushed_output, tell, tell_aside, tell_error, told_warnings
from .progress import wipe
from .regression.command_line import (
    add_commands,
    add_render_options,
    check_render_options,
    positive,
    render_by_passes,
    wants_passes,
)
from .whole_file import remove_unfinished, require_folder, require_writable, whole_file

if TYPE_CHECKING:
    from .surface import LimitSurface

# Those of `figures.FIGURES`, which takes Mitsuba to import: the options that each heeds, and its file formats.
FIGURE_OPTIONS = {
    "subdivision": ("resolution spp", "png pdf exr"),
    "refinement": ("", "png pdf"),
    "domains": ("scheme", "png pdf"),
    "artifact": ("resolution spp scheme", "png pdf exr"),
    "error": ("", "png pdf"),
    "schemes": ("resolution spp", "png exr"),
    "creases": ("resolution spp", "png exr"),
    "zoom": ("resolution spp", "png pdf exr"),
    "zebra": ("resolution spp", "png pdf exr"),
    "curvature": ("resolution", "png pdf"),
    "hero": ("resolution spp", "png exr"),
}
PICTURES = (".exr", ".png", ".jpg", ".hdr")
INTERRUPTED = 130
# Of the shape; memory ends long before that.
HIGHEST_RATE = 1024


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status, unless Ctrl-C leaves work behind that only the process's end stops."""
    with flushed_output():
        try:
            options = _parser().parse_args(arguments)
            try:
                with told_warnings(CageWarning):
                    return interruptible(lambda: options.run(options)) or 0
            except USER_ERRORS as error:
                tell_error(error)
                return options.error_status
        except KeyboardInterrupt as stop:
            return _interrupted(stop)


def _interrupted(stop: KeyboardInterrupt) -> int:
    is_abandoned = isinstance(stop, Abandoned)
    if is_abandoned:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        remove_unfinished()
        wipe()
    tell_aside("interrupted")
    if is_abandoned:
        os._exit(INTERRUPTED)
    return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM, description="Exact subdivision surfaces for Mitsuba 3.", allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.set_defaults(error_status=1)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    figure = commands.add_parser("figure", help="draw a figure", description="Draw a figure of the documentation.")
    figure.add_argument("name", choices=[*FIGURE_OPTIONS, "all"], help="which figure")
    figure.add_argument(
        "-o", "--output", type=Path, default=Path("renders/figures"), help="folder to write to (default: %(default)s)"
    )
    figure.add_argument("--resolution", type=positive, help="width of a picture (default: 512)")
    figure.add_argument("--spp", type=positive, help="samples per pixel (default: 256)")
    figure.add_argument(
        "--scheme",
        choices=["catmull_clark", "doo_sabin", "loop"],
        help="scheme of the figures artifact and domains (default: catmull_clark)",
    )
    figure.add_argument(
        "--format",
        choices=["png", "pdf", "exr"],
        action="append",
        dest="formats",
        help="file format, can be given again (default: all that the figure has)",
    )
    figure.set_defaults(run=_figure)

    render = commands.add_parser(
        "render", help="render a scene", description="Render a Mitsuba scene that may have subdivision shapes."
    )
    render.add_argument("scene", type=Path, help="Mitsuba scene, an XML file")
    render.add_argument("-o", "--output", type=Path, required=True, help="picture to write: .exr, .png, .jpg or .hdr")
    render.add_argument("--spp", type=positive, help="samples per pixel (default: the scene's)")
    render.add_argument("--seed", type=_seed, default=0, help="seed of the samples (default: %(default)s)")
    render.add_argument(
        "-D",
        dest="parameters",
        metavar="NAME=VALUE",
        type=_assignment,
        action="append",
        default=[],
        help="value of a scene parameter",
    )
    add_render_options(render)
    render.set_defaults(run=_render)
    info = commands.add_parser(
        "info",
        help="say what a control cage is made of",
        description="Say what a control cage is made of, what its surface costs, and what about it will look odd.",
    )
    info.add_argument("--json", action="store_true", help="print JSON")
    info.set_defaults(run=_info)

    tessellate = commands.add_parser(
        "tessellate",
        help="make triangles of a cage",
        description="Write triangles on the limit surface of a control cage, with exact points and normals.",
    )
    tessellate.add_argument(
        "-o", "--output", type=Path, required=True, help=".obj, .ply, .usd, .usda or .usdc file to write"
    )
    tessellate.set_defaults(run=_tessellate)
    add_commands(commands)

    for command in (info, tessellate):
        command.add_argument("cage", type=Path, help="control cage: an OBJ, PLY or USD file")
        command.add_argument("--scheme", help="catmull_clark, doo_sabin or loop (default: the file's or catmull_clark)")
        command.add_argument("--prim", help="for a USD file with several meshes, the path of one, or * for all")
        command.add_argument("--time", type=float, help="for a USD file, a time code (default: the first)")
        command.add_argument("--rate", type=_rate, default=8, help="segments per edge (default: %(default)s)")
    for command in (figure, render):
        command.add_argument("--variant", help="Mitsuba variant (default: llvm_ad_rgb where it works, else scalar_rgb)")
    return parser


def _rate(text: str) -> int:
    number = positive(text)
    if number > HIGHEST_RATE:
        raise argparse.ArgumentTypeError(f"{number}; expected {HIGHEST_RATE} or less")
    return number


def _seed(text: str) -> int:
    if not (text.isdecimal() and int(text) < 2**32):
        raise argparse.ArgumentTypeError(f'"{text}"; expected an integer from 0 to {2**32 - 1}')
    return int(text)


def _assignment(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f'"{text}"; expected NAME=VALUE')
    return name, value


def _set_variant(name: str | None) -> None:
    import mitsuba as mi

    from .regression.environment import variant_problem

    problem = variant_problem(name) if name else None
    if problem:
        raise ValueError(problem)
    mi.set_variant(name or best_variant())


def _figure(options: argparse.Namespace) -> None:
    heeded, formats = (set(words.split()) for words in FIGURE_OPTIONS.get(options.name, ("resolution spp scheme", "")))
    if options.name == "artifact" and options.scheme not in (None, "catmull_clark"):
        # It comes without the plot of errors.
        formats.remove("pdf")
    given = {name: getattr(options, name) for name in ("resolution", "spp", "scheme") if getattr(options, name)}
    for name in given:
        if name not in heeded:
            raise ValueError(f'--{name} does nothing for the figure "{options.name}"; expected it left out')
    for name in options.formats or ():
        if formats and name not in formats:
            expected = " or ".join(sorted(formats))
            raise ValueError(f'the figure "{options.name}" is not drawn as {name}; expected {expected}')
    require_folder(options.output)
    require_writable(options.output / f"{options.name}.png")
    _set_variant(options.variant)
    from .figures import FIGURES, FigureOptions

    if options.formats:
        given["formats"] = tuple(options.formats)
    for name in _figures_of(options):
        for path in FIGURES[name](FigureOptions(options.output, **given)):
            tell(path)


def _figures_of(options: argparse.Namespace) -> list[str]:
    if options.name != "all":
        return [options.name]
    # The error against level comes with the artifact.
    wanted = [name for name in FIGURE_OPTIONS if name != "error"]
    return [name for name in wanted if {*FIGURE_OPTIONS[name][1].split()} & {*(options.formats or ["png"])}]


def _surface(options: argparse.Namespace) -> LimitSurface:
    from .cage import ControlCage
    from .surface import LimitSurface

    rules = {"scheme": options.scheme} if options.scheme else {}
    return LimitSurface(ControlCage.from_file(options.cage, prim=options.prim, time=options.time, **rules))


def _info(options: argparse.Namespace) -> None:
    from .inspection import inspect

    found = inspect(_surface(options), options.rate)
    # Messages have names in quotes.
    plain = dataclasses.replace(found, name=found.name.replace('"', ""))
    tell(json.dumps(dataclasses.asdict(plain), indent=1) if options.json else found)


def _tessellate(options: argparse.Namespace) -> None:
    from .files.triangle_writer import require_format

    require_format(options.output)
    surface = _surface(options)
    require_writable(options.output, [options.cage])
    triangles = surface.tessellate(options.rate)
    triangles.save(options.output)
    tell(f"{options.output}: {len(triangles.triangles)} triangles, {len(triangles.positions)} vertices")


def _render(options: argparse.Namespace) -> None:
    check_render_options(options)
    suffix = options.output.suffix.lower()
    if suffix not in PICTURES:
        raise ValueError(f'output "{options.output}"; expected a name ending in one of {", ".join(PICTURES)}')
    _set_variant(options.variant)
    import mitsuba as mi

    from .regression.scene import load_scene
    from .regression.whole_picture import render_whole

    if options.scene.is_file():  # Else loading says so, and no folder is made.
        require_writable(options.output, [options.scene])
    if wants_passes(options):
        render_by_passes(options)
        return
    loaded = load_scene(options.scene, dict(options.parameters), options.filter)
    require_writable(options.output, loaded.file_paths)
    if loaded.scene.integrator() is None:  # Mitsuba raises a bare Exception.
        raise ValueError(f'scene "{options.scene}" has no integrator; expected one')
    if suffix != ".exr" and loaded.scene.integrator().aov_names():
        raise ValueError(f'output "{options.output}"; expected a name ending in .exr, which has room for more channels')
    picture = render_whole(loaded, options.spp or loaded.sensor.sampler().sample_count(), options.seed)
    with whole_file(options.output) as beside:
        mi.util.convert_to_bitmap(picture, uint8_srgb=suffix in (".png", ".jpg")).write(str(beside))
    tell(options.output)


if __name__ == "__main__":
    sys.exit(main())
