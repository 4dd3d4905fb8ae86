"""The studio: a camera that frames a model, soft lights and a seamless backdrop, as entries of a Mitsuba scene."""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..cage import CageSource, ControlCage, in_digits, warn
from ..evaluation.equations import times_matrix
from ..mitsuba_mesh import box_corners
from ..shapes.foreground import FOREGROUND
from ..variants import SceneNode

# Azimuth and elevation in degrees. Azimuth 0 is the model's front, 90 its own left, which is +x.
VIEWS = {
    "front": (0.0, 0.0), "side": (90.0, 0.0), "back": (180.0, 0.0), "top": (0.0, 90.0), "three-quarter": (35.0, 18.0),
}  # fmt: skip
DEFAULT_VIEW = "three-quarter"
UP_AXES = ("y", "z")
View = str | Sequence[float]
# Field of view of the picture's longer side, in degrees: as of long lenses for products and portraits.
FIELD_OF_VIEW = 28.0
MARGIN = 0.08  # Empty part of the picture on each side
# Least distance of the nearest point, relative to the model's depth: the furthest point looks a fifth as large.
NEAREST = 0.25
DEFAULT_SIZE, DEFAULT_SPP, LARGEST_SIDE = (640, 480), 64, 1 << 14
SIZES = (1e-9, 5e8)  # Measured range of sizes that Mitsuba renders alike: it squares lengths in single precision
# Largest side of models to enlarge, and least side after that: Mitsuba offsets rays by 9e-5 of a unit.
SMALL, LARGE_ENOUGH = 1.0, 8.0
LARGEST_BOX = 1e37  # Side of the largest box that is finite in single precision
# Position (right, back, up) and half sides in radii of the model, radiance, and sampling weight of least noise.
LIGHTS = {
    "key_light": ((-4.4, -1.9, 4.4), (1.5, 1.5), (16.0, 15.4, 14.6), 3.0),
    "fill_light": ((5.5, -4.0, 1.6), (2.5, 2.5), (0.55, 0.58, 0.62), 0.25),
    "rim_light": ((3.6, 4.4, 3.8), (1.6, 1.6), (8.5, 9.0, 9.6), 2.0),
}
STUDIO = (*LIGHTS, "ambient_light", "ground")
ENVIRONMENT = "environment"
RIG = (*LIGHTS, "ground", ENVIRONMENT)  # Entries that turn with the camera
AMBIENT, BACKDROP_COLOUR = (0.17, 0.175, 0.185), (0.30, 0.305, 0.315)
# Types of Mitsuba's integrator `aov`, by names of Mitsuba, Hydra and other renderers.
AOVS = {name: name for name in ("albedo", "depth", "position", "uv", "geo_normal", "sh_normal", "dp_du", "dp_dv")}
AOVS |= {name: name for name in ("duv_dx", "duv_dy", "prim_index", "shape_index")}
AOVS |= {"normal": "sh_normal", "normals": "sh_normal", "N": "sh_normal", "Ng": "geo_normal", "P": "position"}
AOVS |= {"z": "depth", "st": "uv", "primId": "shape_index", "instanceId": "shape_index", "elementId": "prim_index"}
LENGTHS = ("depth", "position", "dp_du", "dp_dv")
# Distances in radii: of the backdrop's bend and wall from the model's middle, and of the floor from the model.
BEND, WALL, GAP = 1.6, 7.0, 0.003


@dataclass(frozen=True)
class Look:
    """Display options of a model or a stage."""

    view: View = DEFAULT_VIEW  # str or (azimuth, elevation) of the studio's camera
    # Width and height in pixels; None for those of a stage's render settings or camera, or 640 by 480
    size: tuple[int, int] | None = None
    spp: int | None = None  # Samples per pixel; None for those of a stage's render settings, or 64
    up: str | None = None  # Up axis of a cage; None for its file's
    rate: int | None = None  # Segments on each edge of a cage; None for as many as a picture needs
    shading: str = "vertex"  # Of a cage
    checker: bool = False  # Whether a checkerboard shows texture coordinates
    cage: bool = False  # Whether the control cage is shown over its surface
    texture_size: int | None = None  # Most pixels along a side of a stage's textures; None for no limit
    transparent: bool = False  # Whether the picture has alpha and no background
    has_studio: bool = True  # Whether the studio adds missing lights, and a backdrop
    scales: bool = False  # Whether small models are enlarged, see `enlargement`
    # Latitude-longitude environment map, which replaces all lights and the backdrop; its rotation about the up axis, in
    # degrees, counter-clockwise seen from above; and a factor of its radiance
    environment: Path | None = None
    turn: float = 0.0
    strength: float = 1.0
    # Types of Mitsuba's AOVs by channel names, besides those of a stage; None for no AOVs at all
    aovs: Mapping[str, str] | None = None


