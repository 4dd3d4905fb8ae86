"""AOVs of a scene's first hits, the geometry probe, by rays through the centres of pixels, in any variant."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..images.probe_aovs import NOTHING, Probe
from .scene import LoadedScene

# Mesh attribute of the shape `subdivision`: the face of the cage that each triangle belongs to.
ELEMENT_ATTRIBUTE = "face_element"


def probe_scene(loaded: LoadedScene) -> Probe:
    """Position, normal, uv, shape, triangle and face at the first hits of the rays through the centres of pixels."""
    trace = _trace_arrays if dr.is_jit_v(mi.Float) else _trace_one_by_one
    width, height = loaded.size
    position, normal, uv, triangle, shape = trace(loaded, width, height)
    hit = shape != NOTHING
    for values in (position, normal, uv):
        values[~hit] = 0
    triangle[~hit] = NOTHING
    p, n, parameters = (values.reshape(height, width, -1).astype(np.float32) for values in (position, normal, uv))
    element = _elements(loaded.scene, shape, triangle)
    size = (height, width)
    return Probe(p, n, parameters, shape.reshape(size), triangle.reshape(size), element.reshape(size))


def _trace_arrays(loaded: LoadedScene, width: int, height: int) -> tuple[NDArray, ...]:
    """Position, normal, parameters, triangle and shape that each ray hits, in a variant of arrays."""
    pixel = dr.arange(mi.UInt32, width * height)
    x, y = mi.Float(pixel % width), mi.Float(pixel // width)
    film_position = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
    # Any, as a number is taken for an array.
    sensor: Any = loaded.sensor
    # The middle of the lens and of the spectrum, when the shutter opens: a probe takes no random samples.
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, film_position, mi.Point2f(0.5))
    found = loaded.scene.ray_intersect(ray)
    identity = _identities(found.shape)
    order = _identities(loaded.scene.shapes_dr())
    shape = np.full(width * height, NOTHING, dtype=np.uint32)
    valid = np.array(found.is_valid())
    for index, shape_identity in enumerate(order):
        shape[valid & (identity == shape_identity)] = index
    vectors = (np.array(v).T.astype(np.float32).copy() for v in (found.p, found.sh_frame.n, found.uv))
    return *vectors, np.array(found.prim_index).astype(np.uint32), shape


def _identities(shapes: Any) -> NDArray[np.uint32]:
    return np.array(dr.reinterpret_array(mi.UInt32, shapes))


def _trace_one_by_one(loaded: LoadedScene, width: int, height: int) -> tuple[NDArray, ...]:
    """Trace as `_trace_arrays` does, in a scalar variant."""
    count = width * height
    position, normal, uv = (np.zeros((count, n), dtype=np.float32) for n in (3, 3, 2))
    triangle, shape = (np.full(count, NOTHING, dtype=np.uint32) for _ in range(2))
    # Any, as the stubs are those of variants with arrays.
    sensor: Any = loaded.sensor
    scene: Any = loaded.scene
    shapes = scene.shapes()
    for i in range(count):
        film_position = [(i % width + 0.5) / width, (i // width + 0.5) / height]
        ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, film_position, [0.5, 0.5])
        found = scene.ray_intersect(ray)
        if found.is_valid():
            position[i], normal[i], uv[i] = found.p, found.sh_frame.n, found.uv
            triangle[i], shape[i] = found.prim_index, shapes.index(found.shape)
    return position, normal, uv, triangle, shape


def _elements(scene: mi.Scene, shape: NDArray[np.uint32], triangle: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Faces of the cage that triangles belong to, `NOTHING` for shapes without a cage."""
    found = np.full(shape.shape, NOTHING, dtype=np.uint32)
    for index, candidate in enumerate(scene.shapes()):
        at = np.flatnonzero(shape == index)
        parameters = mi.traverse(candidate) if len(at) and candidate.is_mesh() else {}
        if ELEMENT_ATTRIBUTE in parameters:
            elements = np.array(parameters[ELEMENT_ATTRIBUTE]).astype(np.uint32)
            found[at] = elements[triangle[at]]
    return found
