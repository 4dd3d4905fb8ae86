"""Display options of a model or a stage."""

from __future__ import annotations

from dataclasses import dataclass

from .studio_entries import DEFAULT_SPP
from .view import DEFAULT_VIEW, View


@dataclass(frozen=True)
class Look:
    """Display options of a model or a stage.

    Attributes
    ----------
    view : str or (azimuth, elevation)
        From where the studio's camera looks.
    size : (width, height) or None
        Of the film, in pixels. None for 640 by 480, or what a stage's render settings or its camera ask for.
    spp : int
        Samples per pixel.
    up : "y", "z" or None
        Axis of a cage that points up; None for that of its file.
    rate : int or None
        Segments on each edge of a cage; None for as many as a picture needs.
    shading : "vertex" or "exact"
        Of a cage.
    checker : bool
        Whether texture coordinates of a cage are shown as a checkerboard.
    cage : bool
        Whether the control cage is drawn over its surface.
    texture_size : int or None
        Pixels along the sides of the textures of a stage's materials at most; None for as many as the picture shows.
    """

    view: View = DEFAULT_VIEW
    size: tuple[int, int] | None = None
    spp: int = DEFAULT_SPP
    up: str | None = None
    rate: int | None = None
    shading: str = "vertex"
    checker: bool = False
    cage: bool = False
    texture_size: int | None = None
