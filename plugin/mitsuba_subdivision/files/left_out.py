"""What a file format cannot hold of a control cage."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ..cage.errors import warn


def warn_of_left_out(path: str | Path, parts: Mapping[str, bool]) -> None:
    """Warn of the parts of a cage that its file is written without.

    Parameters
    ----------
    path : str or Path
    parts : dict of str to bool
        Names of parts, and whether the cage has them.
    """
    missing = [name for name, present in parts.items() if present]
    if missing:
        suffix = Path(path).suffix
        warn(f'"{path}": {suffix} files have no place for {", ".join(missing)} of the cage; written without')
