"""Common parts of all figures: options, layout, and output of files."""

from __future__ import annotations

import csv
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..messages import PROGRAM
from ..whole_file import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


# Widths of a page and of one of its two columns in millimetres. Below BETWEEN, there are fewer panels in a row.
PAGE, COLUMN, BETWEEN, INCH = 178.0, 84.0, 120.0, 25.4
PAD, LAYOUTS = 0.02, 8  # Room around a figure in inches, and number of layouts until it fits
# Sizes of text in points for a column and for a page; exponents and indices are characters of the same size.
TEXT_SIZES = (6.0, 7.0)
# Colours and markers of series, distinct in greyscale and for colour blindness; red marks extraordinary points only.
SERIES = (("#2f8f83", "s"), ("#12395c", "o"), ("#d9a53f", "^"))
STYLE: dict[Any, Any] = {
    "pdf.fonttype": 42, "mathtext.fontset": "dejavusans",
    "axes.titlesize": "medium", "axes.titleweight": "bold", "axes.titlepad": 3, "axes.labelsize": "medium",
    "axes.labelpad": 2, "axes.linewidth": 0.5,
    "xtick.labelsize": "medium", "ytick.labelsize": "medium",
    "legend.fontsize": "medium", "legend.frameon": False,
    "grid.color": "0.88", "grid.linewidth": 0.4,
    "lines.linewidth": 1, "lines.markersize": 3,
    "figure.constrained_layout.w_pad": 0.015, "figure.constrained_layout.h_pad": 0.025,
    "figure.constrained_layout.wspace": 0.01, "figure.constrained_layout.hspace": 0.01,
}  # fmt: skip
_EXPONENTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class FigureError(RuntimeError):
    """A figure cannot be drawn, as a requirement is missing."""


@dataclass(frozen=True)
class FigureOptions:
    """Options of a figure."""

    output: Path  # Folder, created if it is missing
    resolution: int = 512  # Width of a panel in pixels
    spp: int = 256  # Samples per pixel
    width: float = PAGE  # Width on paper in millimetres
    formats: tuple[str, ...] = ("png", "pdf", "exr", "csv")  # Formats to write, if the figure has them
    scheme: str = "catmull_clark"
    cage: Path | None = None  # File of a Catmull-Clark cage in place of the figure's own

    def command(self, name: str, variant: str | None) -> str:
        """The command line of a figure, with the variant and samples if it is rendered."""
        values: dict[str, object] = {"width": f"{self.width:g}mm", "resolution": self.resolution, "cage": self.cage}
        values |= {"scheme": self.scheme} if self.scheme != type(self).scheme else {}
        values |= {"spp": self.spp, "variant": variant} if variant else {}
        words = [word for key, value in values.items() if value for word in (f"--{key}", str(value))]
        return shlex.join([PROGRAM, "figure", name, *words])


def panels(options: FigureOptions, rows: int, columns: int, **more: Any) -> tuple[Figure, Any]:
    """Make axes by `matplotlib.pyplot.subplots` over the width of the figure; `write_figure` sets its height."""
    import matplotlib  # Local, as every command imports this module

    matplotlib.use("Agg")
    # Fixed dates and identifiers, so that a command always writes the same file.
    os.environ.setdefault("SOURCE_DATE_EPOCH", "0")
    matplotlib.rcParams.update({**STYLE, "font.size": TEXT_SIZES[options.width >= BETWEEN]})
    from matplotlib import pyplot

    # Room for panels that are twice as high as wide.
    width = options.width / INCH
    size = (width, 1 + 2 * rows * width / columns)
    return pyplot.subplots(rows, columns, figsize=size, layout="compressed", squeeze=False, **more)


