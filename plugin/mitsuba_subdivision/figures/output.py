"""Parts that all figures share: their options, matplotlib, and how files are written."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..whole_file import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


# Widths of a page and of one of its two columns in millimetres. Panels get fewer columns below BETWEEN.
PAGE, COLUMN, BETWEEN, INCH = 178.0, 84.0, 120.0, 25.4
# Room around a figure in inches, and how often it is laid out to leave no more than this.
PAD, LAYOUTS = 0.02, 8
# Sizes of text in points at a column and at a page: exponents and indices are characters of the same size.
TEXT_SIZES = (6.0, 7.0)
# Colours and markers of series, which differ in grey and for colour-blind readers.
SERIES = (("#c8432b", "s"), ("#12395c", "o"), ("#d9a53f", "^"))
STYLE: dict[Any, Any] = {
    "pdf.fonttype": 42,
    "mathtext.fontset": "dejavusans",
    "axes.titlesize": "medium",
    "axes.titleweight": "bold",
    "axes.titlepad": 3,
    "axes.labelsize": "medium",
    "axes.labelpad": 2,
    "axes.linewidth": 0.5,
    "xtick.labelsize": "medium",
    "ytick.labelsize": "medium",
    "legend.fontsize": "medium",
    "legend.frameon": False,
    "grid.color": "0.88",
    "grid.linewidth": 0.4,
    "lines.linewidth": 1,
    "lines.markersize": 3,
    "figure.constrained_layout.w_pad": 0.015,
    "figure.constrained_layout.h_pad": 0.025,
    "figure.constrained_layout.wspace": 0.01,
    "figure.constrained_layout.hspace": 0.01,
}
_EXPONENTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class FigureError(RuntimeError):
    """A figure cannot be drawn: something it needs is missing."""


@dataclass(frozen=True)
class FigureOptions:
    """Options of a figure."""

    output: Path  # Folder to write to; created if it is missing
    # Width of a panel in pixels. Pictures are rendered at this width; PDF files hold their pixels as they are.
    resolution: int = 512
    spp: int = 256  # Samples per pixel of a rendered image
    width: float = PAGE  # Width of the figure on paper in millimetres
    formats: tuple[str, ...] = ("png", "pdf", "exr")  # Which of "png", "pdf" and "exr" to write, if the figure has them
    scheme: str = "catmull_clark"  # Subdivision scheme, for the figures that show one scheme of several
    # File of a Catmull-Clark cage to show in place of the figure's own, for the figures that take one
    cage: Path | None = None

    def name_for_scheme(self, name: str) -> str:
        """Name of the files of a figure that shows one scheme of several."""
        return name if self.scheme == type(self).scheme else f"{name}_{self.scheme}"


def panels(options: FigureOptions, rows: int, columns: int, **more: Any) -> tuple[Figure, Any]:
    """Make axes in rows and columns over the width of the figure; their heights follow when it is written.

    More options are for `matplotlib.pyplot.subplots`.
    """
    # Not above, as the command line imports this module for every command.
    import matplotlib

    matplotlib.use("Agg")
    # Fixed dates and identifiers in files, so that the same command twice gives the same file.
    os.environ.setdefault("SOURCE_DATE_EPOCH", "0")
    matplotlib.rcParams.update({**STYLE, "font.size": TEXT_SIZES[options.width >= BETWEEN]})
    from matplotlib import pyplot

    width = options.width / INCH
    # As high as rows of panels that are twice as high as wide.
    size = (width, 1 + 2 * rows * width / columns)
    return pyplot.subplots(rows, columns, figsize=size, layout="compressed", squeeze=False, **more)


def rows_of(options: FigureOptions, count: int) -> tuple[int, int]:
    """Rows and columns of a series of panels: one row on a page, two in a column."""
    return (1, count) if options.width >= BETWEEN else (2, (count + 1) // 2)


def write_figure(
    options: FigureOptions,
    name: str,
    figure: Figure,
    rendered: Sequence[NDArray[np.floating]] = (),  # Linear pixels of pictures of one height, whose R, G and B are kept
    *,
    per_row: int | None = None,  # Pictures side by side; by default, all
    layouts: int = LAYOUTS,  # How often the height of the figure is set to that of its contents
    **metadata: Any,  # Of the pixels, besides their samples
) -> list[Path]:
    """Write a figure as PNG and as PDF, and its pictures as OpenEXR, if these formats are wanted, and close it.

    The first axes of the figure get the width in pixels that the options say. Pictures keep their pixels in PDF.
    Returns the files written, each of which appears whole or not at all.
    """
    from matplotlib.image import AxesImage
    from matplotlib.pyplot import close

    # Panels of a fixed aspect leave room above and below them. A half of that to a legend is left each time.
    for _ in range(layouts):
        figure.draw_without_rendering()
        figure.set_size_inches(figure.get_figwidth(), figure.get_tightbbox().height + 2 * PAD)
    figure.draw_without_rendering()
    dpi = options.resolution / (figure.axes[0].get_window_extent().width / figure.dpi)
    options.output.mkdir(parents=True, exist_ok=True)
    formats = ("png", "pdf", "exr") if rendered else ("png", "pdf")
    paths = [options.output / f"{name}.{suffix}" for suffix in formats if suffix in options.formats]
    for path in paths:
        if path.suffix == ".exr":
            from ..regression.image import write_exr

            count = per_row or len(rendered)
            rows = [np.concatenate(rendered[i : i + count], axis=1) for i in range(0, len(rendered), count)]
            write_exr(path, np.concatenate(rows)[..., :3], {**metadata, "spp": options.spp})
            continue
        more: dict[str, Any] = {"pil_kwargs": {"optimize": True}} if path.suffix == ".png" else {}
        if path.suffix == ".pdf":
            for image in figure.findobj(AxesImage):
                image.set_interpolation("none")
        with whole_file(path) as beside:
            figure.savefig(beside, dpi=dpi, **more)
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
    """Draw no frame and no ticks around a panel of equal units; unlike `set_axis_off`, this keeps its labels."""
    axis.set(xticks=[], yticks=[], aspect="equal")
    axis.spines[:].set_visible(False)
