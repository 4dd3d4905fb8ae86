"""Warnings about data that a file format cannot store."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

from ..cage.errors import warn

if TYPE_CHECKING:
    from pathlib import Path


def warn_of_losses(
    path: str | Path,
    parts: Mapping[str, bool],  # Names of parts, and whether each is lost
) -> None:
    """Warn of the parts of a cage that a file of this format cannot hold."""
    lost = [name for name, is_lost in parts.items() if is_lost]
    if lost:
        suffix = os.path.splitext(path)[1]
        warn(f'"{path}": {suffix} files have no place for {", ".join(lost)} of the cage; written without them')
