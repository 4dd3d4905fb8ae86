"""Brushed metal with normals of vertices, and with those of the surface at every hit."""

from __future__ import annotations

from pathlib import Path

from .figure_scenes import draw_row
from .output import FigureOptions

PANELS = (("vertex", 2), ("vertex", 8), ("exact", 2))
TITLES = {"vertex": "normals of vertices", "exact": "exact at every hit"}


def draw(options: FigureOptions) -> list[Path]:
    """Render one scene by both kinds of shading, side by side."""
    panels = {f"{TITLES[kind]}\n{rate} segments per edge": {"shading": kind, "rate": rate} for kind, rate in PANELS}
    metadata = {"shading": [shading for shading, _ in PANELS], "rate": [rate for _, rate in PANELS]}
    return draw_row(options, "shading", panels, metadata)
