"""Lights and the camera of a stage as Mitsuba's emitters and sensor; those of the studio for stages without them."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.studio import DEFAULT_SIZE, DEFAULT_SPP, ENVIRONMENT, STUDIO, Look, View, sampler, studio
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .bsdfs import integrator, rgb
from .contents import WHOLE, CameraContents, LightContents, PictureContents, SceneContents
from .stage_warnings import StageWarnings
from .textures import Textures

# From Mitsuba's environments, whose pole is y, to domes with the pole z.
_POLE_TO_Z = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_TURNED = np.diag([-1.0, 1, -1, 1])  # From lights and cameras of Mitsuba, along z, to those of USD, along -z
_LEAST_SOFTNESS = 1e-3  # Least softness of a cone, as Mitsuba divides by it
_LEAST_NEAR = 1e-6
NO_BLUR = "shutters of cameras have no effect without the option --shutter of render"
WIDTH = 640  # Default width of pictures by a stage's camera, in pixels
RESERVED = ("integrator", "sensor", *STUDIO, ENVIRONMENT)
_LEAST_SIZE = 1e-6  # Minimum half-extent of the framed content, relative to its position


def emitter(light: LightContents, textures: Textures) -> SceneNode:
    """An emitter, or a shape with an emitter."""
    textured = _TEXTURED.get(light.kind)
    return _UNTEXTURED[light.kind](light) if textured is None else textured(light, textures)


def _distant(light: LightContents) -> SceneNode:
    angle = math.radians(min(light.size[0], 180.0))
    irradiance = np.array(light.emission)
    if angle > 0 and not light.is_normalized:
        irradiance = irradiance * math.pi * math.sin(angle / 2) ** 2  # Radiance times the projected solid angle
    direction = -light.to_world[:3, 2]
    direction /= np.linalg.norm(direction)
    return {"type": "directional", "direction": direction.tolist(), "irradiance": rgb(irradiance)}


def _flat(light: LightContents, textures: Textures) -> SceneNode:
    is_rect = light.kind == "rect"
    u, v = np.array(light.size) / 2 if is_rect else np.repeat(light.size, 2)
    area = _area(light, (4 if is_rect else math.pi) * u * v * _stretch(light.to_world, 0, 1))
    bitmap = None if light.texture is None else textures.radiance(light.texture, area["radiance"]["value"])
    if bitmap is not None:
        # The image is upright as seen from the front of the light.
        upright = mi.ScalarAffineTransform3f([[1, 0, 0], [0, -1, 1], [0, 0, 1]])
        area["radiance"] = {"type": "bitmap", "bitmap": bitmap, "to_uv": upright, "wrap_mode": "clamp"}
    to_world = mi.ScalarTransform4f((light.to_world @ _TURNED @ np.diag([u, v, 1, 1])).tolist())
    return {"type": "rectangle" if is_rect else "disk", "to_world": to_world, "emitter": area}


def _sphere(light: LightContents) -> SceneNode:
    radius, center = _world_radius(light), light.to_world[:3, 3].tolist()
    return {"type": "sphere", "center": center, "radius": radius, "emitter": _area(light, 4 * math.pi * radius**2)}


def _point(light: LightContents) -> SceneNode:
    # Intensity of a sphere from afar; independent of the radius of a normalized one.
    intensity = np.array(light.emission) * (0.25 if light.is_normalized else math.pi * _world_radius(light) ** 2)
    return {"type": "point", "position": light.to_world[:3, 3].tolist(), "intensity": rgb(intensity)}


def _spot(light: LightContents) -> SceneNode:
    _, angle, softness = light.size
    place, forward = light.to_world[:3, 3], -light.to_world[:3, 2]
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at(place, place + forward, light.to_world[:3, 1]),
        "intensity": _point(light)["intensity"],
        "cutoff_angle": angle,
        "beam_width": angle * (1 - np.clip(softness, _LEAST_SOFTNESS, 1)),
    }


def _cylinder(light: LightContents) -> SceneNode:
    length = light.size[0]
    radius = light.size[1] * math.sqrt(_stretch(light.to_world, 1, 2))
    start, end = ((light.to_world @ [x, 0, 0, 1])[:3] for x in (-length / 2, length / 2))
    area = _area(light, 2 * math.pi * radius * float(np.linalg.norm(end - start)))
    return {"type": "cylinder", "p0": start.tolist(), "p1": end.tolist(), "radius": radius, "emitter": area}


def _dome(light: LightContents, textures: Textures) -> SceneNode:
    radiance = np.array(light.emission)
    bitmap = None if light.texture is None else textures.radiance(light.texture, radiance)
    if bitmap is None:
        return {"type": "constant", "radiance": rgb(radiance)}
    turned = light.to_world @ (_POLE_TO_Z if light.pole == "z" else np.eye(4))
    turned[:3, 3] = 0
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(turned.tolist())}


_TEXTURED = {"rect": _flat, "disk": _flat, "dome": _dome}
_UNTEXTURED = {"distant": _distant, "sphere": _sphere, "point": _point, "spot": _spot, "cylinder": _cylinder}


def one_environment(lights: list[LightContents], notes: StageWarnings) -> list[LightContents]:
    """The lights with at most one dome, the first with a texture, as Mitsuba's scenes have one environment."""
    domes = [light for light in lights if light.kind == "dome"]
    left = sorted(domes, key=lambda light: not light.texture)[1:]
    for light in left:
        notes.add("further dome lights are ignored; a scene of Mitsuba has one environment", light.name)
    return [light for light in lights if light not in left]


