"""Options of several commands, and parsers of their values."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

from ..schemes import BUILT_IN
from ..tessellation import HIGHEST_RATE

USAGE_ERROR = 2  # Exit status of wrong usage, as in argparse

V = TypeVar("V")


def add_variant(parser: argparse.ArgumentParser, *aliases: str) -> None:
    """Add the option ``--variant`` to a command."""
    text = "variant of Mitsuba (default: llvm_ad_rgb where it can run, otherwise scalar_rgb)"
    parser.add_argument(*aliases, "--variant", dest="variant", metavar="VARIANT", help=text)


def add_cage_options(parser: argparse._ActionsContainer, default_rate: str) -> None:
    """Add the options that choose one surface of a file: ``--scheme``, ``--prim``, ``--time``, ``--rate``."""
    add = parser.add_argument
    add("--scheme", help=f"one of {', '.join(BUILT_IN)} (default: the file's, otherwise catmull_clark)")
    add("--prim", metavar="PATH", help="mesh of a USD file that has several: its path, or * for all meshes as one cage")
    add("--time", type=float, help="time code of a USD file (default: values without time, or the first)")
    add("--rate", type=rate, metavar="N", help=f"segments per edge of the cage (default: {default_rate})")


def checked(kind: Callable[[str], V], is_allowed: Callable[[V], bool], expected: str) -> Callable[[str], V]:
    """Make a parser of an argument's values whose errors name the expected values."""

    def parsed(text: str) -> V:
        try:
            value = kind(text)
        except (TypeError, ValueError):
            value = None
        if value is None or not is_allowed(value):
            raise argparse.ArgumentTypeError(f'"{text}"; expected {expected}')
        return value

    return parsed


finite = checked(float, math.isfinite, "a number")
above_zero = checked(float, lambda value: 0 < value < math.inf, "a number above 0")
index = checked(int, lambda value: value >= 0, "an integer, 0 or more")
positive = checked(int, lambda value: value >= 1, "an integer, 1 or more")
# Mitsuba's seeds have 32 bits.
seed = checked(int, lambda value: 0 <= value < 2**32, f"an integer from 0 to {2**32 - 1}")
rate = checked(int, lambda value: 1 <= value <= HIGHEST_RATE, f"an integer from 1 to {HIGHEST_RATE}")


class CommandParser(argparse.ArgumentParser):
    """A parser with wide columns in its help, and other exit statuses for errors if the command has them.

    The defaults ``error_status`` and ``usage_status`` are the exit statuses for unusable input and for wrong usage.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"formatter_class": _HelpFormatter, **options})
        self._negative_number_matcher = re.compile(r"^-\.?\d[\d.:]*$")  # Values such as -0.25:0.25 are not options

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        self.exit(self.get_default("usage_status") or USAGE_ERROR, f"{self.prog}: error: {message}\n")


class _HelpFormatter(argparse.HelpFormatter):
    """Help with a wide column of options. Paragraphs and tables in texts keep their lines."""

    def __init__(self, prog: str, **options: Any) -> None:
        super().__init__(prog, **{"max_help_position": 28, **options})

    def add_argument(self, action: argparse.Action) -> None:
        super().add_argument(action)
        if isinstance(action, argparse._SubParsersAction):
            self._action_max_length += self._indent_increment  # argparse does not count the indentation of commands

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        fill = super()._fill_text
        return "\n\n".join(p if "\n" in p else fill(p, width, indent) for p in text.split("\n\n"))


def table(title: str, rows: dict[str, str]) -> str:
    """Lines of names and meanings for the help of a command."""
    return "\n".join([f"{title}:", *(f"  {name:<12} {text}" for name, text in rows.items())])
