"""The command ``figure``."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..figures import FIGURES, FigureOptions, require_options
from ..figures.output import COLUMN, INCH, PAGE
from ..messages import print_result
from ..schemes import BUILT_IN
from ..variants import set_variant
from ..whole_file import require_folder, require_writable
from .arguments import CommandParser, add_variant, checked, positive, table

# Ignored by git. The pictures of the pages are in renders/figures, as other processors draw other last bits.
DRAWN = Path("renders/drawn")
WIDEST = 1200.0  # Millimetres, for posters


def figure(parser: CommandParser) -> None:
    """Add the options of ``figure``."""
    parser.description = "Draw a figure of the documentation, or all. Options without effect on it are refused."
    parser.epilog = table("figures", {name: figure.shows for name, figure in FIGURES.items()})
    add = parser.add_argument
    add("name", choices=[*FIGURES, "all"], metavar="NAME", help='a figure below, or "all"')
    add("-o", "--output", type=Path, default=DRAWN, metavar="DIR", help="folder to write to (default: %(default)s)")
    add("--resolution", type=positive, metavar="N", help="width of a panel in pixels (default: 512)")
    add("--spp", type=positive, metavar="N", help="samples per pixel (default: 256, or 32 for artifact)")
    text = f"width on paper, as 84mm or 7in (default: {PAGE:g}mm, or {COLUMN:g}mm for figures of a column)"
    add("--width", type=_width, metavar="LENGTH", help=text)
    add("--scheme", choices=BUILT_IN, metavar="SCHEME", help=f"one of {', '.join(BUILT_IN)} (default: catmull_clark)")
    takers = ", ".join(name for name, figure in FIGURES.items() if "cage" in figure.options)
    add("--cage", type=Path, metavar="FILE", help=f"a Catmull-Clark cage of your own, for {takers}")
    text = "png, pdf, exr or csv; can be repeated (default: all that the figure has)"
    add("--format", choices=FigureOptions.formats, action="append", dest="formats", metavar="FORMAT", help=text)
    add_variant(parser)
    parser.set_defaults(run=_figure)


def _figure(options: argparse.Namespace) -> None:
    names = ("resolution", "spp", "width", "scheme", "cage")
    given = {name: getattr(options, name) for name in names if getattr(options, name)}
    formats = tuple(options.formats or ())
    if options.name != "all":
        require_options(options.name, given, formats)
    require_folder(options.output)
    require_writable(options.output / f"{options.name}.png")
    set_variant(options.variant)
    if formats:
        given["formats"] = formats
    wanted = set(formats or ["png"])
    for name, figure in FIGURES.items():
        takes_all = bool(wanted & set(figure.formats)) and (not options.cage or "cage" in figure.options)
        if options.name == name or (options.name == "all" and takes_all):
            for path in figure(FigureOptions(options.output, **{"width": figure.width, "spp": figure.spp, **given})):
                print_result(path)


def _millimetres(text: str) -> float:
    return INCH * float(text.removesuffix("in")) if text.endswith("in") else float(text.removesuffix("mm"))


_width = checked(
    _millimetres, lambda width: COLUMN <= width <= WIDEST, f"a width from {COLUMN:g}mm to {WIDEST:g}mm, or in inches"
)
