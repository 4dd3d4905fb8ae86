"""The commands of ``mitsuba-subdivision``, and the parser of the command line.

A new command is a line of `COMMANDS` and a function that adds options to the command's parser. It sets the default
``run`` to a function of the parsed options that returns the exit status.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Sequence

from .. import __version__
from ..messages import PROGRAM
from .arguments import CommandParser

# ``module:function`` of this package, and a line of help. Only the module of the given command is imported.
COMMANDS = {
    "figure": ("figure:figure", "draw a figure of the documentation"),
    "render": ("render:render", "render a scene, or a model in a studio"),
    "info": ("info:info", "describe a control cage"),
    "tessellate": ("info:tessellate", "write a limit surface as triangles"),
    "compare": ("compare:compare", "compare two images, or a scene with its reference"),
    "accept": ("compare:accept", "make references of the pictures of failed tests"),
    "merge": ("compare:merge", "merge the passes of an image"),
    "doctor": ("info:doctor", "test what works on this machine"),
}


def parser(words: Sequence[str] = tuple(COMMANDS)) -> CommandParser:
    """The parser of the whole command line, in which only commands among the words have options."""
    about, hint = "Exact subdivision surfaces for Mitsuba 3.", f'"{PROGRAM} COMMAND --help" describes a command.'
    program = CommandParser(prog=PROGRAM, description=about, allow_abbrev=False, epilog=hint)
    program.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    program.set_defaults(error_status=1)
    commands = program.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, (place, text) in COMMANDS.items():
        command = commands.add_parser(name, help=text)
        command.set_defaults(parser=command)
        if name in words:
            pkgutil.resolve_name(f"{__name__}.{place}")(command)
    return program
