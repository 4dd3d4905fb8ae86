"""The command line: ``mitsuba-subdivision`` or ``python -m mitsuba_subdivision``."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import __version__
from .cage import CageWarning
from .figures.command_line import add_command as add_figure_command
from .interruption import Abandoned, interruptible
from .messages import PROGRAM, USER_ERRORS, flushed_output, tell, tell_aside, tell_error, told_warnings
from .progress import wipe
from .regression.command_line import add_commands, table
from .studio.command_line import add_cage_options
from .studio.command_line import add_command as add_render_command
from .whole_file import remove_unfinished, require_writable

if TYPE_CHECKING:
    from .surface import LimitSurface

INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status; after Ctrl-C, end the process if its work cannot be stopped."""
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
        prog=PROGRAM,
        description="Exact subdivision surfaces for Mitsuba 3.",
        formatter_class=_HelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.set_defaults(error_status=1)
    commands = parser.add_subparsers(required=True, metavar="COMMAND", help="a command below")
    summaries = {}

    def add_parser(name: str, summary: str, **options: Any) -> argparse.ArgumentParser:
        summaries[name] = summary
        return commands.add_parser(name, formatter_class=_HelpFormatter, **options)

    add_figure_command(add_parser)
    add_render_command(add_parser, _stages)
    _add_info(add_parser)
    _add_tessellate(add_parser)
    add_commands(add_parser)
    _add_doctor(add_parser)
    parser.epilog = f'{table("commands", summaries)}\n\n"{PROGRAM} COMMAND --help" describes a command.'
    return parser


def _stages() -> Any:
    """The module that `render` shows whole USD files with; it loads Mitsuba."""
    from .usd import films

    return films


class _HelpFormatter(argparse.HelpFormatter):
    """Help with a wide column of options. Texts may have paragraphs, and tables, which keep their lines."""

    def __init__(self, prog: str, **options: Any) -> None:
        super().__init__(prog, **{"max_help_position": 28, **options})

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = text.split("\n\n")
        return "\n\n".join(
            p if "\n" in p else super(_HelpFormatter, self)._fill_text(p, width, indent) for p in paragraphs
        )


def _add_info(add_parser: Callable[..., argparse.ArgumentParser]) -> None:
    info = add_parser(
        "info",
        "describe a control cage",
        description="Describe a control cage: what it is made of, what its surface costs, and what about the surface "
        "will look odd.",
    )
    _add_cage(info)
    info.add_argument("--json", action="store_true", help="print JSON")
    info.set_defaults(run=_info)


def _add_tessellate(add_parser: Callable[..., argparse.ArgumentParser]) -> None:
    tessellate = add_parser(
        "tessellate",
        "write a limit surface as triangles",
        description="Write triangles on the limit surface of a control cage, with exact points and normals.",
    )
    _add_cage(tessellate)
    tessellate.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help=".obj, .ply, .usd, .usda or .usdc file to write",
    )
    tessellate.set_defaults(run=_tessellate)


def _add_doctor(add_parser: Callable[..., argparse.ArgumentParser]) -> None:
    doctor = add_parser(
        "doctor",
        "tell what works on this machine",
        description="Tell versions, libraries and which variants of Mitsuba render here, each in a process of its own. "
        "The exit status is 1 if something that should work does not.",
    )
    doctor.add_argument("--json", action="store_true", help="print JSON")
    doctor.set_defaults(run=_doctor)


def _add_cage(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("cage", type=Path, metavar="CAGE", help="control cage: an OBJ, PLY or USD file")
    add_cage_options(parser, "%(default)s")
    parser.set_defaults(rate=8)


def _surface(options: argparse.Namespace) -> LimitSurface:
    from .cage import ControlCage
    from .surface import LimitSurface

    rules = {"scheme": options.scheme} if options.scheme else {}
    return LimitSurface(ControlCage.from_file(options.cage, prim=options.prim, time=options.time, **rules))


def _info(options: argparse.Namespace) -> None:
    from .inspection import inspect

    found = inspect(_surface(options), options.rate)
    # Without the quotes that names of files have in messages.
    plain = dataclasses.replace(found, name=found.name.replace('"', ""))
    tell(json.dumps(dataclasses.asdict(plain), indent=1) if options.json else found)


def _doctor(options: argparse.Namespace) -> int:
    from .doctor import diagnose

    found = diagnose()
    tell(found.as_json() if options.json else found)
    return 0 if found.healthy else 1


def _tessellate(options: argparse.Namespace) -> None:
    from .files.triangle_writer import require_format

    require_format(options.output)
    surface = _surface(options)
    require_writable(options.output, [options.cage])
    triangles = surface.tessellate(options.rate)
    triangles.save(options.output)
    tell(f"{options.output}: {len(triangles.triangles)} triangles, {len(triangles.positions)} vertices")


if __name__ == "__main__":
    sys.exit(main())
