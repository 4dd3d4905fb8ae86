"""Copies in place of many instances.

Mitsuba's JIT variants trace and compile a separate program for each instance, at a cost that grows with the
square of their number; see the page of files. One mesh of all copies of a shape has none of that.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..cage.attributes import Attribute
from ..cage.contents import CageContents
from ..cage.source import CageSource
from ..files.usd_reader import reversed_order
from ..mesh.connectivity import IntArray
from .contents import InstanceContents, SceneContents, ShapeContents

# Fewer instances cost less than a second in each picture.
LEAST_INSTANCES = 64


def with_copies(contents: SceneContents, rate: int, most_triangles: int) -> SceneContents:
    """A scene with one shape for all copies of a shape that has instances, if there are many instances.

    Parameters
    ----------
    contents : SceneContents
    rate : int
        Segments on each edge of limit surfaces.
    most_triangles : int
        If copies would have more triangles, instances stay.
    """
    if len(contents.instances) < LEAST_INSTANCES:
        return contents
    of_group: list[list[InstanceContents]] = [[] for _ in contents.groups]
    for each in contents.instances:
        of_group[each.group].append(each)
    triangles = sum(
        len(placed) * _triangles(shape, rate)
        for group, placed in zip(contents.groups, of_group, strict=True)
        for shape in group
    )
    if triangles > most_triangles or not all(_is_sound(shape.cage) for group in contents.groups for shape in group):
        return contents
    copies = [
        _copied(shape, np.stack([each.to_world for each in placed]), f"/copies_{number}{shape.name}")
        for number, (group, placed) in enumerate(zip(contents.groups, of_group, strict=True))
        for shape in group
    ]
    return replace(contents, shapes=[*contents.shapes, *copies], groups=[], instances=[])


def _triangles(shape: ShapeContents, rate: int) -> int:
    corners, faces = int(shape.cage.face_sizes.sum()), len(shape.cage.face_sizes)
    return corners - 2 * faces if shape.cage.scheme is None else corners * rate**2 // 2


def _is_sound(cage: CageContents) -> bool:
    """Whether all indices of a cage are in range; otherwise they would refer to another copy."""
    vertices = np.concatenate([cage.face_vertices, cage.creases[:, :2].ravel(), cage.corners[:, 0]])
    counts = [(vertices, len(cage.positions)), (cage.holes, len(cage.face_sizes))]
    if cage.texcoords is not None:
        indices, values = cage.texcoords.indices, cage.texcoords.values
        expected = cage.face_vertices if cage.texcoords.interpolation == "face_varying" else cage.positions
        if len(values if indices is None else indices) != len(expected):
            return False
        counts.append((np.zeros(0) if indices is None else indices, len(values)))
    is_in_range = all(found.min(initial=0) >= 0 and found.max(initial=-1) < count for found, count in counts)
    return is_in_range and int(cage.face_sizes.sum()) == len(cage.face_vertices) and not cage.attributes


def _copied(shape: ShapeContents, transforms: NDArray[np.float64], name: str) -> ShapeContents:
    """One shape of all copies of a shape, with the transforms ``(n, 4, 4)``."""
    cage, count = shape.cage, len(transforms)
    matrices = transforms @ shape.to_world
    linear = matrices[:, :3, :3]
    positions = np.asarray(cage.positions, dtype=np.float64) @ linear.transpose(0, 2, 1) + matrices[:, None, :3, 3]
    # Corners of the faces in each copy; faces of mirrored ones are turned over.
    is_mirrored = np.linalg.det(linear) < 0
    corners = np.where(is_mirrored[:, None], reversed_order(cage.face_sizes), np.arange(len(cage.face_vertices)))
    vertex, face = len(cage.positions), len(cage.face_sizes)
    normals = shape.normals
    if normals is not None:
        of_copies = normals @ np.linalg.inv(linear)
        normals = np.take_along_axis(of_copies, corners[..., None], axis=1).reshape(-1, 3)
    copied = CageContents(
        positions.reshape(-1, 3),
        np.tile(cage.face_sizes, count),
        (cage.face_vertices[corners] + _firsts(count, vertex)).ravel(),
        creases=_tiled(cage.creases, np.array([vertex, vertex, 0]), count),
        corners=_tiled(cage.corners, np.array([vertex, 0]), count),
        holes=(cage.holes + _firsts(count, face)).ravel(),
        texcoords=None if cage.texcoords is None else _texcoords(cage.texcoords, corners, count),
        rules=cage.rules,
        scheme=cage.scheme,
        source=CageSource(f"{cage.source.name}, {count} copies"),
    )
    return ShapeContents(name, copied, np.eye(4), normals, shape.material, shape.constants, shape.radiance)


def _firsts(count: int, step: int) -> IntArray:
    return step * np.arange(count)[:, None]


def _tiled(tags: NDArray[np.float64], step: NDArray, count: int) -> NDArray[np.float64]:
    return (tags + step * np.arange(count)[:, None, None]).reshape(-1, tags.shape[1])


def _texcoords(texcoords: Attribute, corners: IntArray, count: int) -> Attribute:
    if texcoords.interpolation != "face_varying":
        return Attribute(np.tile(texcoords.values, (count, 1)), texcoords.interpolation)
    indices = np.arange(len(texcoords.values)) if texcoords.indices is None else texcoords.indices
    return Attribute(texcoords.values, "face_varying", indices[corners].ravel())
