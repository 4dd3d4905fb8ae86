"""What a picture shows: triangles of limit surfaces that suffice for it, and pixels of textures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from mitsuba_subdivision import studio
from mitsuba_subdivision.cage import CageContents, CageError, ControlCage
from mitsuba_subdivision.mesh import IntArray, Topology
from mitsuba_subdivision.mitsuba_mesh import box_corners, points_at
from mitsuba_subdivision.schemes import SchemeError
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .contents import NodeContents, SceneContents, ShapeContents, TextureContents, leaves
from .scene_entries import Surfaces
from .textures import samples_elsewhere

# Texels for each pixel: filters see details of half a pixel, and glass magnifies.
TEXELS_PER_PIXEL = 2.0
# Parts of the edges of a mesh, as a few may have collapsed in the texture, and of texels; and edges that are measured.
_MOST_EDGES, _MOST_TEXELS, _MOST_SAMPLES = 0.95, 0.99, 20_000
# Outlines of sensors and the distances of their near planes; see `outline_for`.
Views = Sequence[tuple[SceneNode, float]]


def with_rate(parameters: dict[str, Any], contents: SceneContents) -> dict[str, Any]:
    """Parameters of every limit surface, with as many segments on each edge as most triangles allow by default."""
    if is_chosen(parameters):
        return parameters
    corners = sum(int(shape.cage.face_sizes.sum()) for shape in contents.all_shapes if shape.cage.scheme is not None)
    # A quadrilateral has four corners, and two triangles for each square of the rate.
    most = math.sqrt(2 * studio.MOST_TRIANGLES / max(corners, 1))
    return {**parameters, "tessellation_rate": int(np.clip(most, 1, studio.MOST_SEGMENTS))}


def is_chosen(parameters: dict[str, Any]) -> bool:
    """Whether the parameters of limit surfaces determine their tessellation."""
    return bool({"tessellation_rate", "tessellation"} & parameters.keys())


def triangles_for_picture(
    contents: SceneContents,
    segments: Mapping[ShapeContents, IntArray],  # dict of (n,) int array by shape: see `segments_of`
    outline: SceneNode,  # Of the sensor; see `outline_for`
    parameters: dict[str, Any],  # Of every limit surface: the shading, and how many segments there are at most
    *,
    follows_sensor: bool = True,  # Whether the scene is rendered by this sensor only
) -> dict[ShapeContents, dict[str, Any]]:
    """Parameters of limit surfaces with the fewest triangles whose facets do not show in an image.

    With exact shading, those outside groups may be adaptive; displaced ones are not, as they have no known outline.
    Cages that cannot be used are missing.
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
    """Segments on each edge that a picture needs, ``(n,)``, of the copies of each usable limit surface.

    See `segments_for`; copies are in the order of ``contents.placed_shapes``.
    """
    of_shape: dict[ShapeContents, list[NDArray[np.float64]]] = {}
    for shape, to_world in contents.placed_shapes:
        if shape.cage.scheme is not None:
            of_shape.setdefault(shape, []).append(to_world)
    of_cage: dict[ControlCage, list[ShapeContents]] = {}
    for shape in of_shape:
        with suppress(CageError, SchemeError):
            of_cage.setdefault(surfaces.of(shape.cage).surface.cage, []).append(shape)
    needed: dict[ShapeContents, IntArray] = {}
    for cage, alike in of_cage.items():
        copies = np.concatenate([of_shape[shape] for shape in alike])
        counts = [len(of_shape[shape]) for shape in alike]
        segments = np.split(studio.segments_for(cage, copies, outline, near_clip, shading), np.cumsum(counts)[:-1])
        needed |= dict(zip(alike, segments, strict=True))
    return needed


