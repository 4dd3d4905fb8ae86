"""Parts that all figures share: their options, the folder of the scenes, matplotlib, and how files are written."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..examples import example_file
from ..progress import draw_bar
from ..whole_file import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class FigureError(RuntimeError):
    """A figure cannot be drawn: something it needs is missing."""


def _to_terminal(line: str) -> None:
    sys.stderr.write(f"{line}\n")


@dataclass(frozen=True)
class FigureOptions:
    """Options of a figure.

    Attributes
    ----------
    output : Path
        Folder to write to; created if it is missing.
    resolution : int
        Width of a rendered image in pixels.
    spp : int
        Samples per pixel of a rendered image.
    formats : tuple of str
        Which of "png", "pdf" and "exr" to write, if the figure has them.
    scheme : str
        Subdivision scheme, for the figures that show one scheme of several.
    report : callable
        Is called with a line of text for each step.
    progress : callable
        Is called with the name of what is being rendered, how many parts are done, and how many there are.
    """

    output: Path
    resolution: int = 512
    spp: int = 256
    formats: tuple[str, ...] = ("png", "pdf", "exr")
    scheme: str = "catmull_clark"
    report: Callable[[str], None] = field(default=_to_terminal)
    progress: Callable[[str, int, int], None] = field(default=draw_bar)

    def paths(self, name: str, *formats: str) -> list[Path]:
        """Files to write, in the requested formats."""
        self.output.mkdir(parents=True, exist_ok=True)
        return [self.output / f"{name}.{suffix}" for suffix in formats if suffix in self.formats]


def scene_path(name: str) -> Path:
    """File of a scene, in the installed package or in the source tree."""
    return Path(example_file(f"{name}.xml"))


def pyplot() -> Any:
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
    # Fixed dates and identifiers in files, so that the same command twice gives the same file.
    os.environ.setdefault("SOURCE_DATE_EPOCH", "0")
    matplotlib.rcParams.update(
        {"svg.hashsalt": "mitsuba-subdivision", "font.size": 9, "mathtext.fontset": "dejavusans", "pdf.fonttype": 42}
    )
    from matplotlib import pyplot

    return pyplot


def write_plot(options: FigureOptions, name: str, figure: Any, *formats: str, dpi: int = 160) -> list[Path]:
    """Write a matplotlib figure in those of the formats that are wanted, and close it.

    Parameters
    ----------
    dpi : int
        Pixels per inch. Lower values keep the files of figures with much detail small.

    Returns
    -------
    list of Path
        The files written, each of which appears whole or not at all.
    """
    from matplotlib.pyplot import close

    paths = options.paths(name, *formats)
    for path in paths:
        more = {"pil_kwargs": {"optimize": True}} if path.suffix == ".png" else {}
        with whole_file(path) as beside:
            figure.savefig(beside, dpi=dpi, **more)
    close(figure)
    return paths


def write_pixels(
    options: FigureOptions, name: str, pixels: NDArray[np.floating], metadata: dict[str, Any]
) -> list[Path]:
    """Write linear RGB pixels as OpenEXR, if that format is wanted; returns the file written, if any."""
    # Imported here, as the command line imports this module for every command.
    from ..regression.image import write_exr

    paths = options.paths(name, "exr")
    for path in paths:
        write_exr(path, pixels, metadata)
    return paths


def save_png(pixels: NDArray[np.uint8], path: Path) -> None:
    """Write 8-bit RGB pixels as PNG; the file appears whole or not at all."""
    from matplotlib.image import imsave

    with whole_file(path) as beside:
        imsave(beside, pixels, pil_kwargs={"optimize": True})


def hide_frame(axis: Axes) -> None:
    """Draw no frame and no ticks around a panel; unlike `set_axis_off`, this keeps its labels."""
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_visible(False)
