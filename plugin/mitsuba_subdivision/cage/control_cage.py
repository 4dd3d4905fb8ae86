"""The control cage: the polygon mesh that a subdivision surface is made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .connectivity import IntArray, Topology
from .creases import CutMesh, cut_along
from .errors import CageError
from .obj_reader import read_obj
from .obj_writer import write_obj
from .source import CageSource
from .tags import INFINITE, SharpTags, validated_tags
from .validation import flattened_faces, validated_positions, validated_topology

BOUNDARY_RULES = ("edge_and_corner", "edge_only")

_READERS = {".obj": read_obj}
_WRITERS = {".obj": write_obj}


@dataclass(frozen=True, eq=False, init=False, repr=False)
class ControlCage:
    """A polygon mesh to be subdivided: an oriented 2-manifold, closed or with boundary. Immutable.

    Parameters
    ----------
    positions : (n_v, 3) array
        Vertices, world or object space; copied.
    faces : sequence of int sequences, or (n_f, k) int array
        0-based vertices of each face, counter-clockwise from outside. Faces may have any size from 3 up.
    creases : sequence of (vertex, vertex, sharpness), optional
        Sharp edges. Infinitely sharp ones have a sharpness of 10 or more; 0 is smooth.
    corners : sequence of (vertex, sharpness), optional
        Sharp vertices, likewise.
    boundary : "edge_and_corner" or "edge_only"
        How an open cage's surface ends, as OpenSubdiv and USD name it: along smooth curves that begin and end at the
        vertices of one face only, or along smooth curves everywhere.
    source : CageSource, optional
        Where the cage comes from, for error messages.

    Attributes
    ----------
    positions : (n_v, 3) float64
        Read-only.
    topology : Topology
        Faces and half-edges; what is computed of it is kept.
    tags : SharpTags
        Creases and corners.
    boundary : str
    source : CageSource

    Raises
    ------
    CageError
        If positions or faces are malformed, or the faces are not an oriented 2-manifold.

    Warns
    -----
    CageWarning
        If vertices belong to no face.
    """

    positions: NDArray[np.float64]
    topology: Topology
    tags: SharpTags
    boundary: str
    source: CageSource

    def __init__(
        self,
        positions: ArrayLike,
        faces: Sequence[Sequence[int]] | ArrayLike,
        *,
        creases: Sequence[tuple[int, int, float]] = (),
        corners: Sequence[tuple[int, float]] = (),
        boundary: str = "edge_and_corner",
        source: CageSource | None = None,
    ) -> None:
        source = source or CageSource()
        self._fill(positions, *flattened_faces(faces, source), creases, corners, boundary, source)

    @classmethod
    def from_arrays(
        cls,
        positions: ArrayLike,
        face_sizes: ArrayLike,
        face_vertices: ArrayLike,
        *,
        creases: Sequence[tuple[int, int, float]] = (),
        corners: Sequence[tuple[int, float]] = (),
        boundary: str = "edge_and_corner",
        source: CageSource | None = None,
    ) -> ControlCage:
        """Build from flat arrays.

        Parameters
        ----------
        positions : (n_v, 3) array
        face_sizes : (n_f,) int
            Vertices of each face.
        face_vertices : (sum of face_sizes,) int
            0-based vertices of all faces, one after the other.
        creases, corners, boundary, source : optional
            As for the constructor.

        Raises
        ------
        CageError
            As the constructor does, or if the sizes do not add up.
        """
        cage = cls.__new__(cls)
        cage._fill(positions, face_sizes, face_vertices, creases, corners, boundary, source or CageSource())
        return cage

    @classmethod
    def from_file(cls, path: str | Path, *, boundary: str | None = None) -> ControlCage:
        """Read a cage from an ``.obj`` file, with creases and corners from OpenSubdiv's tags.

        Parameters
        ----------
        path : str or Path
        boundary : str, optional
            Boundary rule in place of the file's own, which is "edge_and_corner" unless a tag says otherwise.

        Raises
        ------
        CageError
            If the format is unknown, the file is malformed or its cage invalid; names file and line.
        OSError
            If the file cannot be read.
        """
        positions, face_sizes, face_vertices, source, tags = _by_suffix(_READERS, path)(path)
        return cls.from_arrays(
            positions,
            face_sizes,
            face_vertices,
            creases=tags.creases,
            corners=tags.corners,
            boundary=boundary or tags.boundary or "edge_and_corner",
            source=source,
        )

    def save(self, path: str | Path) -> None:
        """Write to an ``.obj`` file from which `from_file` reads the same cage back, bit by bit.

        Raises
        ------
        CageError
            If the format is unknown.
        OSError
            If the file cannot be written; an existing one is then left as it was.
        """
        _by_suffix(_WRITERS, path)(self, path)

    def with_positions(self, positions: ArrayLike) -> ControlCage:
        """Cage with the same topology, which is shared and not validated again, and other ``(n_v, 3)`` positions.

        Raises
        ------
        CageError
            If the positions are malformed or their number differs.
        """
        kept = validated_positions(positions, CageSource())
        if len(kept) != self.vertex_count:
            raise CageError(
                f"{self.source.name}: {len(kept)} new positions; expected {self.vertex_count}, one per vertex"
            )
        cage = type(self).__new__(type(self))
        cage._set(kept, self.topology, self.tags, self.boundary, self.source)
        return cage

    @cached_property
    def cut_mesh(self) -> CutMesh:
        """The cage cut along its infinitely sharp edges, with the rules of its vertices."""
        t = self.topology
        corners = self.tags.is_corner.copy()
        if self.boundary == "edge_and_corner":
            corners |= t.is_boundary_vertex & (t.vertex_face_count == 1)
        return cut_along(t, self.tags.is_sharp, corners)

    @property
    def vertex_count(self) -> int:
        return len(self.positions)

    @property
    def face_count(self) -> int:
        return self.topology.face_count

    @property
    def face_sizes(self) -> IntArray:
        """``(n_f,)`` vertices of each face; read-only."""
        return self.topology.face_sizes

    @property
    def face_vertices(self) -> IntArray:
        """``(n_h,)`` 0-based vertices of all faces, one after the other; read-only."""
        return self.topology.face_vertices

    def as_properties(self, mi: Any) -> dict[str, Any]:
        """Cage as properties to merge into ``mi.load_dict({"type": "subdivision", ...})``.

        Parameters
        ----------
        mi : module
            ``mitsuba`` with a variant set, or a variant such as ``mitsuba.llvm_ad_rgb``.

        Returns
        -------
        dict
            ``positions`` (TensorXf, ``(n_v, 3)``, in the precision of the variant), ``face_sizes`` and
            ``face_vertices`` (TensorXu), ``boundary``, and ``creases`` (TensorXf, ``(n, 3)``) and ``corners``
            (TensorXf, ``(n, 2)``) where there are any.
        """
        t = self.topology
        sharp = t.edge_half_edge[self.tags.is_sharp[t.edge_half_edge]]
        creases = np.stack(
            [t.face_vertices[sharp], t.face_vertices[t.next[sharp]], np.full(len(sharp), INFINITE)], axis=1
        )
        corners = np.flatnonzero(self.tags.is_corner)
        tags = {"creases": creases, "corners": np.stack([corners, np.full(len(corners), INFINITE)], axis=1)}
        return {
            "positions": mi.TensorXf(self.positions),
            "face_sizes": mi.TensorXu(self.face_sizes.astype(np.uint32)),
            "face_vertices": mi.TensorXu(self.face_vertices.astype(np.uint32)),
            "boundary": self.boundary,
            **{name: mi.TensorXf(table) for name, table in tags.items() if len(table)},
        }

    def __repr__(self) -> str:
        return f"ControlCage({self.source.name}, {self.vertex_count} vertices, {self.face_count} faces)"

    def _fill(
        self,
        positions: ArrayLike,
        face_sizes: ArrayLike,
        face_vertices: ArrayLike,
        creases: Sequence[tuple[int, int, float]],
        corners: Sequence[tuple[int, float]],
        boundary: str,
        source: CageSource,
    ) -> None:
        if boundary not in BOUNDARY_RULES:
            raise CageError(f'{source.name}: boundary rule "{boundary}"; expected one of {", ".join(BOUNDARY_RULES)}')
        kept = validated_positions(positions, source)
        topology = validated_topology(len(kept), face_sizes, face_vertices, source)
        self._set(kept, topology, validated_tags(topology, creases, corners, source), boundary, source)

    def _set(
        self,
        positions: NDArray[np.float64],
        topology: Topology,
        tags: SharpTags,
        boundary: str,
        source: CageSource,
    ) -> None:
        # The dataclass is frozen, so that its own construction has to go around `__setattr__`.
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "topology", topology)
        object.__setattr__(self, "tags", tags)
        object.__setattr__(self, "boundary", boundary)
        object.__setattr__(self, "source", source)


def _by_suffix(table: dict[str, Any], path: str | Path) -> Any:
    suffix = Path(path).suffix.lower()
    if suffix not in table:
        raise CageError(f'"{path}": unknown cage format "{suffix}"; expected one of {", ".join(table)}')
    return table[suffix]