def texels_for_pictures(contents: SceneContents, sensors: Sequence[SceneNode]) -> dict[str, float]:
    """Pixels along the sides of textures that pictures by sensors show at most, by file; of tiles, along those of each.

    Files of unknown detail are missing, or infinite.
    """
    seen = [(studio.outline_for(sensor), sensor["near_clip"]) for sensor in sensors]
    matrices: dict[ShapeContents, list[NDArray[np.float64]]] = {}
    for shape, to_world in contents.placed_shapes:
        if shape.material is not None:
            matrices.setdefault(shape, []).append(to_world)
    needed: dict[str, float] = {}
    for shape, copies in matrices.items():
        texels = TEXELS_PER_PIXEL * _pixels_of_texcoords(shape.cage, np.stack(copies), seen)
        inputs = shape.material.inputs.values() if shape.material else ()
        # Where pictures are read at computed coordinates, the detail is unknown.
        known = [given for given in inputs if not (isinstance(given, NodeContents) and samples_elsewhere(given))]
        for texture in (leaf for given in known for leaf in leaves(given)):
            if isinstance(texture, TextureContents):
                # Pictures along a unit of texture coordinates.
                repeats = np.linalg.norm(texture.to_uv[:2, :2], axis=0).max()
                most = texels / repeats if repeats > 0 else np.inf
                needed[texture.file] = max(most, needed.get(texture.file, 0.0))
    return needed


def _pixels_of_texcoords(cage: CageContents, to_world: NDArray[np.float64], seen: Views) -> float:
    """Maximum pixels of a unit of texture coordinates, for most edges of copies ``(n, 4, 4)``; infinite if unknown."""
    lengths, in_texture = (np.linalg.norm(vectors, axis=1) for vectors in _edges(cage))
    there = in_texture > 0
    if not there.any():
        return np.inf
    return pixels_of(cage, to_world, seen) * float(np.quantile(lengths[there] / in_texture[there], _MOST_EDGES))


def _edges(cage: CageContents) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vectors of some edges ``(n, 3)``, and in texture coordinates ``(n, 2)``; none without texture coordinates."""
    if cage.texcoords is None:
        return np.zeros((0, 3)), np.zeros((0, 2))
    corners = np.arange(0, len(cage.face_vertices), 1 + len(cage.face_vertices) // _MOST_SAMPLES)
    topology = Topology(len(cage.positions), cage.face_sizes, cage.face_vertices)
    ends = np.stack([corners, topology.next[corners]])
    vertices, indices = topology.face_vertices[ends], cage.texcoords.indices
    index = vertices if indices is None else np.asarray(indices)[ends]
    along, in_texture = (
        np.diff(np.asarray(values, dtype=np.float64)[rows], axis=0)[0]
        for values, rows in ((cage.positions, vertices), (cage.texcoords.values, index))
    )
    return along, in_texture


def pixels_of(cage: CageContents, to_world: NDArray[np.float64], seen: Views) -> float:
    """Maximum pixels of a unit of a mesh, over its copies ``(n, 4, 4)`` and views."""
    box = np.stack([cage.positions.min(axis=0), cage.positions.max(axis=0)]).astype(np.float64)
    corners_of_copies = points_at(box_corners(box), to_world)
    pixels = np.max([studio.pixels_of_boxes(corners_of_copies, *view) for view in seen], axis=0)
    return float((np.linalg.norm(to_world[:, :3, :3], 2, axis=(1, 2)) * pixels).max())


def rate_of_heights(cage: CageContents, texture: SceneNode, error: float) -> int:
    """Segments on each edge with which chords are within an error of most heights of a bitmap of one channel."""
    pixels = np.array(texture["bitmap"])
    heights = pixels.reshape(pixels.shape[:2]) / (255.0 if pixels.dtype == np.uint8 else 1.0)
    # In texels, powers of two.
    length = 1
    while 4 * length <= min(heights.shape):
        away = [np.abs(h[2 * length :] + h[: -2 * length] - 2 * h[length:-length]) / 2 for h in (heights, heights.T)]
        if max(np.quantile(part, _MOST_TEXELS) for part in away) > error:
            break
        length *= 2
    to_texels = np.array(texture["to_uv"].matrix)[:2, :2] * np.array(heights.shape[::-1])[:, None]
    texels = np.abs(_edges(cage)[1] @ to_texels.T).max(axis=1)
    return max(1, math.ceil(float(np.quantile(texels, _MOST_EDGES)) / length))
