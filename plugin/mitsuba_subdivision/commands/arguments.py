"""Options shared by several commands, and parsers of their values."""

from __future__ import annotations

import argparse
import math
import sys
from typing import Any, NoReturn, TypeAlias

from .. import variants
from ..llvm import best_variant
from ..regression.scene import require_variant
from ..schemes import SCHEME_CLASSES
from ..tessellation import HIGHEST_RATE

# A text, as Python's class takes no type.
Commands: TypeAlias = "argparse._SubParsersAction[CommandParser]"
# Exit status of wrong usage, as argparse has it.
USAGE_ERROR = 2


def add_variant(parser: argparse.ArgumentParser, *aliases: str) -> None:
    """Add the option ``--variant`` to a command, with other names that it may have."""
    text = "variant of Mitsuba (default: llvm_ad_rgb where it can run, otherwise scalar_rgb)"
    parser.add_argument(*aliases, "--variant", dest="variant", metavar="VARIANT", help=text)


def set_variant(name: str | None) -> None:
    """Set the variant of Mitsuba that ``--variant`` names, or the best if there is none.

    Raises RegressionError if the variant cannot run here.
    """
    variants.set_variant(require_variant(name) if name else best_variant())


def add_cage_options(parser: argparse._ActionsContainer, default_rate: str) -> None:
    """Add the options that choose one surface of a file: ``--scheme``, ``--prim``, ``--time``, ``--rate``."""
    add = parser.add_argument
    add("--scheme", help=f"one of {', '.join(SCHEME_CLASSES)} (default: the file's, otherwise catmull_clark)")
    add("--prim", metavar="PATH", help="mesh of a USD file that has several: its path, or * for all meshes as one cage")
    add("--time", type=float, help="time code of a USD file (default: the first)")
    add("--rate", type=rate, metavar="N", help=f"segments per edge of the cage (default: {default_rate})")


def positive(text: str) -> int:
    """Parse an argument that is an integer of at least 1."""
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'"{text}"; expected an integer, 1 or more') from None
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number}; expected 1 or more")
    return number


def seed(text: str) -> int:
    """Parse a seed, an integer of 32 bits."""
    if not (text.isdecimal() and int(text) < 2**32):
        raise argparse.ArgumentTypeError(f'"{text}"; expected an integer from 0 to {2**32 - 1}')
    return int(text)


def rate(text: str) -> int:
    """Parse a tessellation rate."""
    number = positive(text)
    if number > HIGHEST_RATE:
        raise argparse.ArgumentTypeError(f"{number}; expected {HIGHEST_RATE} or less")
    return number


def finite(text: str) -> float:
    """Parse a number that is finite."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f'"{text}"; expected a number')
    return number


class CommandParser(argparse.ArgumentParser):
    """A parser with wide columns in its help, whose command may have exit statuses of its own for errors.

    The defaults ``error_status`` and ``usage_status`` are the exit statuses for unusable input and for wrong usage.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"formatter_class": _HelpFormatter, **options})

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        self.exit(self.get_default("usage_status") or USAGE_ERROR, f"{self.prog}: error: {message}\n")


class _HelpFormatter(argparse.HelpFormatter):
    """Help with a wide column of options. Texts may have paragraphs, and tables, which keep their lines."""

    def __init__(self, prog: str, **options: Any) -> None:
        super().__init__(prog, **{"max_help_position": 28, **options})

    def add_argument(self, action: argparse.Action) -> None:
        super().add_argument(action)
        if isinstance(action, argparse._SubParsersAction):
            # argparse does not count the indentation of commands.
            self._action_max_length += self._indent_increment

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = text.split("\n\n")
        return "\n\n".join(
            p if "\n" in p else super(_HelpFormatter, self)._fill_text(p, width, indent) for p in paragraphs
        )


def table(title: str, rows: dict[str, str]) -> str:
    """Names and their meanings, in lines for the help of a command."""
    return "\n".join([f"{title}:", *(f"  {name:<12} {text}" for name, text in rows.items())])
