"""Figures of the documentation, and the table that lists them.

A new figure is a function and a line. The function gets `FigureOptions`, draws the figure, and returns the files that
it wrote. The line in the table `FIGURES` names the module and the function, says what the figure shows, and lists the
options that change it. The command ``figure`` and its help read this table.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from .output import COLUMN, PAGE, FigureError, FigureOptions

__all__ = ["FIGURES", "Figure", "FigureError", "FigureOptions", "require_options"]


@dataclass(frozen=True)
class Figure:
    """A figure; call it with `FigureOptions` to draw it, and get the files written.

    A call raises FigureError if matplotlib is not installed; the message names the extra that brings it.
    """

    function: str  # ``module.function`` of this package. The module imports Mitsuba, so it is imported only then.
    shows: str  # What the figure shows, for the help
    # Those of "spp", "scheme" and "cage" that change the figure; "resolution" and "width" change all
    options: tuple[str, ...] = ()
    width: float = PAGE  # Width on paper in millimetres, unless the options have another

    @property
    def formats(self) -> tuple[str, ...]:
        """Of "png", "pdf" and "exr": the last for figures that are rendered."""
        return FigureOptions.formats if "spp" in self.options else FigureOptions.formats[:-1]

    def __call__(self, options: FigureOptions) -> list[Path]:
        try:
            import matplotlib  # noqa: F401 - only to find out whether it is there
        except ImportError as error:
            raise FigureError("figures need matplotlib: pip install 'mitsuba-subdivision[figures]'") from error
        module, function = self.function.split(".")
        draw: Callable[[FigureOptions], list[Path]] = getattr(importlib.import_module(f".{module}", __name__), function)
        return draw(options)


FIGURES: dict[str, Figure] = {
    "subdivision": Figure(
        "cages.draw_subdivision", "a cage and its refinements, irregular patches grey", ("spp", "cage")
    ),
    "refinement": Figure(
        "characteristic.draw_refinement", "control points of a patch before and after one refinement", (), COLUMN
    ),
    "tree": Figure(
        "characteristic.draw_tree", "a face divided into polynomials, and the matrix that makes them", (), COLUMN
    ),
    "domains": Figure(
        "characteristic.draw_domains", "parameter domains of the regular patches at each level", ("scheme",), COLUMN
    ),
    "artifact": Figure("normal_error.draw_artifact", "normals by (11), (12) and (13)", ("spp", "scheme", "cage")),
    "error": Figure("normal_error.draw_error", "errors of these normals against level", ("cage",)),
    "schemes": Figure("scenes.draw_schemes", "one cage under the three schemes", ("spp",)),
    "creases": Figure("cages.draw_creases", "one cage with smooth, semi-sharp and sharp creases", ("spp", "cage")),
    "shading": Figure("scenes.draw_shading", "brushed metal, shaded by vertices and exactly at every hit", ("spp",)),
    "displacement": Figure(
        "scenes.draw_displacement", "a jar before and after it is displaced, and its triangles", ("spp",)
    ),
    "zoom": Figure("normal_error.draw_zoom", "an extraordinary vertex, magnified up to a million times", ("spp",)),
    "zebra": Figure("zebra.draw", "reflection lines, with exact normals and with others", ("spp", "cage")),
    "curvature": Figure("characteristic.draw_curvature", "curvature around extraordinary vertices", ("cage",)),
    "fit": Figure("fit.draw", "cages fitted to pictures, and how near they come", ("spp",)),
    "hero": Figure("scenes.draw_hero", "a human figure and its control cage", ("spp",)),
}


def require_options(name: str, given: dict[str, object], formats: Iterable[str]) -> None:
    """Raise ValueError for options, by name, that do not change a figure, and formats that it does not have."""
    figure = FIGURES[name]
    for option in given:
        if option not in (*figure.options, "resolution", "width"):
            others = ", ".join(f'"{other}"' for other, entry in FIGURES.items() if option in entry.options)
            raise ValueError(f'--{option} has no effect on the figure "{name}"; expected one of {others}')
    for wanted in formats:
        if wanted not in figure.formats:
            raise ValueError(f'the figure "{name}" is not drawn as {wanted}; expected {" or ".join(figure.formats)}')