def are_lamps_in_the_way(lights: list[LightContents], points: NDArray[np.float64]) -> bool:
    """Whether bounding spheres of lights come between points ``(n, 3)`` and other lights.

    A dome without a texture does not count: paths that a BSDF samples find it behind clear shapes.
    """
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = np.linalg.norm(points - middle, axis=1).max()
    sources = [light for light in lights if light.kind != "dome" or light.texture is not None]
    for lamp in (light for light in lights if light.kind in ("rect", "disk", "sphere", "cylinder")):
        place = lamp.to_world[:3, 3]
        for other in (source for source in sources if source is not lamp):
            if other.kind == "dome":
                return True
            start, start_radius = other.to_world[:3, 3], _bounding_radius(other)
            if other.kind == "distant":
                towards = other.to_world[:3, 2] / np.linalg.norm(other.to_world[:3, 2])
                start, start_radius = middle + towards * (radius + np.linalg.norm(place - middle)), radius
            # The cone around the other light and the points, at the nearest place of its axis to the lamp.
            axis = middle - start
            along = np.clip((place - start) @ axis / max(axis @ axis, 1e-30), 0, 1)
            cone_radius = start_radius + along * (radius - start_radius)
            if np.linalg.norm(place - start - along * axis) < cone_radius + _bounding_radius(lamp):
                return True
    return False


def _bounding_radius(light: LightContents) -> float:
    return float(np.linalg.norm(light.to_world[:3, :3], 2) * np.linalg.norm(light.size))


def _area(light: LightContents, area: float) -> SceneNode:
    radiance = np.array(light.emission) / (area if light.is_normalized and area > 0 else 1)
    return {"type": "area", "radiance": rgb(radiance)}


def _world_radius(light: LightContents) -> float:
    return light.size[0] * abs(float(np.linalg.det(light.to_world[:3, :3]))) ** (1 / 3)


def _stretch(to_world: NDArray[np.float64], first: int, second: int) -> float:
    """Factor by which a transform scales areas spanned by two axes."""
    return float(np.linalg.norm(np.cross(to_world[:3, first], to_world[:3, second])))


