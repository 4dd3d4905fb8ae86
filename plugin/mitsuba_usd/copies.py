"""Copies in place of many instances, which take JIT variants a time quadratic in their number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from mitsuba_subdivision.cage import Attribute, CageContents, CageSource
from mitsuba_subdivision.mesh import IntArray, ragged
from mitsuba_subdivision.mitsuba_mesh import points_at
from mitsuba_subdivision.studio import available_memory
from numpy.typing import NDArray

from .contents import SceneContents, ShapeContents
from .stage_warnings import StageWarnings

LEAST_INSTANCES = 64  # Fewer instances cost less than a second in each picture
# Faces of meshes whose copies load sooner as separate shapes than as one mesh, in a third of the memory.
LARGE = 10_000
# Measured memory of copies as one mesh; and its largest part of the available memory, and largest size.
FACE_BYTES, TRIANGLE_BYTES, POINT_BYTES = {"exact": 600, "vertex": 300}, 170, 400
MOST_PART, MOST_BYTES = 0.75, 6e9
# Time of a picture of instances, which grows with the square of their number.
MEASURED_INSTANCES, MEASURED_SECONDS = 2_000, 65
Rates = Mapping[ShapeContents, IntArray]  # Needed segments on each edge, (n,) for the placements of each shape


def with_large_copies(contents: SceneContents) -> SceneContents:
    """Contents with separate shapes in place of many instances of large or displaced shapes."""
    if len(contents.instances) < LEAST_INSTANCES:
        return contents
    # Heights are in the space of each copy, and one mesh of all copies has one.
    is_large = [
        any(shape.is_displaced for shape in group)
        or (bool(group) and sum(len(shape.cage.face_sizes) for shape in group) >= LARGE * len(group))
        for group in contents.groups
    ]
    placed = [instance for instance in contents.instances if is_large[instance.group]]
    copies = [instance.placed(shape) for instance in placed for shape in contents.groups[instance.group]]
    # Two triangles for four corners, with one segment on each edge.
    if TRIANGLE_BYTES * sum(len(copy.cage.face_vertices) for copy in copies) / 2 > _allowed_bytes():
        return contents
    return replace(
        contents,
        shapes=[*contents.shapes, *copies],
        groups=[[] if is_large[number] else group for number, group in enumerate(contents.groups)],
        instances=[instance for instance in contents.instances if not is_large[instance.group]],
    )


def with_copies(
    contents: SceneContents, rates: Rates, shading: str, notes: StageWarnings, lowest: int = 1
) -> tuple[SceneContents, dict[ShapeContents, int]]:
    """Contents with one shape for many copies that need the same rate, and the rates of such shapes.

    If they need more than `MOST_BYTES`, rates are lowered down to the lowest; if that does not suffice, instances stay.
    """
    is_displaced = any(shape.is_displaced for group in contents.groups for shape in group)
    are_many = len(contents.instances) >= LEAST_INSTANCES and not is_displaced
    placements = contents.placements if are_many else {}
    # Name of the copies of each shape, their transforms (n, 4, 4) to the world, and the rates (n,) that they need.
    placed: dict[ShapeContents, tuple[str, NDArray[np.float64]]] = {}
    needed: dict[ShapeContents, IntArray] = {}
    for number, group in enumerate(contents.groups):
        for shape in filter(placements.__contains__, group):
            placed[shape] = f"/copies_{number}{shape.name}", placements[shape]
            needed[shape] = rates.get(shape, np.ones(len(placements[shape]), np.int64))
    of_cage: dict[tuple[int, int], list[ShapeContents]] = {}
    for shape in contents.shapes:
        if len(shape.cage.face_sizes) < LARGE and not shape.is_displaced and shape.whole_light is None:
            of_cage.setdefault((id(shape.cage), id(shape.shown_faces)), []).append(shape)
    together: set[ShapeContents] = set()
    for alike in of_cage.values():
        if len(alike) >= LEAST_INSTANCES:
            together.update(alike)
            placed[alike[0]] = f"/copies{alike[0].name}", np.stack([shape.to_world for shape in alike])
            needed[alike[0]] = np.concatenate([rates.get(shape, np.ones(1, np.int64)) for shape in alike])
    if not placed:
        return contents, {}
    highest, allowed = max(int(of_copies.max()) for of_copies in needed.values()), _allowed_bytes()
    limits = range(highest, min(lowest, highest) - 1, -1)
    most = next((most for most in limits if _bytes(needed, most, shading) <= allowed), None)
    if most is None:
        count = len(contents.instances)
        faces = sum(len(of_copies) * len(shape.cage.face_sizes) for shape, of_copies in needed.items())
        seconds = MEASURED_SECONDS * (count / MEASURED_INSTANCES) ** 2
        notes.add(
            f"copies with {faces:,} faces would take about {_bytes(needed, limits[-1], shading) / 1e9:.0f} GB as one "
            f"mesh, more than {allowed / 1e9:.1f} GB, and stay {count:,} instances: a picture may take {seconds:,.0f} "
            'seconds; expected fewer copies, smaller cages or shading="vertex"',
            next(iter(placed)).name,
        )
        return contents, {}
    joined: dict[ShapeContents, int] = {}
    for shape, (name, to_world) in placed.items():
        of_copies = np.minimum(needed[shape], most)
        for rate in np.unique(of_copies).tolist():
            joined[_copied(shape, to_world[of_copies == rate], name)] = rate
    kept: dict[str, Any] = {"groups": [], "instances": []} if are_many else {}
    alone = [shape for shape in contents.shapes if shape not in together]
    return replace(contents, shapes=[*alone, *joined], **kept), joined


def _allowed_bytes() -> float:
    available = available_memory()
    return MOST_BYTES if available is None else min(MOST_BYTES, MOST_PART * available)


def _bytes(rates: Rates, most: int, shading: str) -> float:
    total = 0.0
    for shape, of_copies in rates.items():
        cage, is_smooth, count = shape.cage, shape.cage.scheme is not None, len(of_copies)
        corners, faces = int(cage.face_sizes.sum()), len(cage.face_sizes)
        squares = float(np.square(np.minimum(of_copies, most)).sum())
        triangles = corners * squares / 2 if is_smooth else (corners - 2 * faces) * count
        total += POINT_BYTES * count * (0 if shape.curves is None else len(shape.curves.points))
        total += TRIANGLE_BYTES * triangles + (FACE_BYTES[shading] * faces * count if is_smooth else 0)
    return total


def _copied(shape: ShapeContents, matrices: NDArray[np.float64], name: str) -> ShapeContents:
    cage, count = shape.cage, len(matrices)
    linear = matrices[:, :3, :3]
    positions = points_at(np.asarray(cage.positions, dtype=np.float64), matrices)
    # Corners of the faces of each copy, in reversed order for mirrored copies.
    is_mirrored = np.linalg.det(linear) < 0
    corners = np.where(is_mirrored[:, None], ragged.reversed_order(cage.face_sizes), np.arange(len(cage.face_vertices)))
    # First vertex and face of each copy.
    vertex, face = (step * np.arange(count)[:, None] for step in (len(cage.positions), len(cage.face_sizes)))
    normals = shape.normals
    if normals is not None:
        normals = np.take_along_axis(normals @ np.linalg.inv(linear), corners[..., None], axis=1).reshape(-1, 3)
    copied = CageContents(
        positions.reshape(-1, 3),
        np.tile(cage.face_sizes, count),
        (cage.face_vertices[corners] + vertex).ravel(),
        creases=(cage.creases + vertex[..., None] * np.array([1, 1, 0])).reshape(-1, 3),
        corners=(cage.corners + vertex[..., None] * np.array([1, 0])).reshape(-1, 2),
        holes=(cage.holes + face).ravel(),
        texcoords=None if cage.texcoords is None else _attribute(cage.texcoords, corners),
        attributes={name: _attribute(attribute, corners) for name, attribute in cage.attributes.items()},
        rules=cage.rules,
        scheme=cage.scheme,
        source=CageSource(f"{cage.source.name}, {count} copies"),
    )
    shown = None if shape.shown_faces is None else (shape.shown_faces + face).ravel()
    shape = replace(shape, curves=shape.curves and shape.curves.placed(matrices))
    return replace(shape, name=name, cage=copied, to_world=np.eye(4), normals=normals, shown_faces=shown)


def _attribute(given: Attribute, corners: IntArray) -> Attribute:
    if given.interpolation != "face_varying":
        return Attribute(np.tile(given.values, (len(corners), 1)), given.interpolation)
    indices = np.arange(len(given.values)) if given.indices is None else given.indices
    return Attribute(given.values, "face_varying", indices[corners].ravel())
