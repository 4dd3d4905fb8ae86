"""The command line: ``mitsuba-subdivision`` or ``python -m mitsuba_subdivision``."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from . import __version__
from .cage import CageWarning
from .llvm import best_variant
from .messages import PROGRAM, USER_ERRORS, tell_error, told_warnings
from .regression.command_line import add_commands, add_render_options, positive, render_by_passes, wants_passes
from .whole_file import whole_file

if TYPE_CHECKING:
    from .surface import LimitSurface

# Those of `figures.FIGURES`, which takes Mitsuba to import.
FIGURE_NAMES = (
    "subdivision",
    "refinement",
    "domains",
    "artifact",
    "error",
    "schemes",
    "creases",
    "zoom",
    "zebra",
    "curvature",
    "hero",
)
# Of the shape; memory ends long before that.
HIGHEST_RATE = 1024


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    options = _parser().parse_args(arguments)
    try:
        with told_warnings(CageWarning):
            return options.run(options) or 0
    except USER_ERRORS as error:
        tell_error(error)
        return 1
    except KeyboardInterrupt:
        print(f"{PROGRAM}: interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM, description="Exact subdivision surfaces for Mitsuba 3.", allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    figure = commands.add_parser("figure", help="draw a figure", description="Draw a figure of the documentation.")
    figure.add_argument("name", choices=[*FIGURE_NAMES, "all"], help="which figure")
    figure.add_argument(
        "-o", "--output", type=Path, default=Path("renders/figures"), help="folder to write to (default: %(default)s)"
    )
    figure.add_argument("--resolution", type=positive, default=512, help="width of a picture (default: %(default)s)")
    figure.add_argument("--spp", type=positive, default=256, help="samples per pixel (default: %(default)s)")
    figure.add_argument(
        "--scheme",
        choices=["catmull_clark", "doo_sabin", "loop"],
        default="catmull_clark",
        help="scheme of the figures artifact and domains (default: %(default)s)",
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
    render.add_argument("--seed", type=int, default=0, help="seed of the samples (default: %(default)s)")
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
    tessellate.add_argument("-o", "--output", type=Path, required=True, help=".ply, .usd, .usda or .usdc file to write")
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


def _assignment(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f'"{text}"; expected NAME=VALUE')
    return name, value


def _set_variant(name: str | None) -> None:
    import mitsuba as mi

    name = name or best_variant()
    if name not in mi.variants():
        raise ValueError(f'unknown variant "{name}"; expected one of {", ".join(mi.variants())}')
    mi.set_variant(name)


def _figure(options: argparse.Namespace) -> None:
    _set_variant(options.variant)
    from .figures import FIGURES, FigureOptions

    formats = tuple(options.formats or FigureOptions.formats)
    given = FigureOptions(options.output, options.resolution, options.spp, formats, options.scheme)
    # The error against level comes with the artifact.
    for name in (name for name in FIGURES if name != "error") if options.name == "all" else [options.name]:
        for path in FIGURES[name](given):
            print(path)


def _surface(options: argparse.Namespace) -> LimitSurface:
    from .cage import ControlCage
    from .surface import LimitSurface

    rules = {"scheme": options.scheme} if options.scheme else {}
    return LimitSurface(ControlCage.from_file(options.cage, prim=options.prim, time=options.time, **rules))


def _info(options: argparse.Namespace) -> None:
    from .inspection import inspect

    found = inspect(_surface(options), options.rate)
    print(json.dumps(dataclasses.asdict(found), indent=1) if options.json else found)


def _tessellate(options: argparse.Namespace) -> None:
    from .tessellation.writers import require_format

    require_format(options.output)
    triangles = _surface(options).tessellate(options.rate)
    triangles.save(options.output)
    print(f"{options.output}: {len(triangles.triangles)} triangles, {len(triangles.positions)} vertices")


def _render(options: argparse.Namespace) -> None:
    _set_variant(options.variant)
    import mitsuba as mi

    from .regression.scene import load_scene

    suffixes = (".exr", ".png", ".jpg", ".hdr")
    if options.output.suffix not in suffixes:
        raise ValueError(f'output "{options.output}"; expected a name ending in one of {", ".join(suffixes)}')
    if wants_passes(options):
        render_by_passes(options)
        return
    scene = load_scene(options.scene, dict(options.parameters)).scene
    if scene.integrator() is None:  # Mitsuba raises a bare Exception.
        raise ValueError(f'scene "{options.scene}" has no integrator; expected one')
    picture = mi.render(scene, spp=options.spp or 0, seed=options.seed)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(options.output) as beside:
        mi.util.write_bitmap(str(beside), picture, write_async=False)
    print(options.output)


if __name__ == "__main__":
    sys.exit(main())