def sensor(
    camera: CameraContents, size: tuple[int, int], picture: PictureContents, spp: int | None, notes: StageWarnings
) -> SceneNode:
    """A sensor with a film (width, height) of the camera's aperture, and the authored parameters of Mitsuba."""
    own, stated = _sensor(camera, size, spp, notes), camera.mitsuba
    stated = {**own, **stated, "film": {**own["film"], **stated.get("film", {})}} if stated else own
    return cropped(_accepted(stated, own, "mitsuba:sensor", camera.name, notes), picture.window)


def _accepted(stated: SceneNode, own: SceneNode, what: str, prim: str, notes: StageWarnings) -> SceneNode:
    """The authored entry, or else the default, with a warning, if Mitsuba cannot load it."""
    try:
        return stated if stated is own or mi.load_dict(stated) else own
    except RuntimeError as error:
        notes.add(f"{what} is ignored: {' '.join(str(error).partition(': ')[2].split())}", prim)
        return own


def cropped(sensor: SceneNode, window: list[float]) -> SceneNode:
    """A sensor that renders the pixels with centres in a window; see `PictureContents`."""
    film, (left, below, right, above) = sensor["film"], window
    if window == WHOLE:
        return sensor
    size = [film.get("crop_width", film["width"]), film.get("crop_height", film["height"])]
    first, end = np.ceil(np.multiply(size, [[left, 1 - above], [right, 1 - below]]) - 0.5).astype(int)
    offset = np.add(first, [film.get("crop_offset_x", 0), film.get("crop_offset_y", 0)])
    numbers = [*np.maximum(end - first, 1).tolist(), *offset.tolist()]
    names = ("crop_width", "crop_height", "crop_offset_x", "crop_offset_y")
    return {**sensor, "film": {**film, **dict(zip(names, numbers, strict=True))}}


def _sensor(camera: CameraContents, size: tuple[int, int], spp: int | None, notes: StageWarnings) -> SceneNode:
    width, height = size
    wide, high = _film_window(camera, width / height)
    # Planes of orthographic cameras may lie behind them.
    back = 0.0 if camera.is_perspective else max(-camera.near, 0.0)
    near, far = max(camera.near + back, _LEAST_NEAR), camera.far + back
    if camera.shutter[0] < camera.shutter[1]:
        notes.add(NO_BLUR, camera.name)
    film = {"type": "hdrfilm", "width": width, "height": height, "component_format": "float32"}
    clip = {"near_clip": near, "far_clip": max(far, 2 * near)}
    common: SceneNode = {**clip, "film": film, "sampler": sampler(spp or DEFAULT_SPP)}
    if not camera.is_perspective:
        matrix = camera.to_world.copy()
        matrix[:3, 3] += matrix[:3, :3] @ [*camera.offset, back]
        matrix = matrix @ np.diag([-wide / 2, wide / 2, -1, 1])
        return {"type": "orthographic", "to_world": mi.ScalarTransform4f(matrix.tolist()), **common}
    common["to_world"] = mi.ScalarTransform4f((camera.to_world @ _TURNED).tolist())
    if camera.lens_radius == 0:
        x, y = camera.offset[0] / wide, -camera.offset[1] / high  # As parts of the film's sides, y down
        offset = {"principal_point_offset_x": x, "principal_point_offset_y": y} if x or y else {}
        return {"type": "perspective", **offset, **common, **_field_of_view(wide, camera)}
    # A thin lens has no principal point: the film is a window of a larger one with its middle on the axis.
    sides = zip(size, camera.offset, (wide, high), strict=True)
    halves = [round(2 * pixels * offset / length) for pixels, offset, length in sides]
    full = width + abs(halves[0]), height + abs(halves[1])
    if any(halves):
        crop = {"crop_width": width, "crop_height": height}
        crop |= {"crop_offset_x": max(halves[0], 0), "crop_offset_y": max(-halves[1], 0)}
        common["film"] = {**film, "width": full[0], "height": full[1], **crop}
    lens = {"aperture_radius": camera.lens_radius, "focus_distance": camera.focus_distance}
    return {"type": "thinlens", **lens, **common, **_field_of_view(wide * full[0] / width, camera)}


