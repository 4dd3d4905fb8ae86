"""How fine textures are in a picture, so that those that are finer are loaded smaller."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mitsuba_subdivision.cage import CageContents
from mitsuba_subdivision.mesh import ragged
from mitsuba_subdivision.studio import box_corners, outline_for, pixels_of_boxes
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .baking import samples_elsewhere
from .contents import MaterialContents, NodeContents, SceneContents, ShapeContents, TextureContents, leaves

# Texels for each pixel: filters see details of half a pixel, and glass magnifies.
TEXELS_PER_PIXEL = 2.0
# Edges of a mesh that count: a few may have collapsed in the texture.
MOST_EDGES = 0.95
# Of these, as many are measured: more would not change the part that counts.
MOST_SAMPLES = 20_000


def texels_for_pictures(contents: SceneContents, sensors: Sequence[SceneNode]) -> dict[str, float]:
    """Pixels along the sides of textures that pictures by sensors show at most, by file; of tiles, along those of each.

    Files of which the detail is unknown are missing, or have no bound.
    """
    seen = [(outline_for(sensor), sensor["near_clip"]) for sensor in sensors]
    matrices: dict[ShapeContents, list[NDArray[np.float64]]] = {}
    for shape, to_world in contents.placed_shapes:
        if shape.material is not None:
            matrices.setdefault(shape, []).append(to_world)
    found: dict[str, float] = {}
    for shape, copies in matrices.items():
        texels = TEXELS_PER_PIXEL * _pixels_of_texcoords(shape.cage, np.stack(copies), seen)
        for texture in _textures(contents.materials[shape.material or 0]):
            # Pictures along a unit of texture coordinates.
            repeats = np.linalg.norm(texture.to_uv[:2, :2], axis=0).max()
            needed = texels / repeats if repeats > 0 else np.inf
            found[texture.file] = max(needed, found.get(texture.file, 0.0))
    return found


def _textures(material: MaterialContents) -> list[TextureContents]:
    """Textures that a material reads at its own texture coordinates; of others the detail is unknown."""
    return [
        leaf
        for each in material.inputs.values()
        if not (isinstance(each, NodeContents) and samples_elsewhere(each))
        for leaf in leaves(each)
        if isinstance(leaf, TextureContents)
    ]


def _pixels_of_texcoords(
    cage: CageContents, to_world: NDArray[np.float64], seen: Sequence[tuple[SceneNode, float]]
) -> float:
    """Pixels that a unit of texture coordinates takes at most, for most edges of copies of a mesh; else no bound.

    The copies have the transforms ``(n, 4, 4)``.
    """
    texcoords = cage.texcoords
    if texcoords is None:
        return np.inf
    corners = np.arange(0, len(cage.face_vertices), 1 + len(cage.face_vertices) // MOST_SAMPLES)
    offsets = ragged.offsets(cage.face_sizes)
    following = np.arange(1, len(cage.face_vertices) + 1)
    following[offsets[1:] - 1] = offsets[:-1]
    ends = np.stack([corners, following[corners]])
    vertices = np.asarray(cage.face_vertices)[ends]
    index = vertices if texcoords.indices is None else np.asarray(texcoords.indices)[ends]
    lengths, in_texture = (
        np.linalg.norm(np.diff(np.asarray(values, dtype=np.float64)[rows], axis=0)[0], axis=1)
        for values, rows in ((cage.positions, vertices), (texcoords.values, index))
    )
    there = in_texture > 0
    if not there.any():
        return np.inf
    linear, shifts = to_world[:, :3, :3], to_world[:, None, :3, 3]
    box = np.stack([cage.positions.min(axis=0), cage.positions.max(axis=0)]).astype(np.float64)
    corners_of_copies = box_corners(box) @ linear.transpose(0, 2, 1) + shifts
    pixels = np.max([pixels_of_boxes(corners_of_copies, *each) for each in seen], axis=0)
    ratio = float(np.quantile(lengths[there] / in_texture[there], MOST_EDGES))
    return ratio * float((np.linalg.norm(linear, 2, axis=(1, 2)) * pixels).max())
