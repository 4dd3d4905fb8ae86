"""Pictures of limit surfaces: shading, required rates, weights of lights, and denoising."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..messages import print_remark
from ..mitsuba_mesh import box_corners, points_at
from ..regression.scene import BOX, GivenScene, LoadedScene, load_scene, render_image, render_pixels
from ..shapes.interaction_hook import exact_shading_problem
from ..shapes.parameter_table import SHADINGS
from ..shapes.parameters import pixel_error_for
from ..variants import SceneNode
from .animation import load_quietly
from .studio_entries import variant_in_use

# Largest distance of triangles from the surface in pixels, by shading. With exact shading, only silhouettes show it.
ERRORS = {"exact": 0.1, "vertex": 0.5 / 4**2}
# Part of the surface that has at most the estimated error, which is too large at borders and creases; and the largest
# error anywhere, relative to this.
SURFACE_QUANTILE, LARGEST_ERROR = {"exact": 0.95, "vertex": 0.99}, 10
MOST_SEGMENTS, FINEST_RATE = 8, 64  # Most segments on each edge of a cage: of uniform and of adaptive tessellations
# Most triangles of a scene; and the number of uniform triangles that take as long as choosing adaptive ones.
MOST_TRIANGLES, FEW_TRIANGLES = 4_000_000, 20_000
AUXILIARY_SPP = 64  # Samples per pixel of albedo and normals, one ray each; 256 improve neither edges nor blurred parts
# Least number of lights to weigh, and least ratio of the mean square of their contributions to the squared mean: equal
# probabilities are better for two or equal lights. Then the least share of a weight, and rays for each light.
LEAST_LIGHTS, LEAST_UNEVEN, LEAST_WEIGHT, SCOUTS = 3, 1.3, 0.03, 2 * 160 * 120
_AUXILIARY = "albedo:albedo,normal:sh_normal"  # AOVs of the denoiser, the last six channels of the film


def shading_for(parameters: SceneNode) -> str:
    """Shading of ``subdivision`` shapes with these parameters in the current variant, "exact" or "vertex".

    If exact shading does not work, or is slow, a line on standard error says so, as warnings may be errors. Raises
    ValueError if the shading is unknown.
    """
    shading = parameters.get("shading", "auto")
    if shading not in SHADINGS:
        raise ValueError(f'shading "{shading}"; expected one of {", ".join(SHADINGS)}')
    if shading != "auto":
        return str(shading)
    if parameters.get("face_normals"):
        return "vertex"
    problem = exact_shading_problem(getattr(mi, variant_in_use()))
    if problem is None:
        return "exact"
    print_remark(f"normals are interpolated between vertices: {problem}")
    return "vertex"


def segments_for(
    cage: ControlCage, to_world: NDArray[np.float64], outline: SceneNode, near_clip: float, shading: str
) -> NDArray[np.int64]:
    """Rates ``(n,)`` of a cage's copies ``(n, 4, 4)``, up to `FINEST_RATE`, without facets that a sensor shows."""
    error = _deviation(cage, shading) * pixels_of_copies(cage.positions, to_world, outline, near_clip)
    # Twice the rate has a quarter of the distance.
    segments = np.ceil(np.sqrt(np.minimum(error / ERRORS[shading], FINEST_RATE**2)))
    return np.maximum(1, segments.astype(np.int64))


def highest_rate(segments: NDArray[np.integer], corners: NDArray[np.integer]) -> int:
    """Largest rate, up to `FINEST_RATE`, with at most `MOST_TRIANGLES` of all cages.

    Each cage needs a rate in ``segments`` (n,), and its faces have ``corners`` (n,).
    """
    # A quadrilateral has four corners, and two triangles for each square of the rate.
    triangles = (np.minimum(segments, np.arange(2, FINEST_RATE + 1)[:, None]) ** 2 * corners).sum(axis=1) // 2
    return 1 + int(np.searchsorted(triangles, MOST_TRIANGLES, side="right"))


def outline_for(sensor: SceneNode) -> SceneNode:
    """Parameters of shapes with exact shading and accurate outlines for a sensor, an entry of a scene."""
    return pixel_error_for(mi.load_dict(sensor), ERRORS["exact"], outline=True)


