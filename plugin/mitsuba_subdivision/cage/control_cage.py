"""The control cage: the polygon mesh that a subdivision surface is made from."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..mesh.cuts import CutMesh, SharpMesh
from ..mesh.manifold import NonManifold
from ..mesh.sharpness import Sharpness
from .attributes import Attribute, attribute_properties, validated_attributes, validated_texcoords
from .contents import RULES
from .errors import CageError
from .formats import read_file, write_file
from .source import CageSource
from .tags import validated_tags
from .validation import flattened_faces, validated_faces, validated_holes, validated_positions


@dataclass(frozen=True, eq=False, init=False, repr=False)
class ControlCage:
    """A polygon mesh to be subdivided, closed or with boundary. Immutable.

    Where it is no manifold, it has OpenSubdiv's meaning. An edge of more than two faces is infinitely sharp, as is one
    that a face has twice or between equal vertices; a vertex of such an edge, or whose faces are several fans, is a
    corner, unless three fans or more all run from one such edge to another, which then are a crease. Faces wound
    against their neighbours are turned; where they cannot all agree, as on a Möbius strip, edges between some that do
    not are sharp as well. Under Doo-Sabin, nothing is sharp: the surface ends at such edges, and each fan that goes all
    around a vertex has an element of its own.

    Parameters
    ----------
    positions : (n_v, 3) array
        Vertices, world or object space; copied.
    faces : sequence of int sequences, or (n_f, k) int array
        0-based vertices of each face, counter-clockwise from outside. Faces may have any size from 3 up. One that is
        turned keeps its first vertex.
    creases : sequence of (vertex, vertex, sharpness), optional
        Sharp edges. 0 is smooth, 10 and more infinitely sharp; between them, an edge is sharp for as many refinements.
    corners : sequence of (vertex, sharpness), optional
        Sharp vertices, likewise.
    boundary : "edge_and_corner", "edge_only" or "none"
        How an open cage's surface ends, as OpenSubdiv and USD name it: along smooth curves that begin and end at the
        vertices of one face only; along smooth curves everywhere; or with the faces that do not touch the boundary.
    crease_method : "uniform" or "chaikin"
        How semi-sharp creases of different sharpness go over into each other: not at all, or by Chaikin's rule.
    triangle_rule : "catmull_clark" or "smooth"
        Whether Catmull-Clark gives edges of triangles weights of their own, as OpenSubdiv does on request.
    holes : sequence of int, optional
        0-based faces that shape the surface but are not part of it.
    texcoords : Attribute or (n_v, 2) array, optional
        Texture coordinates, ``(n, 2)``; a bare array has a row for each vertex, subdivided as points are.
    attributes : dict of str to Attribute or (n_v, k) array, optional
        Further data, likewise.
    face_varying : str
        Where face-varying data is interpolated linearly, as OpenSubdiv and USD name it: "corners_plus1", "none",
        "corners_only", "corners_plus2", "boundaries" or "all".
    scheme : str, optional
        The scheme that the file asks for; `LimitSurface` uses it where it is not told another.
    strict : bool
        Whether a cage that is no oriented 2-manifold is an error.
    source : CageSource, optional
        Where the cage comes from, for error messages.

    Attributes
    ----------
    positions : (n_v, 3) float64
        Read-only.
    topology : Topology
        Faces and half-edges; what is computed of it is kept. Non-manifold edges are borders of each of their faces.
    non_manifold : NonManifold or None
        Where the cage is no manifold, if anywhere.
    tags : Sharpness
        Creases and corners.
    boundary, crease_method, triangle_rule, face_varying : str
    holes : (n,) int64
        In increasing order.
    texcoords : Attribute or None
    attributes : dict of str to Attribute
    scheme : str or None
    source : CageSource

    Raises
    ------
    CageError
        If positions or faces are malformed, tags, rules or attributes do not fit them, or, if ``strict``, the faces are
        not an oriented 2-manifold.

    Warns
    -----
    CageWarning
        If vertices belong to no face, the cage is no manifold, or faces are turned.
    """

    positions: NDArray[np.float64]
    topology: Topology
    non_manifold: NonManifold | None
    tags: Sharpness
    boundary: str
    crease_method: str
    triangle_rule: str
    face_varying: str
    holes: IntArray
    texcoords: Attribute | None
    attributes: Mapping[str, Attribute]
    scheme: str | None
    source: CageSource

    def __init__(
        self,
        positions: ArrayLike,
        faces: Sequence[Sequence[int]] | ArrayLike,
        *,
        creases: Sequence[tuple[int, int, float]] = (),
        corners: Sequence[tuple[int, float]] = (),
        boundary: str = "edge_and_corner",
        crease_method: str = "uniform",
        triangle_rule: str = "catmull_clark",
        holes: Sequence[int] = (),
        texcoords: Attribute | ArrayLike | None = None,
        attributes: Mapping[str, Attribute | ArrayLike] | None = None,
        face_varying: str = "corners_plus1",
        scheme: str | None = None,
        strict: bool = False,
        source: CageSource | None = None,
    ) -> None:
        source = source or CageSource()
        if not isinstance(strict, (bool, np.bool_)):
            raise CageError(f"{source.name}: strict is {strict!r}; expected True or False")
        sizes, vertices = faces if isinstance(faces, _FlatFaces) else flattened_faces(faces, source)
        rules = {
            "boundary": boundary,
            "crease_method": crease_method,
            "triangle_rule": triangle_rule,
            "face_varying": face_varying,
        }
        for name, rule in rules.items():
            if rule not in RULES[name]:
                raise CageError(f'{source.name}: {name} "{rule}"; expected one of {", ".join(RULES[name])}')
        kept = validated_positions(positions, source)
        validated = validated_faces(len(kept), sizes, vertices, source, strict)
        topology, order = validated.topology, validated.order
        self._set(
            positions=kept,
            topology=topology,
            non_manifold=validated.non_manifold,
            tags=validated_tags(topology, creases, corners, source),
            holes=validated_holes(topology, holes, source),
            texcoords=validated_texcoords(texcoords, topology, source, order),
            attributes=validated_attributes(attributes, topology, source, order),
            scheme=scheme,
            source=source,
            **rules,
        )

    @classmethod
    def from_arrays(
        cls,
        positions: ArrayLike,
        face_sizes: ArrayLike,
        face_vertices: ArrayLike,
        **options: Any,
    ) -> ControlCage:
        """Build from flat arrays.

        Parameters
        ----------
        positions : (n_v, 3) array
        face_sizes : (n_f,) int
            Vertices of each face.
        face_vertices : (sum of face_sizes,) int
            0-based vertices of all faces, one after the other.
        **options
            As for the constructor.

        Raises
        ------
        CageError
            As the constructor does, or if the sizes do not add up.
        """
        return cls(positions, _FlatFaces(face_sizes, face_vertices), **options)

    @classmethod
    def from_file(
        cls, path: str | Path, *, prim: str | None = None, time: float | None = None, strict: bool = False, **rules: str
    ) -> ControlCage:
        """Read a cage from an ``.obj``, ``.ply``, ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.

        OBJ files may have OpenSubdiv's tags. The packages that read PLY and USD files come with the extras ``ply`` and
        ``usd``. The points of a USD file are in its world space; its units and up axis are left alone. USD
        files open those that they refer to, and can crash the USD library: set the environment variable
        ``MITSUBA_SUBDIVISION_USD_PROCESS`` to a number of seconds to have them read in a process of their own.

        Parameters
        ----------
        path : str or Path
        prim : str, optional
            For USD files with several meshes, the path of one, or of a prim with one mesh below it: "/World/car"; or
            "*" for all as one cage, which takes one scheme and set of rules. Meshes that are not to be smoothed are
            passed over where there are others, and by "*" those that are invisible, guides or proxies.
        time : float, optional
            For USD files, a time code. By default, values that do not depend on time, or the first ones; a mesh without
            points or faces at its first time is read at the first time at which it has both.
        strict : bool
            Whether a cage that is no oriented 2-manifold is an error.
        **rules
            ``boundary``, ``crease_method``, ``triangle_rule``, ``face_varying`` or ``scheme`` in place of the file's
            own.

        Raises
        ------
        CageError
            If the format is unknown, the file is malformed or its cage invalid; names the file, and line or prim. If a
            USD mesh is not a subdivision surface and no ``scheme`` is given, or meshes differ in rules that none is
            given for.
        OSError
            If the file cannot be read.

        Warns
        -----
        CageWarning
            If something that the file has is left out, or the file asks for another ``scheme``.
        """
        return cls.from_arrays(**{**read_file(path, prim, time, rules), **rules}, strict=strict)

    def save(self, path: str | Path) -> None:
        """Write to a file: ``.obj``, ``.ply``, ``.usd``, ``.usda`` or ``.usdc``.

        `from_file` reads the same cage back, from OBJ files bit by bit, but for what the format has no place for. USD
        files hold single precision; PLY files have no tags and rules.

        Raises
        ------
        CageError
            If the format is unknown.
        OSError
            If the file cannot be written; an existing one is then left as it was.

        Warns
        -----
        CageWarning
            If the format cannot hold all that the cage has.
        """
        write_file(self, path)

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
        cage._set(**{**vars(self), "positions": kept})
        return cage

    @cached_property
    def is_corner(self) -> NDArray[np.bool_]:
        """``(n_v,)`` whether each vertex is an infinitely sharp corner: by its tag, the boundary rule, or its fans."""
        t, found = self.topology, self.tags.is_corner
        if self.non_manifold is not None:
            found = found | self.non_manifold.is_corner
        if self.boundary != "edge_and_corner":
            return found
        return found | (t.is_boundary_vertex & (t.vertex_face_count == 1))

    @cached_property
    def is_boundary(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether no other face shares the edge of each half-edge."""
        is_border, found = self.topology.twin < 0, self.non_manifold
        return is_border if found is None else is_border & ~found.is_edge | found.is_own_edge

    @cached_property
    def is_boundary_vertex(self) -> NDArray[np.bool_]:
        """``(n_v,)`` whether a boundary edge ends at the vertex."""
        return self.topology.ends_of(self.is_boundary)

    @cached_property
    def sharp_mesh(self) -> SharpMesh:
        """The cage's mesh with all that is sharp about it."""
        is_corner, is_boundary_vertex = self.is_corner, self.is_boundary_vertex
        return SharpMesh(self.topology, self.tags, is_corner, is_boundary_vertex, self.crease_method, self.non_manifold)

    @cached_property
    def cut_mesh(self) -> CutMesh:
        """The cage cut along its infinitely sharp edges, with the rules of its vertices."""
        return self.sharp_mesh.cut

    @cached_property
    def is_hole(self) -> NDArray[np.bool_]:
        """``(n_f,)`` whether each face is left out of the surface: a hole, or at a boundary that has no rule."""
        t = self.topology
        hole = np.zeros(t.face_count, dtype=bool)
        hole[self.holes] = True
        if self.boundary == "none":
            at_boundary = t.ends_of(self.is_boundary & ~self.tags.is_sharp)
            hole[t.face_of(np.flatnonzero(at_boundary[t.face_vertices]))] = True
        return hole

    @property
    def vertex_count(self) -> int:
        return len(self.positions)

    @property
    def face_count(self) -> int:
        return self.topology.face_count

    @property
    def face_sizes(self) -> IntArray:
        """``(n_f,)`` int64, vertices of each face; read-only, and one number with stride 0 where all are equal."""
        return self.topology.face_sizes

    @property
    def face_vertices(self) -> IndexArray:
        """``(n_h,)`` int32, 0-based vertices of all faces, one after the other; read-only."""
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
            ``positions`` (TensorXd, ``(n_v, 3)``), ``face_sizes`` and ``face_vertices`` (TensorXu), the rules by name,
            and ``creases`` (TensorXf, ``(n, 3)``), ``corners`` (TensorXf, ``(n, 2)``), ``holes`` (TensorXu) and
            ``scheme`` where there are any. Texture coordinates are
            ``texcoords`` (TensorXf, ``(n, 2)``) and ``texcoord_indices`` (TensorXu), attributes ``vertex_NAME``,
            ``varying_NAME`` or ``face_varying_NAME`` (TensorXf, ``(n, k)``) and ``face_varying_NAME_indices``.
        """
        tables = {"creases": self.tags.creases(self.topology), "corners": self.tags.corners()}
        indices = {"face_sizes": self.face_sizes, "face_vertices": self.face_vertices}
        if len(self.holes):
            indices["holes"] = self.holes
        return {
            # In full: far from the origin, single precision would lose what normals show.
            "positions": mi.TensorXd(self.positions),
            **{name: mi.TensorXu(array.astype(np.uint32)) for name, array in indices.items()},
            **{name: getattr(self, name) for name in RULES},
            **({"scheme": self.scheme} if self.scheme else {}),
            **{name: mi.TensorXf(table) for name, table in tables.items() if len(table)},
            **attribute_properties(self.texcoords, self.attributes, mi),
        }

    def __repr__(self) -> str:
        return f"ControlCage({self.source.name}, {self.vertex_count} vertices, {self.face_count} faces)"

    def _set(self, **fields: Any) -> None:
        # The dataclass is frozen, so that its own construction has to go around `__setattr__`.
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, fields[field.name])


class _FlatFaces(NamedTuple):
    """Faces as sizes and concatenated vertices."""

    sizes: ArrayLike
    vertices: ArrayLike
