"""One cage under the three schemes."""

from __future__ import annotations

from pathlib import Path

from .figure_scenes import draw_row
from .output import FigureOptions

TITLES = {"catmull_clark": "Catmull-Clark", "doo_sabin": "Doo-Sabin", "loop": "Loop"}


def draw(options: FigureOptions) -> list[Path]:
    """Render one cage of triangles, with its edges, under Catmull-Clark, Doo-Sabin and Loop side by side."""
    panels = {title: {"scheme": scheme} for scheme, title in TITLES.items()}
    return draw_row(options, "schemes", panels, {"schemes": list(TITLES)})
