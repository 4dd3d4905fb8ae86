"""Copies in place of many instances.

Mitsuba's JIT variants trace and compile a separate program for each instance, at a cost that grows with the
square of their number; see the page of files. One mesh of all copies of a shape has none of that.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from mitsuba_subdivision.cage import Attribute, CageContents, CageSource
from mitsuba_subdivision.files import reversed_order
from mitsuba_subdivision.mesh import IntArray
from numpy.typing import NDArray

from .contents import SceneContents, ShapeContents
from .stage_warnings import StageWarnings

# Fewer instances cost less than a second in each picture.
LEAST_INSTANCES = 64
# From so many faces on, copies load sooner as shapes of their own, which share tables, than as one mesh, and in a third
# of the memory. Each takes 3 ms of a picture.
LARGE = 10_000
# Of copies as one mesh, measured; and what they may take of the memory of the machine, and at most.
FACE_BYTES, TRIANGLE_BYTES = {"exact": 600, "vertex": 300}, 170
MOST_PART, MOST_BYTES = 0.75, 6e9
# Of a picture of so many instances, whose time grows with the square of their number.
MEASURED_INSTANCES, MEASURED_SECONDS = 2_000, 65


class _Copies(NamedTuple):
    """Copies of a shape, with the transforms ``(n, 4, 4)`` and the rates ``(n,)`` that they need."""

    name: str
    shape: ShapeContents
    to_world: NDArray[np.float64]
    rates: IntArray


def with_large_copies(contents: SceneContents) -> SceneContents:
    """A scene where instances of large shapes are shapes of their own, if there are many instances."""
    if len(contents.instances) < LEAST_INSTANCES:
        return contents
    is_large = [
        bool(group) and sum(len(each.cage.face_sizes) for each in group) >= LARGE * len(group)
        for group in contents.groups
    ]
    copies = [
        replace(shape, name=f"{each.name}{shape.name}", to_world=each.to_world @ shape.to_world)
        for each in contents.instances
        if is_large[each.group]
        for shape in contents.groups[each.group]
    ]
    # Two triangles for four corners, with one segment on each edge.
    if TRIANGLE_BYTES * sum(len(each.cage.face_vertices) for each in copies) / 2 > _allowed_bytes():
        return contents
    return replace(
        contents,
        shapes=[*contents.shapes, *copies],
        groups=[[] if is_large[number] else group for number, group in enumerate(contents.groups)],
        instances=[each for each in contents.instances if not is_large[each.group]],
    )


def with_copies(
    contents: SceneContents,
    # dict of (n,) int array by shape: segments on each edge of limit surfaces that their copies need, in the
    # order of `contents.placed_shapes`
    rates: Mapping[ShapeContents, IntArray],
    shading: str,
    notes: StageWarnings,
    *,
    lowest: int = 1,
) -> tuple[SceneContents, dict[ShapeContents, int]]:
    """A scene where copies of a shape are one shape, if there are many; and the rates of such shapes.

    Copies that need different rates are different shapes. If all would take more than `MOST_BYTES`, their highest rate
    gives way, down to the lowest; if that is not enough, instances stay.
    """
    placed = _of_instances(contents, rates)
    of_cage: dict[tuple[int, int], list[ShapeContents]] = {}
    for shape in contents.shapes:
        if len(shape.cage.face_sizes) < LARGE:
            of_cage.setdefault((id(shape.cage), id(shape.shown_faces)), []).append(shape)
    many = [each for each in of_cage.values() if len(each) >= LEAST_INSTANCES]
    for alike in many:
        needed = np.concatenate([rates.get(each, np.ones(1, np.int64)) for each in alike])
        placed.append(_Copies(f"/copies{alike[0].name}", alike[0], np.stack([each.to_world for each in alike]), needed))
    if not placed:
        return contents, {}
    highest = max(int(each.rates.max()) for each in placed)
    allowed = _allowed_bytes()
    limits = range(highest, min(lowest, highest) - 1, -1)
    most = next((most for most in limits if _bytes(placed, most, shading) <= allowed), None)
    if most is None:
        count = len(contents.instances)
        faces = sum(len(each.rates) * len(each.shape.cage.face_sizes) for each in placed)
        seconds = MEASURED_SECONDS * (count / MEASURED_INSTANCES) ** 2
        notes.add(
            f"copies with {faces:,} faces would take about {_bytes(placed, limits[-1], shading) / 1e9:.0f} GB as one "
            f"mesh, more than {allowed / 1e9:.1f} GB, and stay {count:,} instances: a picture may take {seconds:,.0f} "
            'seconds; expected fewer copies, smaller cages or shading="vertex"',
            placed[0].shape.name,
        )
        return contents, {}
    found: dict[ShapeContents, int] = {}
    for each in placed:
        of_copies = np.minimum(each.rates, most)
        for rate in np.unique(of_copies).tolist():
            found[_copied(each.shape, each.to_world[of_copies == rate], each.name)] = rate
    alone = [shape for shape in contents.shapes if not any(shape in alike for alike in many)]
    kept: dict[str, Any] = {} if len(contents.instances) < LEAST_INSTANCES else {"groups": [], "instances": []}
    return replace(contents, shapes=[*alone, *found], **kept), found


def _of_instances(contents: SceneContents, rates: Mapping[ShapeContents, IntArray]) -> list[_Copies]:
    """Copies in place of instances; none if they are few."""
    if len(contents.instances) < LEAST_INSTANCES:
        return []
    of_group: list[list[NDArray]] = [[] for _ in contents.groups]
    for each in contents.instances:
        of_group[each.group].append(each.to_world)
    found = []
    for number, (group, placed) in enumerate(zip(contents.groups, of_group, strict=True)):
        for shape in group if placed else []:
            matrices = np.stack(placed) @ shape.to_world
            needed = rates.get(shape, np.ones(len(placed), np.int64))
            found.append(_Copies(f"/copies_{number}{shape.name}", shape, matrices, needed))
    return found


def _allowed_bytes() -> float:
    return min(MOST_BYTES, MOST_PART * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


def _bytes(placed: list[_Copies], most: int, shading: str) -> float:
    """Memory of copies as one mesh, with rates up to the given one."""
    found = 0.0
    for each in placed:
        cage, is_smooth = each.shape.cage, each.shape.cage.scheme is not None
        corners, faces = int(cage.face_sizes.sum()), len(cage.face_sizes)
        squares = float(np.square(np.minimum(each.rates, most)).sum())
        triangles = corners * squares / 2 if is_smooth else (corners - 2 * faces) * len(each.rates)
        found += TRIANGLE_BYTES * triangles + (FACE_BYTES[shading] * faces * len(each.rates) if is_smooth else 0)
    return found


def _copied(shape: ShapeContents, matrices: NDArray[np.float64], name: str) -> ShapeContents:
    """One shape of all copies of a shape, with the transforms ``(n, 4, 4)``."""
    cage, count = shape.cage, len(matrices)
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
        texcoords=None if cage.texcoords is None else _attribute(cage.texcoords, corners, count),
        attributes={name: _attribute(each, corners, count) for name, each in cage.attributes.items()},
        rules=cage.rules,
        scheme=cage.scheme,
        source=CageSource(f"{cage.source.name}, {count} copies"),
    )
    shown = None if shape.shown_faces is None else (shape.shown_faces + _firsts(count, face)).ravel()
    return replace(shape, name=name, cage=copied, to_world=np.eye(4), normals=normals, shown_faces=shown)


def _firsts(count: int, step: int) -> IntArray:
    return step * np.arange(count)[:, None]


def _tiled(tags: NDArray[np.float64], step: NDArray, count: int) -> NDArray[np.float64]:
    return (tags + step * np.arange(count)[:, None, None]).reshape(-1, tags.shape[1])


def _attribute(given: Attribute, corners: IntArray, count: int) -> Attribute:
    if given.interpolation != "face_varying":
        return Attribute(np.tile(given.values, (count, 1)), given.interpolation)
    indices = np.arange(len(given.values)) if given.indices is None else given.indices
    return Attribute(given.values, "face_varying", indices[corners].ravel())
