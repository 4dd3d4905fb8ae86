"""Panels: the images of a report, with the meaning of their colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .png import colours

# The colours of a relative difference reach at least this far to both sides, so that rounding stays pale.
LEAST_RELATIVE = 0.01


@dataclass(frozen=True, eq=False)
class Panel:
    """An image of the report.

    Attributes
    ----------
    title : str
    pixels : (height, width, 3) uint8
        In sRGB.
    caption : str
        HTML.
    colour_map : str or None
        Name in `png.MAPS`, if the report shows a scale of colours.
    ends : (str, str)
        Meanings of the first and the last colour of that scale, HTML.
    tiles : sequence of mappings
        Rectangles to draw over the image: ``x``, ``y``, ``width`` and ``height`` in pixels, ``channel``, and ``z``,
        the z-score.
    """

    title: str
    pixels: NDArray[np.uint8]
    caption: str
    colour_map: str | None = None
    ends: tuple[str, str] = ("", "")
    tiles: Sequence[Mapping[str, Any]] = ()


def relative_panel(title: str, reference: NDArray[np.floating], test: NDArray[np.floating], caption: str) -> Panel:
    """Panel of the relative difference between two images ``(height, width, 3)``, in the mean of R, G and B."""
    grey = 0.01 * np.abs(reference).mean() + 1e-12
    relative = (test.mean(axis=2) - reference.mean(axis=2)) / (np.abs(reference).mean(axis=2) + grey)
    reach = max(float(np.percentile(np.abs(relative), 99)), LEAST_RELATIVE)
    ends = f"&minus;{reach:.1%}", f"+{reach:.1%}"
    return Panel(title, colours(relative / reach / 2 + 0.5, "RdBu_r"), caption, "RdBu_r", ends)
