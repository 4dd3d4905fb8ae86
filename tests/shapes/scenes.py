"""Sensors and textures for scenes, rays that hit shapes, and what shapes hold at their vertices."""

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_subdivision import upload

# Sums of some tens of terms of order one, in single precision.
SINGLE = 2e-6
# Numbers of a vertex, where they are not three.
WIDTHS = {"vertex_texcoords": 2, "vertex_weight": 1, "vertex_label": 1}


def buffer(shape, name):
    values = np.array(mi.traverse(shape)[name])
    return values if name == "face_element" else values.reshape(-1, WIDTHS.get(name, 3))


def vertices(shape):
    return tuple(buffer(shape, f"vertex_{name}") for name in ("positions", "normals"))


def rows(value):
    return np.array(value, dtype=np.float64).T


def scene_with(**objects):
    return mi.load_dict({"type": "scene", **objects})


def rays(o, d):
    return mi.Ray3f(upload(mi.Point3f, o), upload(mi.Vector3f, d))


def down(x=0.1, y=0.2, z=5):
    return mi.Ray3f(mi.Point3f(x, y, z), mi.Vector3f(0, 0, -1))


def hit(shape, *place):
    return scene_with(shape=shape).ray_intersect(down(*place))


def film(width, height=None):
    """Samples beyond the border spare a warning of projective integrators."""
    size = {"width": width, "height": height or width}
    return {"type": "hdrfilm", **size, "rfilter": {"type": "box"}, "pixel_format": "rgb", "sample_border": True}


def perspective(size, origin, target=(0, 0, 0), up=(0, 0, 1), **more):
    to_world = mi.ScalarTransform4f().look_at(list(origin), list(target), list(up))
    return {"type": "perspective", "to_world": to_world, "film": size if isinstance(size, dict) else film(size), **more}


def camera_rays(resolution, origin=(2.2, -3.2, 2.0), target=(0, 0, 0), fov=30):
    """One through the middle of each pixel."""
    y, x = (np.indices((resolution, resolution)).reshape(2, -1) + 0.5) / resolution
    sensor = mi.load_dict(perspective(resolution, origin, target, fov=fov))
    return sensor.sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))[0]


def waves():
    """A texture in Python, without a gradient of its own."""

    class Waves(mi.Texture):
        def __init__(self, props):
            mi.Texture.__init__(self, props)

        def eval_1(self, si, active=True):  # noqa: ARG002 - as Mitsuba calls it
            return dr.sin(3 * si.uv.x) * dr.cos(2 * si.uv.y)

    mi.register_texture("waves", Waves)
    return mi.load_dict({"type": "waves"})
