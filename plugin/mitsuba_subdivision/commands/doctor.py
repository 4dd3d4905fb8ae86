"""The command ``doctor``."""

from __future__ import annotations

import argparse

from ..messages import print_result
from .arguments import Commands


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    doctor = commands.add_parser(
        "doctor",
        help="test what works on this machine",
        description="Print the versions of libraries, and test which variants of Mitsuba render here, each in a "
        "process of its own. The exit status is 1 if a variant fails that this machine should support.",
    )
    doctor.add_argument("--json", action="store_true", help="print JSON")
    doctor.set_defaults(run=_doctor, parser=doctor)


def _doctor(options: argparse.Namespace) -> int:
    from ..doctor import diagnose

    found = diagnose()
    print_result(found.as_json() if options.json else found)
    return 0 if found.healthy else 1