def _film_window(camera: CameraContents, aspect_ratio: float) -> tuple[float, float]:
    """Width and height of a camera's film in its unit, by the policy that fits its aperture to a picture."""
    wide, of_height = camera.aperture[0], camera.aperture[1] * aspect_ratio
    wide = {
        "expandAperture": max(wide, of_height),
        "cropAperture": min(wide, of_height),
        "adjustApertureWidth": of_height,
        "adjustApertureHeight": wide,
    }[camera.conform_policy]
    return wide, wide / aspect_ratio


def _field_of_view(wide: float, camera: CameraContents) -> SceneNode:
    return {"fov": math.degrees(2 * math.atan(wide / (2 * camera.focal_length))), "fov_axis": "x"}


def size_for(contents: SceneContents, look: Look) -> tuple[int, int]:
    """Size of the film: of the look, of the render settings, or 640 pixels by the aspect ratio of the aperture."""
    stated = look.size or contents.picture.resolution
    if stated is not None or contents.camera is None:
        return stated or DEFAULT_SIZE
    wide, high = contents.camera.aperture
    return WIDTH, max(1, round(WIDTH * high / wide))


def angles_for(contents: SceneContents, look: Look) -> View:
    """Azimuth and elevation of a stage's camera, with which the studio's lights turn."""
    if contents.camera is None:
        return look.view
    back = contents.camera.to_world[:3, 2]
    right, behind, above = back if contents.up == "z" else (back[0], -back[2], back[1])
    return math.degrees(math.atan2(right, -behind)), math.degrees(math.asin(np.clip(above, -1, 1)))


def with_studio_defaults(
    contents: SceneContents, points: NDArray[np.float64], is_lit: bool, look: Look, notes: StageWarnings, name: str
) -> SceneNode:
    """Entries of integrator and sensor, and of missing lights or camera from the studio, around points."""
    camera, size = contents.camera, size_for(contents, look)
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    if (bounds[0] == bounds[1]).all():
        bounds += np.array([[-1], [1]]) * _LEAST_SIZE * (1 + np.abs(bounds).max())
    view = angles_for(contents, look)
    entries = studio(bounds, up=contents.up, view=view, size=size, spp=look.spp, points=points, name=name)
    has_clear_lamps = are_lamps_in_the_way(contents.lights, points)
    scene = {"integrator": integrator(contents.materials, entries["integrator"], has_clear_lamps=has_clear_lamps)}
    if stated := contents.picture.integrator:
        own = scene["integrator"]
        stated = stated if stated.get("type", own["type"]) != own["type"] else {**own, **stated}
        scene["integrator"] = _accepted(stated, own, "mitsuba:integrator", contents.picture.name, notes)
    seen = cropped(entries["sensor"], contents.picture.window)
    scene["sensor"] = seen if camera is None else sensor(camera, size, contents.picture, look.spp, notes)
    if is_lit:
        return scene
    for name in (name for name in STUDIO if name in entries and (camera is None or name != "ground")):
        # A stage's camera may be so far away that it would see the lights of a studio.
        is_near = camera is not None and entries[name]["type"] == "rectangle"
        scene[name] = _distant_light(entries[name], bounds.mean(axis=0)) if is_near else entries[name]
    return scene


def _distant_light(light: SceneNode, target: NDArray[np.float64]) -> SceneNode:
    matrix = np.array(light["to_world"].matrix, dtype=np.float64)
    towards = target - matrix[:3, 3]
    distance = np.linalg.norm(towards)
    area = 4 * np.linalg.norm(np.cross(matrix[:3, 0], matrix[:3, 1]))
    irradiance = np.array(light["emitter"]["radiance"]["value"]) * area / distance**2
    return {"type": "directional", "direction": (towards / distance).tolist(), "irradiance": rgb(irradiance)}