def enlargement(size: float) -> float:
    """Factor of all lengths, a power of two, for a model of a given largest side: 1 unless it is small."""
    return 2.0 ** math.ceil(math.log2(LARGE_ENOUGH / size)) if 0 < size < SMALL else 1.0


def studio(
    bounds: ArrayLike,  # (2, 3): least and greatest coordinates of the model in world space
    *,
    up: str = "z",  # Up axis of the world: "z" or "y"
    # As for `studio_scene`
    view: View = DEFAULT_VIEW,
    size: tuple[int, int] = DEFAULT_SIZE,
    spp: int | None = DEFAULT_SPP,
    # (n, 3): points of the model in world space that the camera frames; by default, the box.
    points: ArrayLike | None = None,
    name: str | None = None,  # Of the model or its file, for messages
) -> SceneNode:
    """Entries of a scene around a model: "integrator", "sensor", lights and, in views from above, "ground".

    A variant of Mitsuba must be set. The studio has the model's size, and its lights turn with the camera. In views
    from below there is no floor, and lights come from below. Raises ValueError if no variant is set, or an argument is
    invalid. Warns if Mitsuba's single precision cannot render the size of the model.
    """
    variant_in_use()
    prefix = "" if name is None else f"{name}: "
    box = _checked_bounds(bounds, prefix)
    if len(size) != 2 or not all(isinstance(side, numbers.Integral) and 1 <= side <= LARGEST_SIDE for side in size):
        raise ValueError(f"size {size!r}; expected width and height, 1 to {LARGEST_SIDE} pixels")
    spp = DEFAULT_SPP if spp is None else spp
    if not isinstance(spp, numbers.Integral) or spp < 1:
        raise ValueError(f"spp {spp!r}; expected 1 or more samples per pixel")
    azimuth, elevation = angles_of(view)
    axes = studio_axes(up)
    in_world = box_corners(box) if points is None else np.asarray(points, dtype=np.float64).reshape(-1, 3)
    low, high = np.sort(box @ axes, axis=0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low) / 2)
    if not SIZES[0] < 2 * radius < SIZES[1]:
        expected = f"{SIZES[0]:g} to {SIZES[1]:g}, beyond which Mitsuba's single precision loses light and surfaces"
        warn(f"{prefix}a model {in_digits(2 * radius)} units large; expected {expected}")
    origin, distance = framed(times_matrix(in_world[None], axes)[0], azimuth, elevation, size)
    right, up_in_picture, forward = (axes @ camera_axes(azimuth, elevation)).T
    from_below = elevation < 0
    scene: SceneNode = {
        "integrator": {"type": "path", "max_depth": 6},
        "sensor": {
            "type": "perspective",
            "fov": FIELD_OF_VIEW,
            "fov_axis": "larger",
            "near_clip": 1e-3 * distance,
            "far_clip": 100 * (distance + radius),
            # In Mitsuba's cameras, x points to the left.
            "to_world": _transform(np.stack([-right, up_in_picture, forward], axis=1), axes @ origin),
            "film": {"type": "hdrfilm", "width": int(size[0]), "height": int(size[1]), "component_format": "float32"},
            "sampler": sampler(int(spp)),
        },
    }
    rig = axes @ turned(azimuth) @ np.diag([1.0, 1.0, -1.0 if from_below else 1.0])
    for light, (position, half_sides, radiance, weight) in LIGHTS.items():
        place = axes @ middle + radius * rig @ np.array(position)
        placed = mi.ScalarTransform4f().look_at(place.tolist(), (axes @ middle).tolist(), axes[:, 2].tolist())
        scale = mi.ScalarTransform4f().scale([radius * half_sides[0], radius * half_sides[1], 1.0])
        emitter = {"type": "area", "radiance": _rgb(radiance), "sampling_weight": weight}
        scene[light] = {"type": "rectangle", "to_world": placed @ scale, "emitter": emitter}
    scene["ambient_light"] = {"type": "constant", "radiance": _rgb(AMBIENT), "sampling_weight": 0.6}
    if not from_below:
        # The camera stands on the floor and sees neither its sides nor the top of the wall, at any distance.
        sweep = _backdrop(BEND * radius, WALL * radius, distance + WALL * radius)
        scene["ground"] = {
            "type": "subdivision",
            **sweep.as_properties(mi),
            "to_world": _transform(rig, axes @ np.array([*middle[:2], low[2] - GAP * radius])),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _rgb(BACKDROP_COLOUR)}},
        }
    return scene


