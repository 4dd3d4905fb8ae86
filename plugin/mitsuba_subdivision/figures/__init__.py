"""Figures: one function each, which reads scenes and writes pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .artifact import draw_artifact
from .creases import draw_creases
from .curvature import draw_curvature
from .domains import draw_domains
from .hero import draw_hero
from .normal_error import draw_normal_error
from .output import FigureError, FigureOptions
from .refinement import draw_refinement
from .schemes import draw_schemes
from .subdivision import draw_subdivision
from .zebra import draw_zebra
from .zoom import draw_zoom

# Name on the command line, and the function that draws it and returns the files written.
FIGURES: dict[str, Callable[[FigureOptions], list[Path]]] = {
    "subdivision": draw_subdivision,
    "refinement": draw_refinement,
    "domains": draw_domains,
    "artifact": draw_artifact,
    "error": draw_normal_error,
    "schemes": draw_schemes,
    "creases": draw_creases,
    "zoom": draw_zoom,
    "zebra": draw_zebra,
    "curvature": draw_curvature,
    "hero": draw_hero,
}

__all__ = ["FIGURES", "FigureError", "FigureOptions"]