def rows_of(options: FigureOptions, count: int) -> tuple[int, int]:
    """Rows and columns of a series of panels: one row on a page, two in a column."""
    return (1, count) if options.width >= BETWEEN else (2, (count + 1) // 2)


def write_figure(
    options: FigureOptions,
    name: str,
    figure: Figure,
    rendered: Sequence[NDArray[np.floating]] = (),  # Linear pixels of pictures of one height; R, G and B are written
    *,
    cage: str,  # Name of the figure's own cage
    per_row: int | None = None,  # Pictures side by side; by default, all
    pixels: int | None = None,  # Width of the first axes; by default, that of the options
    layouts: int = LAYOUTS,  # Number of times that the height of the figure is fitted to its contents
    numbers: Sequence[Sequence[object]] = (),  # Rows of a table, first the names of columns
    **metadata: Any,  # Further metadata of the OpenEXR file
) -> list[Path]:
    """Write a figure as PNG and PDF, its pictures as OpenEXR and its numbers as CSV, if requested, and close it.

    Pictures keep their pixels in PDF. Images have the version, the command and the cage as metadata.
    """
    import mitsuba as mi
    from matplotlib.image import AxesImage
    from matplotlib.pyplot import close, setp

    # Layouts need no pictures, which are resampled whenever they are drawn.
    setp(images := figure.findobj(AxesImage), visible=False)
    # Panels of a fixed aspect leave room above and below. Half of the room up to a legend is left each time.
    for _ in range(layouts):
        figure.draw_without_rendering()
        figure.set_size_inches(figure.get_figwidth(), figure.get_tightbbox().height + 2 * PAD)
    figure.draw_without_rendering()
    setp(images, visible=True)
    dpi = (pixels or options.resolution) / (figure.axes[0].get_window_extent().width / figure.dpi)
    options.output.mkdir(parents=True, exist_ok=True)
    stem = name if options.scheme == type(options).scheme else f"{name}_{options.scheme}"
    left_out = {"exr": not rendered, "csv": not numbers}
    paths = [options.output / f"{stem}.{suffix}" for suffix in options.formats if not left_out.get(suffix)]
    if options.cage:
        cage = f"{options.cage}, SHA-256 {sha256(options.cage.read_bytes()).hexdigest()}"
    command = options.command(name, mi.variant() if rendered else None)
    origin = {"version": f"{PROGRAM} {__version__}", "command": command, "cage": cage}
    for path in paths:
        if path.suffix == ".csv":
            with whole_file(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
                csv.writer(file).writerows(numbers)
        elif path.suffix == ".exr":
            from ..regression.image import write_exr

            count = per_row or len(rendered)
            rows = [np.concatenate(rendered[i : i + count], axis=1) for i in range(0, len(rendered), count)]
            write_exr(path, np.concatenate(rows)[..., :3], {**origin, **metadata, "spp": options.spp})
        else:
            is_pdf = path.suffix == ".pdf"
            keys = ("Creator", "Subject", "Keywords") if is_pdf else ("Software", "Description", "Source")
            more: dict[str, Any] = {} if is_pdf else {"pil_kwargs": {"optimize": True}}
            if is_pdf:
                setp(images, interpolation="none")
            with whole_file(path) as beside:
                figure.savefig(beside, dpi=dpi, metadata=dict(zip(keys, origin.values(), strict=True)), **more)
    close(figure)
    return paths


def show(axis: Axes, pixels: NDArray[np.uint8], title: str = "", caption: str = "") -> None:
    """Draw a picture in a panel, with a title above and a caption below it."""
    axis.imshow(pixels, interpolation="lanczos")
    axis.set(title=title, xlabel=caption)
    hide_frame(axis)


def scientific(value: float) -> str:
    """One digit and a power of ten: "2·10⁻⁴"."""
    digit, power = f"{value:.0e}".split("e")
    exponent = f"10{str(int(power)).translate(_EXPONENTS)}"
    return digit if int(power) == 0 else exponent if digit == "1" else f"{digit}·{exponent}"


def label_powers(axis: Axis) -> None:
    """Label a logarithmic axis by powers of ten in text of one size."""
    axis.set_major_formatter(lambda value, _: scientific(value) if value != 1 else "1")


def hide_frame(axis: Axes) -> None:
    """Hide frame and ticks of a panel of equal units; unlike `set_axis_off`, this keeps its labels."""
    axis.set(xticks=[], yticks=[], aspect="equal")
    axis.spines[:].set_visible(False)
