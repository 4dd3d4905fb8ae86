"""Where points of a scene appear in its image, and which of them the camera sees."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import upload

# Points are lifted off their surface by this part of their distance to the camera, before they are tested.
LIFT = 2e-3


def project(sensor: mi.Sensor, points: NDArray[np.floating], resolution: int) -> NDArray[np.float64]:
    """Pixel coordinates ``(.., 2)`` of world points ``(.., 3)``, for a square image of this width."""
    parameters = mi.traverse(sensor)
    camera = _in_camera(sensor, points)
    # Mitsuba's cameras look along +z, with x to the left and y up. An orthographic camera sees x and y from -1 to 1.
    half_width = np.ones_like(camera[..., 2:])
    if "x_fov" in parameters:
        half_width = camera[..., 2:] * np.tan(np.radians(float(np.array(parameters["x_fov"]).item()) / 2))
    return (1 - camera[..., :2] / half_width) / 2 * resolution


def visible(scene: mi.Scene, points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether nothing of the scene lies between each point ``(n, 3)`` and its orthographic camera."""
    sensor = scene.sensors()[0]
    backward = -camera_matrix(sensor)[:3, 2]
    start = points + LIFT * _in_camera(sensor, points)[:, 2:] * backward
    towards = mi.Vector3f(*(backward / np.linalg.norm(backward)).tolist())
    if "scalar" in str(mi.variant()):
        return np.array([not scene.ray_test(mi.Ray3f(mi.Point3f(p), towards)) for p in start], dtype=bool)
    return ~np.array(scene.ray_test(mi.Ray3f(upload(mi.Point3f, start), towards)))


def visible_runs(scene: mi.Scene, lines: NDArray[np.floating], resolution: int) -> list[NDArray[np.float64]]:
    """Parts of polylines ``(m, points, 3)`` that the camera sees, in pixels, each ``(.., 2)``."""
    seen = visible(scene, lines.reshape(-1, 3)).reshape(lines.shape[:2])
    positions = project(scene.sensors()[0], lines, resolution)
    runs = []
    for line, shown in zip(positions, seen, strict=True):
        changes = 1 + np.flatnonzero(np.diff(shown))
        runs += np.split(line, changes)[0 if shown[0] else 1 :: 2]
    return [run for run in runs if len(run) > 1]


def camera_matrix(sensor: mi.Sensor) -> NDArray[np.float64]:
    """Transform ``(4, 4)`` from the camera to the world."""
    return np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)


def _in_camera(sensor: mi.Sensor, points: NDArray[np.floating]) -> NDArray[np.float64]:
    to_camera = np.linalg.inv(camera_matrix(sensor))
    return points @ to_camera[:3, :3].T + to_camera[:3, 3]
