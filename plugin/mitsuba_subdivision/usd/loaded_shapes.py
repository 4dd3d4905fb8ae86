"""Shapes of a stage as objects of Mitsuba, which stay from frame to frame."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..cage.errors import CageError, CageWarning
from ..cage.sameness import same, same_topology
from ..studio.animation import move
from .contents import MaterialContents, ShapeContents
from .shapes import polygon_mesh, subdivision
from .surfaces import Surfaces

# Of a shape, what does not matter for whether an object serves for another: it can move, and materials are compared
# themselves.
_MOVABLE = frozenset({"cage", "to_world", "material"})


@dataclass(frozen=True, eq=False)
class _Loaded:
    shape: ShapeContents
    material: MaterialContents | None
    object: Any

    def looks_like(self, shape: ShapeContents, material: MaterialContents | None) -> bool:
        """Whether this is another shape at most by where it and its control points are."""
        return (
            same(self.shape, shape, _MOVABLE)
            and same(self.material, material)
            and same_topology(self.shape.cage, shape.cage)
        )

    def has_moved_to(self, shape: ShapeContents) -> bool:
        """Whether control points or the place are others."""
        return not (
            np.array_equal(self.shape.cage.positions, shape.cage.positions)
            and np.array_equal(self.shape.to_world, shape.to_world)
        )


class LoadedShapes:
    """Makes objects of Mitsuba for the shapes of frames, one frame after the other.

    A limit surface that only moves is the object of the frame before, with other control points: its patches and
    weights stay. A polygon mesh is made anew if it moves.

    Parameters
    ----------
    mi : module
        ``mitsuba`` with a variant set.
    parameters : dict
        Of every shape ``subdivision``.
    """

    def __init__(self, mi: Any, parameters: dict[str, Any]) -> None:
        self._mi, self._parameters = mi, parameters
        self._before: dict[tuple[str, int], _Loaded] = {}
        self._now: dict[tuple[str, int], _Loaded] = {}
        self._counts: Counter[str] = Counter()
        self._bsdfs: list[tuple[MaterialContents, Any]] = []
        self._surfaces = Surfaces()

    def begin_frame(self) -> None:
        """Begin the next frame; what the last one did not have is forgotten."""
        self._before, self._now, self._counts, self._surfaces = self._now, {}, Counter(), Surfaces()
        materials = [each.material for each in self._before.values()]
        self._bsdfs = [pair for pair in self._bsdfs if any(pair[0] is each for each in materials)]

    def make(
        self,
        shape: ShapeContents,
        material: MaterialContents | None,
        bsdf: Callable[[], dict[str, Any]],
        area: dict[str, Any] | None,
    ) -> Any:
        """The object of a shape.

        Parameters
        ----------
        shape : ShapeContents
        material : MaterialContents or None
        bsdf : callable
            Makes the entry of its BSDF.
        area : dict or None
            Entry of its emitter.

        Raises
        ------
        CageError
            If the cage is invalid, or its points are not finite.
        SchemeError
            If the scheme cannot subdivide it.
        """
        # Several shapes have one name where a mesh has several materials, or where groups have alike shapes.
        self._counts[shape.name] += 1
        key = shape.name, self._counts[shape.name]
        known = self._before.get(key)
        if known is not None and known.looks_like(shape, material):
            if known.has_moved_to(shape) and shape.cage.scheme is not None:
                self._move(known.object, shape)
                known = _Loaded(shape, known.material, known.object)
            elif known.has_moved_to(shape):
                known = None
        else:
            known = None
        if known is None:
            known = _Loaded(shape, material, self._loaded(shape, material, bsdf, area))
        self._now[key] = known
        return known.object

    def _loaded(
        self,
        shape: ShapeContents,
        material: MaterialContents | None,
        bsdf: Callable[[], dict[str, Any]],
        area: dict[str, Any] | None,
    ) -> Any:
        emitter = None if area is None else self._mi.load_dict(area)
        if shape.cage.scheme is None:
            return polygon_mesh(shape).loaded(self._mi, self._bsdf(material, bsdf), emitter)
        # Validated before its BSDF is made; what is told of the cage then names the prim.
        entry = subdivision(shape, self._surfaces, self._mi, None, emitter, self._parameters)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CageWarning)
            return self._mi.load_dict({**entry, "bsdf": self._bsdf(material, bsdf)})

    def _bsdf(self, material: MaterialContents | None, entry: Callable[[], dict[str, Any]]) -> Any:
        """A BSDF, one for all shapes of a material unless it reads attributes of theirs."""
        if material is None or material.primvars():
            return self._mi.load_dict(entry())
        for known, loaded in self._bsdfs:
            if same(known, material):
                return loaded
        self._bsdfs.append((material, self._mi.load_dict(entry())))
        return self._bsdfs[-1][1]

    def _move(self, loaded: Any, shape: ShapeContents) -> None:
        positions = np.asarray(shape.cage.positions, dtype=np.float64)
        if not np.isfinite(positions).all():
            raise CageError(f"{shape.cage.source.name}: points are not finite; expected finite numbers")
        to_world = self._mi.ScalarTransform4f(shape.to_world.tolist())
        move(loaded, {"control_points": positions, "to_world": to_world})
