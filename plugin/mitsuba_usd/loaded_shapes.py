"""Shapes of a stage as Mitsuba objects, kept from frame to frame."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.cage import CageError, CageWarning, same, same_topology
from mitsuba_subdivision.studio import set_parameters
from mitsuba_subdivision.variants import SceneNode

from .bsdfs import interior
from .contents import MaterialContents, ShapeContents
from .limit_surfaces import Surfaces
from .shapes import polygon_mesh, subdivision
from .stage_warnings import StageWarnings

# Fields of a shape that may differ between frames that share an object: a shape can move, and materials are compared
# themselves.
_MOVABLE = frozenset({"cage", "to_world", "material"})


Loaded = tuple[ShapeContents, MaterialContents | None, mi.Object]


class LoadedShapes:
    """Builds Mitsuba shapes for successive frames.

    A limit surface that only moves reuses the object of the frame before, with new control points: its patches and
    weights stay. A polygon mesh that moves is rebuilt.
    """

    def __init__(
        self,
        parameters: dict[str, Any],  # Of every shape `subdivision`
    ) -> None:
        self._parameters = parameters
        self._before: dict[tuple[str, int], Loaded] = {}
        self._now: dict[tuple[str, int], Loaded] = {}
        self._counts: Counter[str] = Counter()
        self._bsdfs: list[tuple[MaterialContents, mi.BSDF]] = []
        self.surfaces = Surfaces()

    def begin_frame(self) -> None:
        """Begin the next frame, and free objects that the last one did not use."""
        self._before, self._now, self._counts, self.surfaces = self._now, {}, Counter(), Surfaces()
        materials = [material for _, material, _ in self._before.values()]
        self._bsdfs = [pair for pair in self._bsdfs if any(pair[0] is each for each in materials)]

    def object_of(
        self,
        shape: ShapeContents,
        material: MaterialContents | None,
        bsdf: Callable[[], SceneNode],  # Makes the entry of its BSDF
        area: SceneNode | None,  # Entry of its emitter
        notes: StageWarnings,
    ) -> mi.Object:
        """The object of a shape.

        Raises CageError if the cage is invalid, or its points are not finite. Raises SchemeError if the scheme cannot
        subdivide it.
        """
        # Several shapes have one name if a mesh has several materials, or if groups have equal shapes.
        self._counts[shape.name] += 1
        key = shape.name, self._counts[shape.name]
        known = self._before.get(key)
        if known is None or not _differs_by_position(known, shape, material):
            known = shape, material, self._load(shape, material, bsdf, area, notes)
        elif _has_moved(known[0], shape):
            if shape.cage.scheme is None:
                known = shape, material, self._load(shape, material, bsdf, area, notes)
            else:
                _move(known[2], shape)
                known = shape, known[1], known[2]
        self._now[key] = known
        return known[2]

    def _load(
        self,
        shape: ShapeContents,
        material: MaterialContents | None,
        bsdf: Callable[[], SceneNode],
        area: SceneNode | None,
        notes: StageWarnings,
    ) -> mi.Object:
        emitter = None if area is None else mi.load_dict(area)
        if shape.cage.scheme is None:
            media = [mi.load_dict(each) for each in interior(material).values()]
            return polygon_mesh(shape).loaded(self._bsdf(material, bsdf), emitter, *media)
        # Validated before its BSDF is made, so that warnings about the cage name the prim.
        parameters = {**self._parameters, **interior(material)}
        entry = subdivision(shape, self.surfaces, None, emitter, parameters, notes)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CageWarning)
            return mi.load_dict({**entry, "bsdf": self._bsdf(material, bsdf)})

    def _bsdf(self, material: MaterialContents | None, entry: Callable[[], SceneNode]) -> mi.BSDF:
        """The BSDF of a material, shared by all its shapes unless it reads their attributes."""
        if material is None or material.primvars():
            return mi.load_dict(entry())
        for known, loaded in self._bsdfs:
            if same(known, material):
                return loaded
        self._bsdfs.append((material, mi.load_dict(entry())))
        return self._bsdfs[-1][1]


def _differs_by_position(known: Loaded, shape: ShapeContents, material: MaterialContents | None) -> bool:
    """Whether two shapes are equal except for transforms and control points."""
    return same(known[0], shape, _MOVABLE) and same(known[1], material) and same_topology(known[0].cage, shape.cage)


def _has_moved(before: ShapeContents, shape: ShapeContents) -> bool:
    return not (
        np.array_equal(before.cage.positions, shape.cage.positions) and np.array_equal(before.to_world, shape.to_world)
    )


def _move(loaded: mi.Object, shape: ShapeContents) -> None:
    positions = np.asarray(shape.cage.positions, dtype=np.float64)
    if not np.isfinite(positions).all():
        raise CageError(f"{shape.cage.source.name}: points are not finite; expected finite numbers")
    to_world = mi.ScalarTransform4f(shape.to_world.tolist())
    set_parameters(loaded, {"control_points": positions, "to_world": to_world})
