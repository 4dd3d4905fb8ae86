"""The parser of the whole command line."""

from __future__ import annotations

import argparse

from .. import __version__
from ..messages import PROGRAM
from . import cage, compare, doctor, figure, render
from .arguments import CommandParser


def parser() -> CommandParser:
    """The parser of the whole command line."""
    program = CommandParser(
        prog=PROGRAM,
        description="Exact subdivision surfaces for Mitsuba 3.",
        allow_abbrev=False,
        epilog=f'"{PROGRAM} COMMAND --help" describes a command.',
    )
    program.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    program.set_defaults(error_status=1)
    commands = program.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for module in (figure, render, cage, compare, doctor):
        module.add_parser(commands)
    return program


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """The options of a command line, or of this process.

    Raises
    ------
    SystemExit
        If they are wrong, or ask for help or the version.
    """
    program = parser()
    options, unknown = program.parse_known_args(arguments)
    if unknown:
        # The command's own parser reports them, with its usage and exit status.
        options.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    return options
