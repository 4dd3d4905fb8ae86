"""A USD camera as a sensor of Mitsuba."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.studio import sampler
from mitsuba_subdivision.variants import SceneNode

from .contents import CameraContents
from .stage_warnings import StageWarnings

_LEAST_NEAR = 1e-6
# What a single scene leaves out of a camera.
NO_BLUR = "shutters of cameras have no effect without the option --shutter of render"


def sensor(camera: CameraContents, size: tuple[int, int], spp: int, notes: StageWarnings) -> SceneNode:
    """A sensor whose film is the camera's aperture, fitted to the size (width, height) in pixels."""
    width, height = size
    wide, high = film_window(camera, width / height)
    matrix = camera.to_world @ np.diag([-1.0, 1, -1, 1])
    near = max(camera.near, _LEAST_NEAR)
    if camera.shutter[0] < camera.shutter[1]:
        notes.add(NO_BLUR, camera.name)
    common: SceneNode = {
        "near_clip": near,
        "far_clip": max(camera.far, 2 * near),
        "film": {"type": "hdrfilm", "width": width, "height": height, "component_format": "float32"},
        "sampler": sampler(spp),
    }
    if not camera.is_perspective:
        matrix = camera.to_world.copy()
        matrix[:3, 3] += matrix[:3, :2] @ camera.offset
        matrix = matrix @ np.diag([-wide / 2, wide / 2, -1, 1])
        return {"type": "orthographic", "to_world": mi.ScalarTransform4f(matrix.tolist()), **common}
    common["to_world"] = mi.ScalarTransform4f(matrix.tolist())
    if camera.lens_radius > 0:
        # A thin lens has no principal point: the film is a window of a larger one, whose middle is on the axis.
        sides = zip(size, camera.offset, (wide, high), strict=True)
        halves = [round(2 * pixels * offset / length) for pixels, offset, length in sides]
        full = width + abs(halves[0]), height + abs(halves[1])
        window = {
            "width": full[0],
            "height": full[1],
            "crop_width": width,
            "crop_height": height,
            "crop_offset_x": max(halves[0], 0),
            "crop_offset_y": max(-halves[1], 0),
        }
        return {
            "type": "thinlens",
            "aperture_radius": camera.lens_radius,
            "focus_distance": camera.focus_distance,
            **common,
            **_field_of_view(wide * full[0] / width, camera),
            "film": {**common["film"], **(window if any(halves) else {})},
        }
    return {
        "type": "perspective",
        # Of the film's sides; down is positive.
        "principal_point_offset_x": camera.offset[0] / wide,
        "principal_point_offset_y": -camera.offset[1] / high,
        **common,
        **_field_of_view(wide, camera),
    }


def film_window(camera: CameraContents, aspect_ratio: float) -> tuple[float, float]:
    """Width and height of the film of a camera, in its units, as its ``conform_policy`` fits the aperture to a picture.

    By default, more is seen where the picture is wider or higher than the aperture.
    """
    own, of_height = camera.aperture[0], camera.aperture[1] * aspect_ratio
    wide = {
        "expandAperture": max(own, of_height),
        "cropAperture": min(own, of_height),
        "adjustApertureWidth": of_height,
        "adjustApertureHeight": own,
    }[camera.conform_policy]
    return wide, wide / aspect_ratio


def _field_of_view(wide: float, camera: CameraContents) -> SceneNode:
    return {"fov": math.degrees(2 * math.atan(wide / (2 * camera.focal_length))), "fov_axis": "x"}
