"""Where figures find scenes and how they are written."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..whole_file import whole_file

PACKAGE = Path(__file__).resolve().parents[1]
BAR_WIDTH = 30


class FigureError(RuntimeError):
    """A figure cannot be drawn: something it needs is missing."""


def _to_terminal(line: str) -> None:
    sys.stderr.write(f"{line}\n")


def _bar_to_terminal(name: str, done: int, total: int) -> None:
    """Draw a progress bar over the terminal's last line, and wipe it when all is done; nothing in a pipe or file."""
    if not sys.stderr.isatty():
        return
    filled = BAR_WIDTH * done // total
    bar = f"{name} [{'#' * filled}{'.' * (BAR_WIDTH - filled)}] {100 * done // total} %"
    sys.stderr.write(f"\r{bar}" if done < total else f"\r{' ' * len(bar)}\r")
    sys.stderr.flush()


@dataclass(frozen=True)
class FigureOptions:
    """How to draw a figure.

    Attributes
    ----------
    output : Path
        Folder to write to; made if it is not there.
    resolution : int
        Width of a rendered picture in pixels.
    spp : int
        Samples per pixel of a rendered picture.
    formats : tuple of str
        Of ``png``, ``pdf`` and ``exr``, those that a figure has and are wanted.
    scheme : str
        Subdivision scheme, for figures of one scheme.
    report : callable
        Gets a line of text for each step.
    progress : callable
        Gets the name of what is being rendered, and how many of how many passes are done.
    """

    output: Path
    resolution: int = 512
    spp: int = 256
    formats: tuple[str, ...] = ("png", "pdf", "exr")
    scheme: str = "catmull_clark"
    report: Callable[[str], None] = field(default=_to_terminal)
    progress: Callable[[str, int, int], None] = field(default=_bar_to_terminal)

    def paths(self, name: str, *formats: str) -> list[Path]:
        """Files of a figure in those of its formats that are wanted."""
        self.output.mkdir(parents=True, exist_ok=True)
        return [self.output / f"{name}.{suffix}" for suffix in formats if suffix in self.formats]


def scene_path(name: str) -> Path:
    """Scene file of a given name, from the installed package or from the source tree.

    Raises
    ------
    FigureError
        If there is none.
    """
    places = [PACKAGE / "scenes", PACKAGE.parents[1] / "scenes"]
    for place in places:
        if (place / f"{name}.xml").is_file():
            return place / f"{name}.xml"
    raise FigureError(f'scene "{name}.xml" is in neither {places[0]} nor {places[1]}')


def pyplot():
    """Matplotlib's pyplot, set up for the figures.

    Raises
    ------
    FigureError
        If matplotlib is not installed; the message names the extra that brings it.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise FigureError("figures need matplotlib: pip install 'mitsuba-subdivision[figures]'") from error
    matplotlib.use("Agg")
    # Fixed metadata and identifiers: the same command twice gives the same file.
    os.environ.setdefault("SOURCE_DATE_EPOCH", "0")
    matplotlib.rcParams.update(
        {"svg.hashsalt": "mitsuba-subdivision", "font.size": 9, "mathtext.fontset": "dejavusans", "pdf.fonttype": 42}
    )
    from matplotlib import pyplot

    return pyplot


def save_figure(figure, path: Path, dpi: int = 160) -> None:
    """Write a matplotlib figure in the format of the path's suffix; the file appears whole or not at all.

    Parameters
    ----------
    dpi : int
        Pixels per inch. Fewer keep the files of pictures with much detail small.
    """
    more = {"pil_kwargs": {"optimize": True}} if path.suffix == ".png" else {}
    with whole_file(path) as beside:
        figure.savefig(beside, dpi=dpi, **more)


def save_picture(pixels: NDArray[np.uint8], path: Path) -> None:
    """Write 8-bit RGB pixels as PNG; the file appears whole or not at all."""
    from matplotlib.image import imsave

    with whole_file(path) as beside:
        imsave(beside, pixels, pil_kwargs={"optimize": True})
