"""A textured cube under a smooth sky, of which the picture shows what lies inside its outline."""

import mitsuba as mi
import numpy as np
from shapes.cages import cube
from shapes.scenes import perspective, scene_with

POINTS = "shape.control_points"
# Samples per pixel are few for any one of these.
RESOLUTION = 16


def textured_cube():
    """A cube with texture coordinates without seams; all that the view shows has different ones."""
    positions = cube().positions
    return cube(texcoords=positions[:, :2] * 0.4 + 0.1 * positions[:, 2:] + 0.5)


def sky(kind):
    """``around``: from all sides, brighter above; ``before``: from within 41 degrees of a direction, falling to zero.

    Of the second, no light arrives from below the plane of any triangle that the view shows, even of large ones.
    """
    height, width = 32, 64
    row, column = np.mgrid[:height, :width]
    theta, phi = np.pi * (row + 0.5) / height, 2 * np.pi * (column + 0.5) / width
    d = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=-1)
    if kind == "before":
        axis = np.array([0.1, -1, 0.3]) / np.linalg.norm([0.1, -1, 0.3])
        value = np.maximum((d @ axis - 0.75) / 0.25, 0) ** 2
    else:
        value = 1 + 0.4 * d[..., 2] + 0.5 * d[..., 0]
    return {"type": "envmap", "bitmap": mi.Bitmap((value[..., None] * np.array([1, 0.8, 0.6])).astype(np.float32))}


def materials():
    texels = 0.2 + 0.6 * np.random.default_rng(1).random((8, 8, 3))
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels.astype(np.float32)), "raw": True}
    rough = {"type": "roughconductor", "alpha": 0.3}
    return {"diffuse": {"type": "diffuse"}, "rough": rough, "textured": {"type": "diffuse", "reflectance": texture}}


def inside(material, light, shape):
    # Of directions that the diffuse material chooses, the variance is far larger: they turn with the tangents.
    samples = {} if material == "rough" else {"bsdf_samples": 0}
    sensor = perspective(RESOLUTION, [1, -4, 2], fov=14)
    shape = {**shape, "bsdf": materials()[material]}
    return scene_with(i={"type": "direct", **samples}, sensor=sensor, sky=sky(light), shape=shape)


def tilt(positions):
    """Shear and bending, which turn what the view shows upwards and aside."""
    x, _, z = positions.T
    return np.stack([np.zeros(len(positions)), z + 0.3 * x, 0.2 * z**2], axis=1)
