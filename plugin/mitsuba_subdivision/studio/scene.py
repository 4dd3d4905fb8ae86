"""A model in the studio, as a Mitsuba scene."""

from __future__ import annotations

from pathlib import Path

from ..cage import ControlCage
from ..variants import SceneNode
from .animation import StillPicture
from .cage_scenes import CageScenes
from .picture import shading_for
from .studio_entries import DEFAULT_SIZE, DEFAULT_SPP, Look, variant_in_use
from .view import DEFAULT_VIEW, View


def studio_scene(
    model: ControlCage | str | Path,
    *,
    prim: str | None = None,
    time: float | None = None,
    scheme: str | None = None,
    view: View = DEFAULT_VIEW,
    up: str | None = None,
    size: tuple[int, int] = DEFAULT_SIZE,
    spp: int = DEFAULT_SPP,
    rate: int | None = None,
    shading: str = "auto",
    checker: bool = False,
    cage: bool = False,
) -> SceneNode:
    """Scene of one model in a neutral studio, for ``mi.load_dict``; a variant of Mitsuba must be set.

    Parameters
    ----------
    model : ControlCage, str or Path
        A cage, or an OBJ, PLY or USD file.
    prim, time, scheme : optional
        As for `ControlCage.from_file`.
    view : str or (azimuth, elevation)
        "front", "side", "back", "top", "three-quarter", or angles in degrees: azimuth 0 is the front, which is -y where
        z is up, and +z where y is up; azimuth 90 is +x; elevation 90 is straight from above.
    up : "y" or "z", optional
        Axis that points up. By default that of a USD file; y for OBJ files, z for PLY files and cages in memory.
    size : (width, height)
    spp : int
        Samples per pixel.
    rate : int, optional
        Segments per edge of the cage. By default as many as a picture needs: with exact shading, adaptive ones that put
        outlines within a tenth of a pixel as this camera sees them; else fewer for larger cages.
    shading : "auto", "vertex" or "exact"
        If the first is not exact, a line on standard error says why.
    checker : bool
        Whether texture coordinates are shown as a checkerboard.
    cage : bool
        Whether the control cage is drawn over the surface.

    Returns
    -------
    dict
        The model is the entry "surface", the drawn cage "cage"; the others are those of the studio.

    Raises
    ------
    CageError, OSError
        As `ControlCage.from_file` does; or if ``checker`` is set and there are no texture coordinates.
    ValueError
        If the view, the axis or the size is invalid.
    """
    shading = shading_for(variant_in_use(), {"shading": shading})
    look = Look(view, size, spp, up, rate, shading, checker, cage)
    return StillPicture(CageScenes(model, look, prim=prim, time=time, scheme=scheme)).scene