def triangles_for(segments: int, corners: int, most: int, outline: SceneNode, highest: int) -> SceneNode:
    """Parameters of a shape with exact shading in a still picture: adaptive, unless uniform triangles are few.

    The cage needs a rate of ``segments``; ``most`` is the highest uniform rate, ``highest`` the highest adaptive one.
    """
    is_enough = segments <= most and segments**2 * corners <= 2 * FEW_TRIANGLES
    if is_enough or min(segments, highest) == 1:
        return {"tessellation_rate": min(segments, most)}
    return {**outline, "max_rate": highest}


def _deviation(cage: ControlCage, shading: str) -> float:
    """Distance of a cage's faces from its surface, in object space, for most of the surface.

    On a surface that bends one way with curvature ``k``, chords of length ``h`` are up to ``k h^2 / 8`` away, and
    vertices are ``k h^2 / 4`` away from the middle of their four neighbours. On a surface that bends both ways, both
    distances are twice as large.
    """
    t = cage.topology
    used = t.vertex_face_count > 0
    squared, sizes = np.zeros(np.count_nonzero(used)), np.zeros(len(t.face_vertices))
    for x in cage.positions.T:
        at_corners = x[t.face_vertices]
        around = np.bincount(t.face_vertices, (at_corners[t.next] + at_corners[t.prev]) / 2, cage.vertex_count)
        squared += np.square(around[used] / t.vertex_face_count[used] - x[used])
        sizes += np.square(at_corners[t.next] - at_corners)
    # Weighted by area: coarse parts of a cage have few vertices.
    order, area = np.argsort(squared), np.bincount(t.face_vertices, sizes, cage.vertex_count)[used]
    below = np.cumsum(area[order])
    typical = squared[order[np.searchsorted(below, SURFACE_QUANTILE[shading] * below[-1])]]
    return float(np.sqrt(max(typical, squared.max() / LARGEST_ERROR**2)) / 2)


def pixels_of_copies(
    points: NDArray, to_world: NDArray[np.float64], outline: SceneNode, near_clip: float
) -> NDArray[np.float64]:
    """Maximum pixels per unit of a mesh with these points, for each of its copies ``(n, 4, 4)``."""
    stretch = np.linalg.norm(to_world[:, :3, :3], 2, axis=(1, 2))
    matrix = np.array(outline["sensor_to_world"].matrix, dtype=np.float64).reshape(4, 4)
    if not outline["sensor_fov"]:
        return stretch * outline["film_width"] / (2 * np.linalg.norm(matrix[:3, 0]))
    half_width, from_world = math.tan(math.radians(outline["sensor_fov"]) / 2), np.linalg.inv(matrix)
    box = np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float64)
    depth = points_at(box_corners(box), to_world) @ from_world[2, :3] + from_world[2, 3]
    return stretch * outline["film_width"] / (2 * half_width * np.maximum(depth.min(axis=1), near_clip))