def finished(scene: SceneNode, look: Look, up: str) -> SceneNode:
    """A scene with the environment, AOVs and background of a look."""
    has_backdrop = look.environment is None and look.has_studio
    left: tuple[str, ...] = ("ground",) * look.transparent if has_backdrop else STUDIO
    scene = {name: entry for name, entry in scene.items() if name not in left}
    if look.environment is not None:
        to_world = _transform(studio_axes(up) @ turned(look.turn) @ studio_axes("y").T, np.zeros(3))
        picture = {"filename": str(look.environment.resolve()), "scale": look.strength}
        scene[ENVIRONMENT] = {"type": "envmap", **picture, "to_world": to_world}
    scene = _without_background(scene) if look.transparent else scene
    aovs = ",".join(f"{name}:{kind}" for name, kind in (look.aovs or {}).items())
    return {**scene, "integrator": {"type": "aov", "aovs": aovs, "image": scene["integrator"]}} if aovs else scene


def _without_background(scene: SceneNode) -> SceneNode:
    hidden = {**scene["integrator"], "hide_emitters": True}
    if any(map(_is_glowing_mesh, scene.values())):
        hidden = {"type": FOREGROUND, "hidden": hidden, "shown": scene["integrator"]}
    film = {**scene["sensor"]["film"], "pixel_format": "rgba"}
    return {**scene, "integrator": hidden, "sensor": {**scene["sensor"], "film": film}}


def _is_glowing_mesh(entry: Any) -> bool:
    if isinstance(entry, mi.Shape):
        return entry.is_emitter() and entry.is_mesh()
    return isinstance(entry, dict) and "emitter" in entry and entry["type"] in ("subdivision", "ply")


def framed(
    points: NDArray[np.float64], azimuth: float, elevation: float, size: tuple[int, int]
) -> tuple[NDArray[np.float64], float]:
    """Place a camera so that points fill its image, centred, up to `MARGIN`; models deeper than wide are smaller.

    Returns its place, like the points ``(n, 3)`` in the studio's axes, and its distance from their middle, along the
    view.
    """
    axes = camera_axes(azimuth, elevation)
    in_camera = times_matrix(points[None], axes)[0]
    z = in_camera[:, 2]
    nearest, middle = [], []
    for along, slope in zip(in_camera.T[:2], _slopes(size), strict=True):
        above, below = (along - slope * z).max(), (-along - slope * z).max()
        nearest.append(-(above + below) / (2 * slope))
        middle.append((above - below) / 2)
    # A nearer camera would distort models that are long along the view, or lie inside a thin tip.
    depth = min(*nearest, z.min() - NEAREST * (z.max() - z.min()))
    return axes @ np.array([*middle, depth]), float((z.min() + z.max()) / 2 - depth)


def outermost(points: NDArray[np.float64], up: str, view: View, size: tuple[int, int]) -> NDArray[np.float64]:
    """Subset of world-space points with the same bounds and the same camera of `framed`."""
    x, y = _slopes(size)
    # Normals of the sides of the view frustum, its direction, and the axes.
    towards = np.array([[1, 0, -x], [-1, 0, -x], [0, 1, -y], [0, -1, -y], [0, 0, 1], [0, 0, -1]])
    directions = np.concatenate([towards @ camera_axes(*angles_of(view)).T, np.eye(3), -np.eye(3)])
    return points[np.unique((points @ studio_axes(up) @ directions.T).argmax(axis=0))]


def _slopes(size: tuple[int, int]) -> NDArray[np.float64]:
    """Horizontal and vertical half extents of the view frustum within its margin, per unit of depth."""
    return np.tan(np.radians(FIELD_OF_VIEW / 2)) * np.array(size) / max(size) * (1 - 2 * MARGIN)


