"""Detail of a picture: triangles of limit surfaces and pixels of textures that suffice for it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_subdivision import studio
from mitsuba_subdivision.cage import CageContents, CageError, ControlCage
from mitsuba_subdivision.mesh import IntArray, Topology
from mitsuba_subdivision.schemes import SchemeError
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .bsdfs import heights
from .contents import NodeContents, SceneContents, ShapeContents, TextureContents, leaves
from .scene_entries import Surfaces
from .stage_warnings import StageWarnings
from .textures import Textures, samples_elsewhere

TEXELS_PER_PIXEL = 2.0  # Texels for each pixel: filters see details of half a pixel, and glass magnifies
# Quantile of edges, as a few may have collapsed in the texture; quantile of texels; most edges that are measured.
_EDGE_QUANTILE, _TEXEL_QUANTILE, _MOST_SAMPLES = 0.95, 0.99, 20_000
# Outlines of sensors and the distances of their near planes; see `outline_for`.
Views = Sequence[tuple[SceneNode, float]]
_CONSTANT = "vertex_constant_displacement"  # Attribute of shapes whose displacement is constant


def with_rate(parameters: dict[str, Any], contents: SceneContents) -> dict[str, Any]:
    """Parameters of every limit surface, with the default number of segments on each edge."""
    if is_chosen(parameters):
        return parameters
    corners = sum(int(shape.cage.face_sizes.sum()) for shape in contents.all_shapes if shape.cage.scheme is not None)
    # A quadrilateral has four corners, and two triangles for each square of the rate.
    most = math.sqrt(2 * studio.MOST_TRIANGLES / max(corners, 1))
    return {**parameters, "tessellation_rate": int(np.clip(most, 1, studio.MOST_SEGMENTS))}


def is_chosen(parameters: dict[str, Any]) -> bool:
    """Whether parameters determine the tessellation."""
    return bool({"tessellation_rate", "tessellation"} & parameters.keys())


def triangles_for_picture(
    contents: SceneContents,
    segments: Mapping[ShapeContents, IntArray],  # dict of (n,) int array by shape: see `segments_of`
    outline: SceneNode,  # Of the sensor; see `outline_for`
    parameters: dict[str, Any],  # Of every limit surface, with the shading and the highest uniform rate
    *,
    follows_sensor: bool = True,  # Whether no other sensor renders the scene
) -> dict[ShapeContents, dict[str, Any]]:
    """Parameters of usable limit surfaces with the fewest triangles and no visible facets in an image.

    With exact shading, surfaces outside groups may be adaptive, unless they are displaced: their outline is unknown.
    """
    most = parameters["tessellation_rate"]
    needed = {shape: int(segments[shape].max()) for shape in contents.all_shapes if shape in segments}
    chosen: dict[ShapeContents, dict[str, Any]] = {
        shape: {"tessellation_rate": rate if shape.is_displaced else min(rate, most)} for shape, rate in needed.items()
    }
    if needed and parameters["shading"] == "exact" and follows_sensor and "displacement" not in parameters:
        corners = {shape: int(shape.cage.face_sizes.sum()) for shape in needed}
        highest = studio.highest_rate(np.array([*needed.values()]), np.array([*corners.values()]))
        for shape in contents.shapes:
            if shape in needed and not shape.is_displaced:
                chosen[shape] = studio.triangles_for(needed[shape], corners[shape], most, outline, highest)
    return chosen


def segments_of(
    contents: SceneContents, surfaces: Surfaces, outline: SceneNode, near_clip: float, shading: str
) -> dict[ShapeContents, IntArray]:
    """Segments on each edge that a picture needs, ``(n,)``, for each placement of usable limit surfaces."""
    placements = {shape: matrices for shape, matrices in contents.placements.items() if shape.cage.scheme is not None}
    of_cage: dict[ControlCage, list[ShapeContents]] = {}
    for shape in placements:
        with suppress(CageError, SchemeError):
            of_cage.setdefault(surfaces.of(shape.cage).cage, []).append(shape)
    needed: dict[ShapeContents, IntArray] = {}
    for cage, alike in of_cage.items():
        copies = np.concatenate([placements[shape] for shape in alike])
        counts = [len(placements[shape]) for shape in alike]
        segments = np.split(studio.segments_for(cage, copies, outline, near_clip, shading), np.cumsum(counts)[:-1])
        needed |= dict(zip(alike, segments, strict=True))
    return needed


def texels_for_pictures(contents: SceneContents, sensors: Sequence[SceneNode]) -> dict[str, float]:
    """Largest useful number of pixels along the sides of each image file, or of its tiles, for pictures by sensors.

    Files of unknown detail are missing, or infinite.
    """
    seen = [(studio.outline_for(sensor), sensor["near_clip"]) for sensor in sensors]
    needed: dict[str, float] = {}
    for shape, copies in contents.placements.items():
        if shape.material is None:
            continue
        lengths, in_texture = (np.linalg.norm(vectors, axis=1) for vectors in _edges(shape.cage))
        there, texels = in_texture > 0, np.inf
        if there.any():
            scale = float(np.quantile(lengths[there] / in_texture[there], _EDGE_QUANTILE))
            texels = TEXELS_PER_PIXEL * scale * pixels_of(shape.cage, copies, seen)
        inputs = shape.material.inputs.values()
        # Images at computed texture coordinates have an unknown detail.
        known = [given for given in inputs if not (isinstance(given, NodeContents) and samples_elsewhere(given))]
        for texture in (leaf for given in known for leaf in leaves(given)):
            if isinstance(texture, TextureContents):
                # Repetitions of the image along a unit of texture coordinates.
                repeats = np.linalg.norm(texture.to_uv[:2, :2], axis=0).max()
                most = texels / repeats if repeats > 0 else np.inf
                needed[texture.file] = max(most, needed.get(texture.file, 0.0))
    return needed


def _edges(cage: CageContents) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vectors of some edges ``(n, 3)``, and in texture coordinates ``(n, 2)``; none without texture coordinates."""
    if cage.texcoords is None:
        return np.zeros((0, 3)), np.zeros((0, 2))
    corners = np.arange(0, len(cage.face_vertices), 1 + len(cage.face_vertices) // _MOST_SAMPLES)
    topology = Topology(len(cage.positions), cage.face_sizes, cage.face_vertices)
    ends = np.stack([corners, topology.next[corners]])
    vertices, indices = topology.face_vertices[ends], cage.texcoords.indices
    index = vertices if indices is None else np.asarray(indices)[ends]
    pairs = np.asarray(cage.positions, np.float64)[vertices], np.asarray(cage.texcoords.values, np.float64)[index]
    return pairs[0][1] - pairs[0][0], pairs[1][1] - pairs[1][0]


def pixels_of(cage: CageContents, to_world: NDArray[np.float64], seen: Views) -> float:
    """Maximum pixels per unit of a mesh, over its copies ``(n, 4, 4)`` and views."""
    return float(max(studio.pixels_of_copies(cage.positions, to_world, *view).max() for view in seen))


def largest_height(shape: ShapeContents, textures: Textures, notes: StageWarnings) -> float:
    """Largest distance by which a displacement moves a surface, in its space; 0 for textures of Mitsuba's own."""
    given, scale = heights(shape, textures, notes)
    if isinstance(given, float):
        return abs(given * scale)
    is_attribute = given["type"] == "mesh_attribute"
    attribute = shape.cage.attributes[given["name"].removeprefix("vertex_")].values if is_attribute else 0.0
    return float(np.abs(_pixels(given) if "bitmap" in given else attribute).max() * abs(scale))


def _pixels(texture: SceneNode) -> NDArray:
    pixels = np.array(texture["bitmap"])
    return pixels.reshape(pixels.shape[:2]) / (255.0 if pixels.dtype == np.uint8 else 1.0)


def rate_of_heights(cage: CageContents, texture: SceneNode, error: float) -> int:
    """Segments on each edge that follow most heights of a one-channel bitmap within an error."""
    heights = _pixels(texture)
    length = 1  # In texels, powers of two
    while 4 * length <= min(heights.shape):
        away = [np.abs(h[2 * length :] + h[: -2 * length] - 2 * h[length:-length]) / 2 for h in (heights, heights.T)]
        if max(np.quantile(part, _TEXEL_QUANTILE) for part in away) > error:
            break
        length *= 2
    to_texels = np.array(texture["to_uv"].matrix)[:2, :2] * np.array(heights.shape[::-1])[:, None]
    texels = np.abs(_edges(cage)[1] @ to_texels.T).max(axis=1)
    return max(1, math.ceil(float(np.quantile(texels, _EDGE_QUANTILE)) / length))


def with_own_parameters(
    contents: SceneContents,
    chosen: Mapping[ShapeContents, dict[str, Any]],  # Of some limit surfaces
    parameters: dict[str, Any],  # Of other limit surfaces; a displacement replaces the displacements of materials
    sensors: Sequence[SceneNode] | None,  # Sensors of the pictures; empty if they are unknown, None to keep the rates
    textures: Textures,
    notes: StageWarnings,
) -> dict[ShapeContents, dict[str, Any]]:
    """Parameters of limit surfaces with displacements, at rates that show them, or with rates that the stage states."""
    shapes = [shape for shape in contents.all_shapes if shape.is_displaced and "displacement" not in parameters]
    placements = contents.placements if shapes else {}
    corners = sum(len(shape.cage.face_vertices) for shape in shapes)
    highest = min(math.isqrt(2 * studio.MOST_TRIANGLES // max(corners, 1)), studio.HIGHEST_RATE)
    seen = [(studio.outline_for(sensor), sensor["near_clip"]) for sensor in sensors or () if shapes]
    displaced = {**chosen}
    textures.read(texture for shape in shapes if shape.material for texture in shape.material.textures())
    for shape in shapes:
        displaced[shape] = {**chosen.get(shape, parameters), **_displacement(shape, textures, notes)}
        texture = displaced[shape].get("displacement")
        if sensors is not None and shape in placements and texture is not None:
            rate = displaced[shape]["tessellation_rate"]
            if isinstance(texture, str):
                rate = rate if texture == _CONSTANT else max(rate, studio.MOST_SEGMENTS)
            elif "bitmap" not in texture:
                rate = 8 * studio.MOST_SEGMENTS
            else:
                pixels = pixels_of(shape.cage, placements[shape], seen) if seen else np.inf
                rate = max(rate, rate_of_heights(shape.cage, texture, studio.ERRORS[parameters["shading"]] / pixels))
            displaced[shape]["tessellation_rate"] = max(1, min(rate, highest))
    for shape in contents.all_shapes if sensors is not None else ():
        if shape.rate is not None and shape.cage.scheme is not None:
            own = {name: displaced[shape][name] for name in displaced.get(shape, ()) if "displacement" in name}
            displaced[shape] = {**parameters, **own, "tessellation_rate": shape.rate}
    return displaced


def _displacement(shape: ShapeContents, textures: Textures, notes: StageWarnings) -> dict[str, Any]:
    """Parameters of the shape ``subdivision``: a texture, or an attribute, also for a constant."""
    given, scale = heights(shape, textures, notes)
    if isinstance(given, float):
        values = np.full((len(shape.cage.positions), 1), given * scale)
        return {_CONSTANT: mi.TensorXf(values), "displacement": _CONSTANT} if given * scale else {}
    if given["type"] != "mesh_attribute":
        return {"displacement": given}
    return {"displacement": given["name"], "displacement_scale": scale}
