"""A model in the studio, as a Mitsuba scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import CageError, ControlCage
from .model import Model
from .picture import shading_for
from .stage import DEFAULT_SIZE, DEFAULT_SPP, studio, variant_in_use
from .view import DEFAULT_VIEW, View

CLAY = (0.56, 0.52, 0.47)
CHECKER = (0.15, 0.23, 0.32), (0.72, 0.68, 0.61)
# Squares along a texture coordinate from 0 to 1.
CHECKER_SQUARES = 16
WIRE_COLOUR = (0.015, 0.05, 0.12)
WIRE_RATE = 2


@dataclass(frozen=True)
class Look:
    """How a model is shown; the fields are parameters of `studio_scene`, and shading is "vertex" or "exact"."""

    view: View = DEFAULT_VIEW
    up: str | None = None
    size: tuple[int, int] = DEFAULT_SIZE
    spp: int = DEFAULT_SPP
    rate: int | None = None
    shading: str = "vertex"
    checker: bool = False
    cage: bool = False


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
) -> dict[str, Any]:
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
        Axis that points up. By default what a USD file says; y for OBJ files, z for PLY files and cages in memory.
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
        As `ControlCage.from_file` does; or if a checkerboard is asked for and there are no texture coordinates.
    ValueError
        If view, axis or size are none.
    """
    shading = shading_for(variant_in_use(), {"shading": shading})
    look = Look(view, up, size, spp, rate, shading, checker, cage)
    shown = Model(model, prim=prim, time=time, scheme=scheme)
    return compose(shown, look, frame_points(shown, look), follows_sensor=True)


def frame_points(model: Model, look: Look, control_points: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Points ``(n, 3)`` that must be in the picture: of the limit surface, and of the cage if it is drawn.

    They are those of the model, or of the model with other control points.
    """
    points = model.points if control_points is None else model.limit_points(control_points)
    if not look.cage:
        return points
    corners = model.wire.positions(model.cage.positions if control_points is None else control_points)
    return np.concatenate([points, corners])


def compose(model: Model, look: Look, points: NDArray[np.float64], *, follows_sensor: bool = False) -> dict[str, Any]:
    """The scene of a model, with a studio for points ``(n, 3)`` that must be in the picture.

    If nothing is going to move, not even the camera, triangles may follow its sensor.
    """
    if look.checker and model.cage.texcoords is None:
        raise CageError(f"{model.cage.source.name} has no texture coordinates; expected them for a checkerboard")
    staged = studio(
        np.stack([points.min(axis=0), points.max(axis=0)]),
        up=look.up or model.up,
        view=look.view,
        size=look.size,
        spp=look.spp,
        points=points,
    )
    triangles = {"tessellation_rate": look.rate or model.default_rate}
    if follows_sensor and look.rate is None and look.shading == "exact":
        triangles = model.triangles_for(staged["sensor"])
    shapes = {"surface": {**model.as_shape(triangles, look.shading), "bsdf": _material(look.checker)}}
    if look.cage:
        shapes["cage"] = {
            "type": "subdivision",
            **model.wire.cage.as_properties(mi),
            "tessellation_rate": WIRE_RATE,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(WIRE_COLOUR)}},
        }
    first = {name: staged.pop(name) for name in ("integrator", "sensor")}
    return {"type": "scene", **first, **shapes, **staged}


def _material(checker: bool) -> dict[str, Any]:
    colour: dict[str, Any] = {"type": "rgb", "value": list(CLAY)}
    if checker:
        colour = {
            "type": "checkerboard",
            **{f"color{i}": {"type": "rgb", "value": list(value)} for i, value in enumerate(CHECKER)},
            # A period is two squares.
            "to_uv": mi.ScalarTransform4f().scale([CHECKER_SQUARES / 2, CHECKER_SQUARES / 2, 1]),
        }
    clay = {"type": "principled", "base_color": colour, "roughness": 0.42, "specular": 0.5}
    # Open surfaces are seen from both sides.
    return {"type": "twosided", "bsdf": clay}
