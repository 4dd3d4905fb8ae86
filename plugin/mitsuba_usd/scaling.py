"""Contents of a stage in a larger unit, with the same picture: light leaks below small models (`enlargement`)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from mitsuba_subdivision.mitsuba_mesh import box_corners, points_at

from .contents import CameraContents, LightContents, MaterialContents, SceneContents, ShapeContents

_WITHOUT_PLACE = ("distant", "dome")


def size_of(contents: SceneContents) -> float:
    """The largest side of a box around all control points; 0 if there are none."""
    boxes = [
        points_at(box_corners(np.stack([points.min(axis=0), points.max(axis=0)])), matrices).reshape(-1, 3)
        for shape, matrices in contents.placements.items()
        if len(points := shape.cage.positions)
    ]
    return float(np.ptp(np.concatenate(boxes), axis=0).max()) if boxes else 0.0


def scaled(contents: SceneContents, factor: float) -> SceneContents:
    """Contents with all lengths multiplied by a factor; radiances stay."""
    scale = np.diag([factor, factor, factor, 1.0])
    materials: dict[MaterialContents | None, MaterialContents | None] = {}

    def of_material(material: MaterialContents | None) -> MaterialContents | None:
        depth = 0.0 if material is None else material.inputs.get("depth", 0.0)
        if material is not None and material not in materials and isinstance(depth, (int, float)) and depth > 0:
            materials[material] = replace(material, inputs={**material.inputs, "depth": depth * factor})
        return materials.get(material, material)

    def of_shape(shape: ShapeContents, matrix: np.ndarray) -> ShapeContents:
        power = factor**2 if shape.whole_light else 1.0
        radiance = None if shape.radiance is None else [power * channel for channel in shape.radiance]
        return replace(shape, to_world=matrix @ shape.to_world, material=of_material(shape.material), radiance=radiance)

    def of_light(light: LightContents) -> LightContents:
        # Power is divided by the area of the light, or by the square of the distance.
        grows = light.is_normalized and light.kind not in _WITHOUT_PLACE
        emission = (np.array(light.emission) * factor**2).tolist() if grows else light.emission
        return replace(light, to_world=scale @ light.to_world, emission=emission)

    inside = np.eye(4)
    return replace(
        contents,
        shapes=[of_shape(shape, scale) for shape in contents.shapes],
        groups=[[of_shape(shape, inside) for shape in group] for group in contents.groups],
        instances=[replace(instance, to_world=scale @ instance.to_world) for instance in contents.instances],
        lights=[of_light(light) for light in contents.lights],
        camera=None if contents.camera is None else scaled_camera(contents.camera, factor),
    )


def scaled_camera(camera: CameraContents, factor: float) -> CameraContents:
    """A camera with all lengths of the world multiplied by a factor; the film of a perspective camera stays."""
    to_world = camera.to_world.copy()
    to_world[:3, 3] *= factor
    film = 1.0 if camera.is_perspective else factor
    lengths = ("near", "far", "lens_radius", "focus_distance")
    changed: dict[str, Any] = {name: factor * getattr(camera, name) for name in lengths}
    changed |= {name: [film * length for length in getattr(camera, name)] for name in ("aperture", "offset")}
    return replace(camera, to_world=to_world, **changed)
