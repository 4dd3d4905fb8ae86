"""Scenes, cages and scripts that come with the package."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


def example_file(name: str) -> str:
    """Path of a file in the folder ``scenes``, in the installed package or in the source tree.

    Parameters
    ----------
    name : str
        Path in that folder, such as "cages/rook.obj", "rook.xml" or "export_cage.py".

    Returns
    -------
    str
        As the shape's parameter ``filename`` takes it.

    Raises
    ------
    FileNotFoundError
        If there is none.
    """
    places = [PACKAGE / "scenes", PACKAGE.parents[1] / "scenes"]
    for place in places:
        if (place / name).is_file():
            return str(place / name)
    folders = " nor in ".join(f'"{place}"' for place in places)
    raise FileNotFoundError(f'there is no example "{name}", neither in {folders}')
