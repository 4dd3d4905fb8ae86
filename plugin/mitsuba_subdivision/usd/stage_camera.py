"""A USD camera as plain data."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..files.usd_values import value_at
from .contents import CameraContents
from .stage_warnings import StageWarnings

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

# Apertures and focal lengths are in tenths of the world's unit.
TENTHS = 0.1


def read_camera(
    camera: UsdGeom.Camera, to_world: NDArray[np.float64], time: Usd.TimeCode, notes: StageWarnings
) -> CameraContents:
    """Read a camera.

    Parameters
    ----------
    camera : UsdGeom.Camera
    to_world : (4, 4) float64
        For column vectors. Scales are left out, as USD's own frustum of a camera has none.
    time : Usd.TimeCode
    notes : StageWarnings
    """
    x, y, z = to_world[:3, :3].T
    forward = -z / np.linalg.norm(z)
    up = y - forward * (forward @ y)
    up /= np.linalg.norm(up)
    right = np.cross(forward, up)
    if right @ x < 0:
        notes.add("reflections in the transforms of cameras are ignored", camera.GetPath())
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = np.stack([right, up, -forward], axis=1), to_world[:3, 3]

    def number(attribute: Usd.Attribute) -> float:
        return float(value_at(attribute, time))

    is_perspective = value_at(camera.GetProjectionAttr(), time) == "perspective"
    unit = 1.0 if is_perspective else TENTHS
    aperture = [number(camera.GetHorizontalApertureAttr()), number(camera.GetVerticalApertureAttr())]
    offset = [number(camera.GetHorizontalApertureOffsetAttr()), number(camera.GetVerticalApertureOffsetAttr())]
    near, far = value_at(camera.GetClippingRangeAttr(), time)
    focal_length, f_stop = number(camera.GetFocalLengthAttr()), number(camera.GetFStopAttr())
    focus = number(camera.GetFocusDistanceAttr())
    has_lens = is_perspective and f_stop > 0 and focus > 0
    if value_at(camera.GetClippingPlanesAttr(), time):
        notes.add("clippingPlanes of cameras are ignored", camera.GetPath())
    return CameraContents(
        str(camera.GetPath()),
        rigid,
        is_perspective,
        [unit * each for each in aperture],
        [unit * each for each in offset],
        focal_length,
        float(near),
        float(far),
        TENTHS * focal_length / (2 * f_stop) if has_lens else 0.0,
        focus if has_lens else 0.0,
        [number(camera.GetShutterOpenAttr()), number(camera.GetShutterCloseAttr())],
    )
