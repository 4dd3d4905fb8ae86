"""The table of the figures of the documentation.

A new figure is one file and one line. The file is a module of this package. Its function ``draw`` gets `FigureOptions`,
draws the figure, and returns the files that it wrote. The line in the table `FIGURES` names the module, says what the
figure shows, and lists the options that change it and the formats that it has. The command ``figure`` and its help read
this table. Every figure has a file of its own, however short.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from .output import FigureOptions


@dataclass(frozen=True)
class Figure:
    """A figure; call it with `FigureOptions` to draw it, and get the files written.

    Attributes
    ----------
    module : str
        Module of this package that draws the figure. It imports Mitsuba, so it is imported only then.
    shows : str
        What the figure shows, for the help.
    options : tuple of str
        Those of "resolution", "spp" and "scheme" that change the figure.
    formats : tuple of str
        Of "png", "pdf" and "exr".
    catmull_clark_formats : tuple of str
        Those of the formats that the figure has under Catmull-Clark only.
    drawn_with : str or None
        Another figure that draws this one as well.
    """

    module: str
    shows: str
    options: tuple[str, ...]
    formats: tuple[str, ...]
    catmull_clark_formats: tuple[str, ...] = ()
    drawn_with: str | None = None

    def __call__(self, options: FigureOptions) -> list[Path]:
        draw: Callable[[FigureOptions], list[Path]] = importlib.import_module(f".{self.module}", __package__).draw
        return draw(options)


_SIZE = ("resolution", "spp")
_ALL = ("png", "pdf", "exr")
_PLOT = ("png", "pdf")
_RENDER = ("png", "exr")

FIGURES: dict[str, Figure] = {
    "subdivision": Figure("subdivision", "a cage and its refinements, irregular patches grey", _SIZE, _ALL),
    "refinement": Figure("refinement", "control points of a patch before and after one refinement", (), _PLOT),
    "domains": Figure("domains", "parameter domains of the regular patches at each level", ("scheme",), _PLOT),
    "artifact": Figure("artifact", "normals by (11), (12) and (13), rendered", (*_SIZE, "scheme"), _ALL, ("pdf",)),
    "error": Figure("normal_error", "normal error against level by (11), (12), (13)", (), _PLOT, drawn_with="artifact"),
    "schemes": Figure("schemes", "one cage under the three schemes", _SIZE, _RENDER),
    "creases": Figure("creases", "one cage with smooth, semi-sharp and sharp creases", _SIZE, _RENDER),
    "shading": Figure("shading", "brushed metal, shaded by vertices and exactly at every hit", _SIZE, _RENDER),
    "displacement": Figure("displacement", "a jar before and after it is displaced, and its triangles", _SIZE, _RENDER),
    "zoom": Figure("zoom", "an extraordinary vertex, magnified up to a million times", _SIZE, _ALL),
    "zebra": Figure("zebra", "reflection lines, with exact normals and with others", _SIZE, _ALL),
    "curvature": Figure("curvature", "curvature around extraordinary vertices", ("resolution",), _PLOT),
    "fit": Figure("fit", "cages fitted to pictures, and how near they come", _SIZE, _ALL),
    "hero": Figure("hero", "a human figure and its control cage", _SIZE, _RENDER),
}


def require_options(name: str, given: dict[str, object], formats: Iterable[str]) -> None:
    """Reject options that do not change a figure, and formats that it does not have.

    Parameters
    ----------
    name : str
        In `FIGURES`.
    given : dict
        Options that were given, by name.
    formats : iterable of str
        Formats that are wanted.

    Raises
    ------
    ValueError
    """
    figure = FIGURES[name]
    for option in given:
        if option not in figure.options:
            raise ValueError(f'--{option} has no effect on the figure "{name}"; expected no such option')
    possible = set(figure.formats)
    if given.get("scheme", "catmull_clark") != "catmull_clark":
        possible -= set(figure.catmull_clark_formats)
    for wanted in formats:
        if wanted not in possible:
            raise ValueError(f'the figure "{name}" is not drawn as {wanted}; expected {" or ".join(sorted(possible))}')