def camera_axes(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Columns right, up and forward ``(3, 3)``, in the studio's axes."""
    a, e = np.radians([azimuth, elevation])
    right = np.array([np.cos(a), np.sin(a), 0.0])
    forward = np.array([-np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), -np.sin(e)])
    return np.stack([right, np.cross(right, forward), forward], axis=1)


def angles_of(view: View) -> tuple[float, float]:
    """Azimuth and elevation in degrees of a view: a name in `VIEWS`, or two angles.

    Raises ValueError if there is no such view, or the elevation is not between -90 and 90.
    """
    if isinstance(view, str):
        if view not in VIEWS:
            raise ValueError(f'view "{view}"; expected one of {", ".join(VIEWS)}, or azimuth and elevation')
        return VIEWS[view]
    if len(view) != 2 or not all(isinstance(angle, numbers.Real) and np.isfinite(angle) for angle in view):
        raise ValueError(f"view {view!r}; expected one of {', '.join(VIEWS)}, or azimuth and elevation in degrees")
    azimuth, elevation = map(float, view)
    if not -90 <= elevation <= 90:
        raise ValueError(f"elevation {in_digits(elevation)}; expected -90 to 90 degrees")
    return azimuth, elevation


def studio_axes(up: str) -> NDArray[np.float64]:
    """Axes of the studio in the world: columns right, back and up ``(3, 3)``, for a viewer in front.

    As in modelling programs, the front is -y if z is up, +z if y is up. Raises ValueError for any other axis.
    """
    if up not in UP_AXES:
        raise ValueError(f'up axis "{up}"; expected {" or ".join(UP_AXES)}')
    return np.eye(3) if up == "z" else np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def turned(azimuth: float) -> NDArray[np.float64]:
    """Rotation ``(3, 3)`` about the studio's up axis, by degrees, counter-clockwise seen from above."""
    c, s = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def sampler(spp: int) -> SceneNode:
    """Entry of a well-stratified sampler with at least this many samples.

    Samples fill a grid: 32 become 5 times 7. Mitsuba would do so with a warning.
    """
    rows = math.isqrt(spp)
    return {"type": "multijitter", "sample_count": -(-spp // rows) * rows}


def variant_in_use() -> str:
    """The current variant of Mitsuba. Raises ValueError if none is."""
    variant = mi.variant()
    if variant is None:
        raise ValueError('no variant of Mitsuba is set; expected one, such as by mi.set_variant("llvm_ad_rgb")')
    return variant


def _transform(linear: NDArray[np.float64], origin: NDArray[np.float64]) -> mi.ScalarTransform4f:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, origin
    return mi.ScalarTransform4f(matrix.tolist())


def _rgb(value: tuple[float, ...]) -> SceneNode:
    return {"type": "rgb", "value": list(value)}


def _checked_bounds(bounds: ArrayLike, prefix: str) -> NDArray[np.float64]:
    box = np.asarray(bounds, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all():
        raise ValueError(f"{prefix}bounds of shape {box.shape}; expected (2, 3), all finite")
    size = box[1] - box[0]
    if not size.min() >= 0 or not 0 < size.max() < LARGEST_BOX:
        extent = f"{in_digits(box[0])} to {in_digits(box[1])}"
        raise ValueError(f"{prefix}bounds from {extent}; expected a box with a size, below {LARGEST_BOX:g}")
    return box


def _backdrop(bend: float, wall: float, extent: float) -> ControlCage:
    """Cage of a sweep across the x axis: a floor at z = 0 that bends at a y, and rises to an upright wall at another.

    The wall begins at the height ``wall - bend``; floor and wall reach further than the extent on all sides.
    """
    # A cubic spline is straight along four collinear control points.
    step = wall - bend
    floor = [[-1.5 * extent, 0], [bend - step, 0], [bend, 0]]
    profile = np.array([*floor, [wall, 0], [wall, step], [wall, 2 * step], [wall, 2 * wall + extent]])
    positions = np.concatenate([np.insert(profile, 0, x, axis=1) for x in (-2 * extent, 2 * extent)])
    left = np.arange(len(profile) - 1)
    right = left + len(profile)
    return ControlCage(positions, np.stack([left, right, right + 1, left + 1], axis=1), source=CageSource("backdrop"))
