"""Contents of a file with a control cage, and their comparison."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from .attributes import Attribute
from .errors import CageSource


@dataclass(frozen=True, eq=False)
class CageContents:
    """Contents of a file with a control cage, not yet validated.

    Readers of files return it, and `ControlCage.from_arrays` validates it. Writers of files take the contents of a
    cage, `ControlCage.contents`.
    """

    positions: NDArray  # (n_v, 3)
    face_sizes: IntArray  # (n_f,) int: number of vertices of each face
    face_vertices: NDArray  # (n_h,) int: 0-based vertices of all faces, face by face
    # (n, 3) float64: rows (vertex, vertex, sharpness), one for each sharp edge
    creases: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    # (n, 2) float64: rows (vertex, sharpness), one for each sharp vertex
    corners: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    # (n,) int: 0-based faces that are not part of the surface
    holes: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    texcoords: Attribute | None = None
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    # (n,) int: 0-based faces of each material, by name
    materials: Mapping[str, IntArray] = field(default_factory=dict)
    # Names and values as in `RULES`, for the rules that the file specifies
    rules: Mapping[str, str] = field(default_factory=dict)
    scheme: str | None = None  # Subdivision scheme that the file names
    # Names of the file, its lines, vertices and faces in messages
    source: CageSource = field(default_factory=CageSource)

    @property
    def material_of_face(self) -> IntArray:
        """``(n_f,)`` index of each face's material in ``materials``, the last one of several; -1 for none."""
        material = np.full(len(self.face_sizes), -1)
        for index, faces in enumerate(self.materials.values()):
            material[faces] = index
        return material

    def as_arguments(self) -> dict[str, Any]:
        """Return the arguments of `ControlCage.from_arrays`, with each rule as a separate argument."""
        return {item.name: getattr(self, item.name) for item in fields(self) if item.name != "rules"} | {**self.rules}


def same(a: Any, b: Any, but: frozenset[str] = frozenset()) -> bool:
    """Return whether nested dataclasses, mappings, lists, arrays and values are equal, except for `CageSource` values.

    ``but`` names top-level fields of ``a`` and ``b`` that may differ.
    """
    if a is b or (isinstance(a, CageSource) and isinstance(b, CageSource)):
        return True
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return False
    if is_dataclass(a):
        names = [attribute.name for attribute in fields(a) if attribute.name not in but]
        return type(a) is type(b) and all(same(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    return bool(a == b)


def same_topology(a: CageContents, b: CageContents) -> bool:
    """Return whether two cages differ in their positions only."""
    return len(a.positions) == len(b.positions) and same(a, b, frozenset({"positions"}))
