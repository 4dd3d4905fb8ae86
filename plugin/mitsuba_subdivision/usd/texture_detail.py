"""How fine textures are in a picture, so that those that are finer are loaded smaller."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..srgb import decoded, encoded
from ..studio.picture import outline_for, pixels_of_boxes
from ..studio.placed_points import box_corners
from ..variants import SceneNode
from .baking import samples_elsewhere
from .contents import MaterialContents, NodeContents, SceneContents, ShapeContents, TextureContents, leaves

# Texels for each pixel: filters see details of half a pixel, and glass magnifies.
TEXELS_PER_PIXEL = 2.0
# Edges of a mesh that count: a few may have collapsed in the texture.
MOST_EDGES = 0.95


def texels_for_picture(contents: SceneContents, sensor: SceneNode) -> dict[str, float]:
    """Texels along a unit of texture coordinates that a picture shows, by the file of the texture.

    Files of which the detail is unknown are missing, or have no bound.

    Parameters
    ----------
    contents : SceneContents
    sensor : dict
        Entry of the scene's sensor.
    """
    outline, found = outline_for(sensor), dict[str, float]()
    for shape, to_world in contents.placed_shapes:
        if shape.material is None:
            continue
        texels = TEXELS_PER_PIXEL * _pixels_of_texcoords(shape, to_world, outline, sensor["near_clip"])
        for file in _files(contents.materials[shape.material]):
            found[file] = max(texels, found.get(file, 0.0))
    return found


def reduced(pixels: NDArray, needed: float, *, is_srgb: bool) -> NDArray:
    """An image of bytes halved as often as its sides stay at least so many pixels long, by means of linear values.

    Parameters
    ----------
    pixels : (h, w, c) array
    needed : float
    is_srgb : bool
        Whether colours are encoded; alpha is linear.
    """
    shortest = min(pixels.shape[:2])
    if pixels.dtype != np.uint8 or shortest < 2 * max(needed, 1) or any(side % 2 for side in pixels.shape[:2]):
        return pixels
    colors = 3 if is_srgb else 0
    values = np.concatenate([_LINEAR[pixels[..., :colors]], pixels[..., colors:] * np.uint16(257)], axis=2)
    while shortest >= 2 * max(needed, 1) and not any(side % 2 for side in values.shape[:2]):
        rows = values[::2].astype(np.uint32) + values[1::2]
        values = ((rows[:, ::2] + rows[:, 1::2] + 2) // 4).astype(np.uint16)
        shortest //= 2
    rest = ((values[..., colors:].astype(np.uint32) + 128) // 257).astype(np.uint8)
    return np.concatenate([_ENCODED[values[..., :colors]], rest], axis=2)


# Linear values of 16 bits for bytes of sRGB, and back.
_LINEAR = np.round(65535 * decoded(np.arange(256) / 255)).astype(np.uint16)
_ENCODED = np.round(255 * encoded(np.arange(65536) / 65535)).astype(np.uint8)


def _files(material: MaterialContents) -> set[str]:
    """Files of the textures that a material reads at its own texture coordinates; of others the detail is unknown."""
    return {
        leaf.file
        for each in material.inputs.values()
        if not (isinstance(each, NodeContents) and samples_elsewhere(each))
        for leaf in leaves(each)
        if isinstance(leaf, TextureContents)
    }


def _pixels_of_texcoords(
    shape: ShapeContents, to_world: NDArray[np.float64], outline: SceneNode, near_clip: float
) -> float:
    """Pixels that a unit of texture coordinates takes at most, for most edges of a mesh; without any, no bound."""
    cage, texcoords = shape.cage, shape.cage.texcoords
    if texcoords is None:
        return np.inf
    vertices = np.asarray(cage.face_vertices)
    offsets = ragged.offsets(cage.face_sizes)
    following = np.arange(1, len(vertices) + 1)
    following[offsets[1:] - 1] = offsets[:-1]
    index = vertices if texcoords.indices is None else np.asarray(texcoords.indices)
    uv = np.asarray(texcoords.values, dtype=np.float64)[index]
    points = np.asarray(cage.positions, dtype=np.float64) @ to_world[:3, :3].T + to_world[:3, 3]
    lengths = np.linalg.norm(points[vertices[following]] - points[vertices], axis=1)
    in_texture = np.linalg.norm(uv[following] - uv, axis=1)
    there = in_texture > 0
    if not there.any():
        return np.inf
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    ratio = float(np.quantile(lengths[there] / in_texture[there], MOST_EDGES))
    return ratio * float(pixels_of_boxes(box_corners(box)[None], outline, near_clip)[0])
