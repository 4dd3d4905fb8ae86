"""The command ``figure``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..figures import FIGURES, FigureOptions, require_options
from ..messages import print_result
from ..schemes import SCHEME_CLASSES
from ..whole_file import require_folder, require_writable
from .arguments import add_variant, positive, set_variant
from .parser import table

if TYPE_CHECKING:
    from .parser import Commands

# Ignored by git: pictures of the pages lie beside it, in renders/figures, and another processor draws other last bits.
DRAWN = Path("renders/drawn")


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    figure = commands.add_parser(
        "figure",
        help="draw a figure of the documentation",
        description="Draw a figure of the documentation, or all. Options that do not change the figure are refused.",
        epilog=table("figures", {name: figure.shows for name, figure in FIGURES.items()}),
    )
    figure.add_argument("name", choices=[*FIGURES, "all"], metavar="NAME", help='a figure below, or "all"')
    figure.add_argument(
        "-o",
        "--output",
        type=Path,
        default=DRAWN,
        metavar="DIR",
        help="folder to write to (default: %(default)s)",
    )
    figure.add_argument(
        "--resolution", type=positive, metavar="N", help="width of a rendered image in pixels (default: 512)"
    )
    figure.add_argument("--spp", type=positive, metavar="N", help="samples per pixel (default: 256)")
    figure.add_argument(
        "--scheme",
        choices=list(SCHEME_CLASSES),
        metavar="SCHEME",
        help=f"one of {', '.join(SCHEME_CLASSES)} (default: catmull_clark)",
    )
    figure.add_argument(
        "--format",
        choices=FigureOptions.formats,
        action="append",
        dest="formats",
        metavar="FORMAT",
        help="png, pdf or exr; can be repeated (default: all that the figure has)",
    )
    add_variant(figure)
    figure.set_defaults(run=_figure, parser=figure)


def _figure(options: argparse.Namespace) -> None:
    given = {name: getattr(options, name) for name in ("resolution", "spp", "scheme") if getattr(options, name)}
    formats = tuple(options.formats or ())
    if options.name != "all":
        require_options(options.name, given, formats)
    require_folder(options.output)
    require_writable(options.output / f"{options.name}.png")
    set_variant(options.variant)
    if formats:
        given["formats"] = formats
    for name in _figures_of(options):
        for path in FIGURES[name](FigureOptions(options.output, **given)):
            print_result(path)


def _figures_of(options: argparse.Namespace) -> list[str]:
    """Names of the figures to draw. "all" leaves out those that another figure draws as well."""
    if options.name != "all":
        return [options.name]
    formats = set(options.formats or ["png"])
    return [name for name, figure in FIGURES.items() if not figure.drawn_with and formats & set(figure.formats)]
