"""The commands ``info`` and ``tessellate`` for control cages in files, and ``doctor`` for the machine."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ..cage import ControlCage
from ..files.formats import FORMATS, require_triangle_format
from ..messages import print_result
from ..surface import LimitSurface
from ..whole_file import require_writable
from .arguments import CommandParser, add_cage_options


def info(parser: CommandParser) -> None:
    """Add the options of ``info``."""
    parser.description = "Describe a control cage: its elements, the cost of its surface, and visible defects."
    _add_cage(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=_info)


def tessellate(parser: CommandParser) -> None:
    """Add the options of ``tessellate``."""
    parser.description = "Write triangles on the limit surface of a control cage, with exact points and normals."
    _add_cage(parser)
    *others, last = (suffix for suffix, known in FORMATS.items() if known.write_triangles)
    text = f"{', '.join(others)} or {last} file to write"
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=text)
    parser.set_defaults(run=_tessellate)


def doctor(parser: CommandParser) -> None:
    """Add the options of ``doctor``."""
    parser.description = (
        "Print the versions of libraries, and test which variants of Mitsuba render here, each in a process of its "
        "own. The exit status is 1 if a variant fails that this machine should support."
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=_doctor)


def _add_cage(parser: CommandParser) -> None:
    parser.add_argument("cage", type=Path, metavar="CAGE", help="control cage: an OBJ, PLY or USD file")
    add_cage_options(parser, "%(default)s")
    parser.set_defaults(rate=8)


def _surface(options: argparse.Namespace) -> LimitSurface:
    rules = {"scheme": options.scheme} if options.scheme else {}
    return LimitSurface(ControlCage.from_file(options.cage, prim=options.prim, time=options.time, **rules))


def _info(options: argparse.Namespace) -> None:
    from ..inspection import in_words, inspect

    inspected = inspect(_surface(options), options.rate)
    # Without the quotes around file names in messages.
    plain = {**inspected, "name": inspected["name"].replace('"', "")}
    print_result(json.dumps(plain, indent=1) if options.json else in_words(inspected))


def _tessellate(options: argparse.Namespace) -> None:
    require_triangle_format(options.output)
    surface = _surface(options)
    require_writable(options.output, [options.cage])
    triangles = surface.tessellate(options.rate)
    triangles.save(options.output)
    print_result(f"{options.output}: {len(triangles.triangles)} triangles, {len(triangles.positions)} vertices")


def _doctor(options: argparse.Namespace) -> int:
    from ..doctor import diagnose, in_words

    diagnosis = diagnose()
    print_result(json.dumps(diagnosis, indent=1) if options.json else in_words(diagnosis))
    return 0 if diagnosis["healthy"] else 1
