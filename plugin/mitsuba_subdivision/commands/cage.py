"""The commands ``info`` and ``tessellate``, about a control cage in a file."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

from ..cage import ControlCage
from ..messages import print_result
from ..surface import LimitSurface
from ..whole_file import require_writable
from .arguments import Commands, add_cage_options


def add_parser(commands: Commands) -> None:
    """Add the commands to the program."""
    info = commands.add_parser(
        "info",
        help="describe a control cage",
        description="Describe a control cage: its elements, the cost of its limit surface, and defects that will be "
        "visible on the surface.",
    )
    _add_cage(info)
    info.add_argument("--json", action="store_true", help="print JSON")
    info.set_defaults(run=_info, parser=info)
    tessellate = commands.add_parser(
        "tessellate",
        help="write a limit surface as triangles",
        description="Write triangles on the limit surface of a control cage, with exact points and normals.",
    )
    _add_cage(tessellate)
    text = ".obj, .ply, .usd, .usda or .usdc file to write"
    tessellate.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=text)
    tessellate.set_defaults(run=_tessellate, parser=tessellate)


def _add_cage(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("cage", type=Path, metavar="CAGE", help="control cage: an OBJ, PLY or USD file")
    add_cage_options(parser, "%(default)s")
    parser.set_defaults(rate=8)


def _surface(options: argparse.Namespace) -> LimitSurface:
    rules = {"scheme": options.scheme} if options.scheme else {}
    return LimitSurface(ControlCage.from_file(options.cage, prim=options.prim, time=options.time, **rules))


def _info(options: argparse.Namespace) -> None:
    from ..inspection import inspect

    found = inspect(_surface(options), options.rate)
    # Without the quotes that names of files have in messages.
    plain = dataclasses.replace(found, name=found.name.replace('"', ""))
    print_result(json.dumps(dataclasses.asdict(plain), indent=1) if options.json else found)


def _tessellate(options: argparse.Namespace) -> None:
    from ..files.formats import require_triangle_format

    require_triangle_format(options.output)
    surface = _surface(options)
    require_writable(options.output, [options.cage])
    triangles = surface.tessellate(options.rate)
    triangles.save(options.output)
    print_result(f"{options.output}: {len(triangles.triangles)} triangles, {len(triangles.positions)} vertices")
