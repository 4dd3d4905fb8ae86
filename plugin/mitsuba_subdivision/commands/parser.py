"""Argument parser of the commands."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction["CommandParser"]

# Exit status of wrong usage, as argparse has it.
USAGE_ERROR = 2


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
