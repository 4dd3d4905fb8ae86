"""Figures of the documentation: a module for each, and figure_table.py, which lists them."""

from .figure_table import FIGURES, Figure, require_options
from .output import FigureError, FigureOptions

__all__ = ["FIGURES", "Figure", "FigureError", "FigureOptions", "require_options"]
