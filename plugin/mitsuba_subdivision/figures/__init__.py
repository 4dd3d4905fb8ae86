"""Figures of the documentation, and the table that lists them.

A new figure is a function ``draw_NAME`` and a line of the table. The function takes `FigureOptions` and returns the
written files. The line describes the figure and lists its options, for the command ``figure`` and its help.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from ..cage import without_warnings
from .output import COLUMN, PAGE, FigureError, FigureOptions

__all__ = ["FIGURES", "Figure", "FigureError", "FigureOptions", "require_options"]


@dataclass(frozen=True)
class Figure:
    """A figure; a call with `FigureOptions` draws it and returns the written files."""

    name: str
    module: str  # Module of ``draw_NAME``, imported when the figure is drawn, as it imports Mitsuba
    shows: str  # For the help
    options: tuple[str, ...] = ()  # Options of the figure, besides "resolution" and "width"
    width: float = PAGE  # Default of the option
    spp: int = FigureOptions.spp  # Default of the option
    has_numbers: bool = False  # Whether the figure writes CSV

    @property
    def formats(self) -> tuple[str, ...]:
        """Formats of the figure's files: "exr" of renders, "csv" of plotted numbers."""
        left_out = {"exr": "spp" not in self.options, "csv": not self.has_numbers}
        return tuple(name for name in FigureOptions.formats if not left_out.get(name))

    def __call__(self, options: FigureOptions) -> list[Path]:
        try:
            import matplotlib  # noqa: F401 - only to find out whether it is there
        except ImportError as error:
            raise FigureError("figures need matplotlib: pip install 'mitsuba-subdivision[figures]'") from error
        draw: Callable[[FigureOptions], list[Path]] = pkgutil.resolve_name(f"{__name__}.{self.module}:draw_{self.name}")
        if options.cage:
            # Warns about the cage once, before the figure makes others of it.
            pkgutil.resolve_name(f"{__name__}.staging:read")(options.cage)
        with without_warnings():
            return draw(options)


_FIGURES = (
    Figure("subdivision", "cages", "a cage and its refinements, irregular patches grey", ("spp", "cage")),
    Figure("refinement", "characteristic", "control points of a patch before and after one refinement", (), COLUMN),
    Figure("tree", "characteristic", "a face divided into polynomials, and the matrix that makes them", (), COLUMN),
    Figure("domains", "characteristic", "parameter domains of the regular patches at each level", ("scheme",), COLUMN),
    Figure("artifact", "normal_error", "normals by (11), (12) and (13)", ("spp", "scheme", "cage"), spp=32),
    Figure("error", "normal_error", "errors of these normals against level", ("cage",), has_numbers=True),
    Figure("schemes", "scenes", "one cage under the three schemes", ("spp",)),
    Figure("creases", "cages", "one cage with smooth, semi-sharp and sharp creases", ("spp", "cage")),
    Figure("shading", "scenes", "brushed metal, shaded by vertices and exactly at every hit", ("spp",)),
    Figure("displacement", "scenes", "a jar before and after it is displaced, and its triangles", ("spp",)),
    Figure("zoom", "normal_error", "an extraordinary vertex, magnified up to a million times", ("spp",)),
    Figure("zebra", "zebra", "reflection lines with exact normals, and by usual methods", ("spp", "cage")),
    Figure("curvature", "characteristic", "curvature around extraordinary vertices", ("cage",), has_numbers=True),
    Figure("fit", "fit", "cages fitted to pictures, and their distance from the target", ("spp",)),
    Figure("hero", "scenes", "a human figure and its control cage", ("spp",)),
)
FIGURES = {figure.name: figure for figure in _FIGURES}


def require_options(name: str, given: dict[str, object], formats: Iterable[str]) -> None:
    """Raise ValueError for options and formats that a figure does not have."""
    figure = FIGURES[name]
    for option in given:
        if option not in (*figure.options, "resolution", "width"):
            others = ", ".join(f'"{other}"' for other, entry in FIGURES.items() if option in entry.options)
            raise ValueError(f'--{option} has no effect on the figure "{name}"; expected one of {others}')
    for wanted in formats:
        if wanted not in figure.formats:
            raise ValueError(f'the figure "{name}" is not drawn as {wanted}; expected {" or ".join(figure.formats)}')