def weigh_lights(scene: mi.Scene, sensor: int = 0) -> bool:
    """Set the ``sampling_weight`` of lights to their contributions to a picture, which stays unbiased.

    Mitsuba samples all lights with equal probability. Here, the direct light of each is rendered with a few rays; no
    weight is below 0.03 of the sum. Equal probabilities spread samples evenly over pixels: weights help uneven lights.

    Parameters
    ----------
    scene : mi.Scene
        Its lights are changed, unless they are fewer than 3, nearly equal or weighted, or the variant is scalar.
    sensor : int
        The sensor of the picture.

    Returns
    -------
    bool
        Whether weights were set.
    """
    lights = [mi.traverse(light) for light in scene.emitters()]
    before = [float(np.ravel(np.array(light["sampling_weight"]))[0]) for light in lights]
    if len(lights) < LEAST_LIGHTS or before != [1.0] * len(lights) or mi.Float is float:
        return False

    def set_weights(weights: NDArray[np.float64]) -> None:
        for light, weight in zip(lights, weights.tolist(), strict=True):
            light["sampling_weight"] = weight
            light.update()
        scene.parameters_changed()

    camera, sampler = scene.sensors()[sensor], mi.load_dict({"type": "independent"})
    direct = mi.load_dict({"type": "direct", "emitter_samples": 1, "bsdf_samples": 0, "hide_emitters": True})
    seen = np.zeros(len(lights))
    for number, alone in enumerate(np.eye(len(lights))):
        set_weights(alone)
        sampler.seed(0, SCOUTS)
        ray, factor = camera.sample_ray_differential(0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
        radiance = np.array(factor * direct.sample(scene, sampler, ray)[0])
        seen[number] = np.nan_to_num(radiance, posinf=0.0).mean()
    pays = bool(np.square(seen).mean() > LEAST_UNEVEN * seen.mean() ** 2)
    set_weights(np.maximum(seen / seen.sum(), LEAST_WEIGHT) if pays else np.array(before))
    return pays


def set_light_weights(scene: SceneNode) -> None:
    """Set the weights of `weigh_lights` in a scene's entries of lights, and in objects among them."""
    loaded = load_quietly(_copied(scene)).scene
    for light in loaded.emitters() if weigh_lights(loaded) else ():
        shape = light.get_shape()
        entry = scene.get(light.id() if shape is None else shape.id())
        if isinstance(entry, dict):
            of_light = entry if shape is None else entry["emitter"]
            of_light["sampling_weight"] = float(np.ravel(np.array(mi.traverse(light)["sampling_weight"]))[0])


def _copied(entry: Any) -> Any:
    """An entry with tensors of its own, as `mi.load_dict` takes those of bitmaps out of their dictionaries."""
    if isinstance(entry, dict):
        return {name: _copied(part) for name, part in entry.items()}
    return mi.TensorXf(entry) if isinstance(entry, mi.TensorXf) else entry


def require_denoiser() -> None:
    """Raise ValueError before rendering if the denoiser's package is missing."""
    try:
        import mitsuba_oidn  # noqa: F401 - only to find out whether it is there
    except ImportError as error:
        what = f"the package {error.name}, which denoises pictures by Open Image Denoise, is missing"
        raise ValueError(f'{what}; pip install "mitsuba-subdivision[denoise]"') from None


def render_denoised(
    scene: GivenScene, spp: int | None = None, seed: int = 0, parameters: dict[str, object] | None = None
) -> NDArray[np.float32]:
    """Render a scene with the box filter, and remove its noise by Open Image Denoise.

    Wider filters correlate the noise of neighbouring pixels, and the denoiser keeps it. Albedo and normals of the first
    hits preserve textures and edges. Denoised pictures are biased: do not compare them or use them as references.

    Parameters
    ----------
    scene : path of an XML file, dictionary, or mi.Scene
        As of `studio_scene` and `usd_scene`. A loaded scene must have the box filter. A variant of Mitsuba must be set.
    spp : int, optional
        Samples per pixel; by default those of the scene.
    seed : int
    parameters : dict, optional
        Values for parameters of an XML file.

    Returns
    -------
    (height, width, channels) float32
        Linear; channels after R, G and B are as rendered.

    Raises
    ------
    ValueError
        If the package mitsuba-oidn is missing, or the film has no R, G and B.
    RegressionError
        If there is no such scene, or a loaded one has another filter.
    """
    require_denoiser()
    loaded = load_scene(scene, parameters, BOX)
    return denoised(loaded, render_image(loaded, spp or loaded.sensor.sampler().sample_count(), seed), seed)


def denoised(loaded: LoadedScene, pixels: NDArray[np.float32], seed: int = 0) -> NDArray[np.float32]:
    """Remove the noise of a picture ``(height, width, channels)`` rendered with the box filter.

    Raises ValueError if the picture has no R, G and B.
    """
    import mitsuba_oidn

    if pixels.ndim != 3 or pixels.shape[2] < 3:
        raise ValueError(f'the film has the shape {pixels.shape}; expected R, G, B to denoise: pixel_format "rgb"')
    integrator = mi.load_dict({"type": "aov", "aovs": _AUXILIARY})
    auxiliary = render_pixels(loaded.scene, seed, AUXILIARY_SPP, sensor=loaded.sensor_index, integrator=integrator)
    color, albedo, normal = map(np.ascontiguousarray, (pixels[..., :3], auxiliary[..., -6:-3], auxiliary[..., -3:]))
    clean = np.array(pixels)
    clean[..., :3] = mitsuba_oidn.denoise(color, albedo, normal, hdr=True, clean_aux=True)
    return clean
