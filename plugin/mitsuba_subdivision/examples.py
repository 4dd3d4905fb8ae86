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
    candidates = [PACKAGE / "scenes", PACKAGE.parents[1] / "scenes"]
    for folder in candidates:
        if (folder / name).is_file():
            return str(folder / name)
    folders = " nor in ".join(f'"{folder}"' for folder in candidates)
    raise FileNotFoundError(f'there is no example "{name}", neither in {folders}')
