"""Limit surfaces of the cages of a scene, one for all cages that are equal."""

from __future__ import annotations

import warnings
import zlib
from dataclasses import dataclass, field
from typing import Any

from ..cage import ControlCage
from ..cage.contents import CageContents
from ..cage.errors import CageWarning, warn
from ..cage.sameness import same
from ..surface import LimitSurface


@dataclass(eq=False)
class _Known:
    contents: CageContents
    surface: LimitSurface
    told: list[str]
    properties: dict[str, Any] = field(default_factory=dict)


class Surfaces:
    """Makes each limit surface once: that of the left bishop is that of the right one, black or white."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, ...], list[_Known]] = {}

    def of(self, contents: CageContents) -> LimitSurface:
        """The surface of a cage; what is to be told of the cage is kept for `tell`.

        Raises
        ------
        CageError
            If the cage is invalid.
        SchemeError
            If the scheme cannot subdivide it.
        """
        return self._found(contents).surface

    def tell(self, contents: CageContents) -> None:
        """Warn of what was found in a cage, by its own name."""
        known = self._found(contents)
        for message in known.told:
            warn(message.replace(known.contents.source.name, contents.source.name))

    def properties(self, contents: CageContents, mi: Any) -> dict[str, Any]:
        """Properties of the shape ``subdivision`` that are the cage; equal cages share their tensors."""
        known = self._found(contents)
        if not known.properties:
            known.properties = known.surface.cage.as_properties(mi)
        return known.properties

    def _found(self, contents: CageContents) -> _Known:
        key = len(contents.positions), len(contents.face_sizes), zlib.crc32(contents.positions.tobytes())
        alike = self._known.setdefault(key, [])
        for known in alike:
            if same(known.contents, contents):
                return known
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", CageWarning)
            surface = LimitSurface(ControlCage.from_arrays(**contents.as_arguments()))
        alike.append(_Known(contents, surface, [str(each.message) for each in caught]))
        return alike[-1]
