"""The control cage: the polygon mesh that is subdivided."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..mesh.connectivity import CreaseMethod, IndexArray, IntArray, Topology
from ..mesh.cuts import CutMesh, SharpMesh, Sharpness
from ..mesh.manifold import NonManifold
from ..mesh.triangulation import triangle_corners
from ..variants import variant_module
from . import validation
from .contents import RULES, Attribute, CageContents, shape_properties, validated_attribute
from .errors import CageError, CageSource

if TYPE_CHECKING:
    from scipy import sparse

    from ..refinement.cage_refinement import CageRefinement
    from ..schemes import Scheme


@dataclass(frozen=True, eq=False, init=False)
class ControlCage:
    """A polygon mesh to be subdivided, closed or with boundary. Immutable.

    Faces with a winding opposite to their neighbours' are turned over. Where the faces are not a manifold, OpenSubdiv's
    rules apply:

    - An edge is non-manifold, and infinitely sharp, if it has more than two faces, if one face has it twice, if its two
      ends are the same vertex, or if its two faces cannot be wound consistently, as on a Möbius strip.
    - A vertex at the end of a non-manifold edge, or with several fans of faces, is an infinitely sharp corner. It is on
      a crease instead if it has three or more fans, each of which runs from one to the other of the same two
      non-manifold edges.

    Under Doo-Sabin nothing is sharp: the surface ends at non-manifold edges, and each closed fan of a vertex has a
    separate element.

    Parameters
    ----------
    positions : (n_v, 3) array
        Vertices in world or object space; copied.
    faces : sequence of int sequences, or (n_f, k) int array
        0-based vertices of each face, counter-clockwise from outside. Faces have three vertices or more. A face that is
        turned over keeps its first vertex.
    creases : sequence of (vertex, vertex, sharpness), or (n, 3) array, optional
        Sharp edges. Sharpness 0 is smooth, and 10 or more is infinitely sharp. Edges with a sharpness between them are
        semi-sharp: sharp for this number of refinements, then smooth.
    corners : sequence of (vertex, sharpness), or (n, 2) array, optional
        Sharp vertices, with the same scale of sharpness.
    boundary : "edge_and_corner", "edge_only" or "none"
        Boundary interpolation of open cages, named as in OpenSubdiv and USD. With "edge_and_corner" and "edge_only",
        the surface ends along smooth boundary curves; with "edge_and_corner", vertices of one face only are corners of
        these curves. With "none", faces that touch the boundary are not part of the surface.
    crease_method : "uniform" or "chaikin"
        Decay of semi-sharp creases in a refinement: sharpness is lowered by one, or by Chaikin's rule, which also
        averages the sharpness of creases at a vertex.
    triangle_rule : "catmull_clark" or "smooth"
        Weights of Catmull-Clark for edges of triangles: the same as for other edges, or OpenSubdiv's smooth weights.
    holes : sequence of int, optional
        0-based faces that influence the surface but are not part of it.
    texcoords : Attribute or (n_v, 2) array, optional
        Texture coordinates, ``(n, 2)``. An array has one row for each vertex, and is subdivided like points.
    attributes : dict of str to Attribute or (n_v, k) array, optional
        Further data. An array has one row for each vertex.
    materials : dict of str to (n,) int, optional
        0-based faces of each material, by name. A shape can show the faces of one material.
    face_varying : str
        Where face-varying data is interpolated linearly, named as in OpenSubdiv and USD: "corners_plus1", "none",
        "corners_only", "corners_plus2", "boundaries" or "all".
    scheme : str, optional
        The scheme named by the file. `LimitSurface` uses it by default.
    strict : bool
        Whether a cage that is not an oriented 2-manifold is an error.
    source : CageSource, optional
        Names of the cage, its vertices and its faces in messages.

    Attributes
    ----------
    structure : SharpMesh
        Everything that does not depend on positions. Cages with the same faces, tags and rules share it.
    topology : Topology
        Faces and half-edges. Half-edges of non-manifold edges have no twin, like those of boundary edges.
    non_manifold : NonManifold or None
        Non-manifold edges and vertices; None if the cage is a manifold.
    tags : Sharpness
        Sharpness of edges and vertices, from creases and corners.
    positions, holes, texcoords, attributes, materials
        Read-only arrays of float64 and int64: data as `Attribute`, faces in increasing order.
    boundary, crease_method, triangle_rule, face_varying, scheme, source
        The parameters.

    Raises
    ------
    CageError
        If positions or faces are malformed; if creases, corners, holes, rules or attributes are invalid; or, with
        ``strict``, if the faces are not an oriented 2-manifold.

    Warns
    -----
    CageWarning
        If vertices belong to no face, faces are turned over, or the faces are not a manifold; if creases that are no
        edge of a face, or corners that are no vertex, are ignored.
    """

    positions: NDArray[np.float64]
    structure: SharpMesh
    topology: Topology
    non_manifold: NonManifold | None
    tags: Sharpness
    boundary: str
    crease_method: CreaseMethod
    triangle_rule: str
    face_varying: str
    holes: IntArray
    texcoords: Attribute | None
    attributes: Mapping[str, Attribute]
    materials: Mapping[str, IntArray]
    scheme: str | None
    source: CageSource

    def __init__(
        self,
        positions: ArrayLike,
        faces: Sequence[Sequence[int]] | ArrayLike,
        *,
        creases: Sequence[tuple[int, int, float]] | NDArray = (),
        corners: Sequence[tuple[int, float]] | NDArray = (),
        boundary: str = "edge_and_corner",
        crease_method: str = "uniform",
        triangle_rule: str = "catmull_clark",
        holes: Sequence[int] | NDArray = (),
        texcoords: Attribute | ArrayLike | None = None,
        attributes: Mapping[str, Attribute | ArrayLike] | None = None,
        materials: Mapping[str, Sequence[int] | NDArray] | None = None,
        face_varying: str = "corners_plus1",
        scheme: str | None = None,
        strict: bool = False,
        source: CageSource | None = None,
    ) -> None:
        source = source or CageSource()
        if not isinstance(strict, (bool, np.bool_)):
            raise CageError(f"{source.name}: strict is {strict!r}; expected True or False")
        sizes, vertices = validation.flattened_faces(faces, source)
        rules: dict[str, Any] = dict(zip(RULES, (boundary, crease_method, triangle_rule, face_varying), strict=True))
        validation.require_rules(rules, source)
        attributes = {} if attributes is None else attributes
        validation.require_names(attributes, source)
        validated = validation.validated_positions(positions, source)
        topology, non_manifold, order = validation.validated_faces(len(validated), sizes, vertices, source, strict)
        tags = validation.validated_tags(topology, creases, corners, source)
        holes = validation.validated_holes(topology, holes, source)
        structure = SharpMesh(topology, non_manifold, tags, **rules, holes=holes).shared()
        topology = structure.topology

        def checked(given: Attribute | ArrayLike, name: str, width: int | None = None) -> Attribute:
            return validated_attribute(given, name, topology, source, order, width)

        values = {
            "positions": validated,
            "structure": structure,
            **{item.name: getattr(structure, item.name) for item in fields(structure)},
            "texcoords": None if texcoords is None else checked(texcoords, "texcoords", 2),
            "attributes": {name: checked(attribute, name) for name, attribute in attributes.items()},
            "materials": {
                name: validation.validated_face_indices(topology, faces, "material face", source)
                for name, faces in (materials or {}).items()
            },
            "scheme": scheme,
            "source": source,
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_arrays(
        cls, positions: ArrayLike, face_sizes: ArrayLike, face_vertices: ArrayLike, **options: Any
    ) -> ControlCage:
        """Build a cage from flat arrays.

        Parameters
        ----------
        positions : (n_v, 3) array
        face_sizes : (n_f,) int
            Number of vertices of each face.
        face_vertices : (sum of face_sizes,) int
            0-based vertices of all faces, face by face.
        **options
            Further arguments of the constructor.

        Raises
        ------
        CageError
            As the constructor, or if ``face_sizes`` do not add up to the length of ``face_vertices``.
        """
        return cls(positions, validation.FlatFaces(np.asarray(face_sizes), np.asarray(face_vertices)), **options)

    @classmethod
    def from_file(
        cls, path: str | Path, *, prim: str | None = None, time: float | None = None, strict: bool = False, **rules: str
    ) -> ControlCage:
        """Read a cage from an ``.obj``, ``.ply``, ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.

        OBJ files may have OpenSubdiv's tags. PLY and USD files need the extra ``files`` of this package.

        Points of USD files are transformed to world space; the file's units and up axis are not applied. Files that a
        USD file references are opened, too. A damaged USD file can crash the USD library.

        Parameters
        ----------
        path : str or Path
        prim : str, optional
            For USD files with several meshes: the path of one mesh, or of a prim with one mesh below it, such as
            "/World/car"; or "*" for all meshes as one cage, if their scheme and rules are the same. Meshes that are not
            subdivision surfaces are skipped if there are others. With "*", invisible meshes, guides and proxies are
            skipped, too.
        time : float, optional
            For USD files, a time code. By default, values are read at the default time, or else at their first time
            sample. A mesh without points or faces there is read at the first time at which it has both.
        strict : bool
            Whether a cage that is not an oriented 2-manifold is an error.
        **rules
            ``boundary``, ``crease_method``, ``triangle_rule``, ``face_varying`` or ``scheme``, to override the file's.

        Raises
        ------
        CageError
            If the format is unknown, the file is malformed or its cage invalid; the message names the file and, if
            possible, the line or prim. If a USD mesh is not a subdivision surface and no ``scheme`` is given. If meshes
            that become one cage differ in scheme or rules that no argument overrides.
        OSError
            If the file cannot be read.

        Warns
        -----
        CageWarning
            If data in the file is ignored, or the file names another ``scheme``.
        """
        from ..files.formats import read_file

        return cage_of(read_file(path, prim, time, rules), **rules, strict=strict)

    def save(self, path: str | Path) -> None:
        """Write to a file: ``.obj``, ``.ply``, ``.usd``, ``.usda`` or ``.usdc``.

        `from_file` reads the same cage, except for data that the format cannot store: USD files are in single
        precision, and PLY files have no creases, corners, holes and rules. OBJ files store positions exactly.

        Raises
        ------
        CageError
            If the format is unknown.
        OSError
            If the file cannot be written. An existing file is then unchanged.

        Warns
        -----
        CageWarning
            If the format cannot store all data of the cage.
        """
        from ..files.formats import write_file

        write_file(self.contents, path)

    def with_positions(self, positions: ArrayLike) -> ControlCage:
        """Return a cage with other ``(n_v, 3)`` positions. It shares this cage's structure, without new validation.

        Raises CageError if the positions are malformed or their number differs.
        """
        validated = validation.validated_positions(positions, CageSource())
        if len(validated) != self.vertex_count:
            expected = f"{self.vertex_count}, one per vertex"
            raise CageError(f"{self.source.name}: {len(validated)} new positions; expected {expected}")
        cage = type(self).__new__(type(self))
        # Without cached values of a derived class.
        vars(cage).update({item.name: getattr(self, item.name) for item in fields(self)}, positions=validated)
        return cage

    def refined(self, scheme: str | Scheme | None = None) -> ControlCage:
        """Refine once: a cage with the same limit surface, and about four times as many control points.

        It also has the same texture coordinates and attributes on the surface. `refinement` has parameters and errors.
        """
        return self.refinement(scheme).cage

    def refinement(self, scheme: str | Scheme | None = None) -> CageRefinement:
        """Refine once, and return the refined cage with the maps from this cage to it.

        Sharpness between 0 and 10 is lowered by the cage's ``crease_method``. ``face_varying`` may change to another
        rule, if that is necessary to keep the same corners.

        Parameters
        ----------
        scheme : str or Scheme, optional
            As for `LimitSurface`. If given, the refined cage names it.

        Returns
        -------
        CageRefinement

        Raises
        ------
        CageError
            If no cage represents the refined surface, because two of its edges would have the same ends; or the refined
            values of an attribute, because of its seams.
        SchemeError
            As `LimitSurface`; or if the scheme orders refined faces differently, or does not support an attribute.
        """
        from ..refinement.cage_refinement import refine_cage

        return refine_cage(self, scheme)

    @property
    def is_corner(self) -> NDArray[np.bool_]:
        """``(n_v,)`` infinitely sharp corners, by a tag, by the boundary rule, or as non-manifold vertices."""
        return self.structure.is_corner

    @property
    def is_boundary(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether the edge of each half-edge belongs to one face only."""
        return self.structure.is_boundary

    @property
    def is_boundary_vertex(self) -> NDArray[np.bool_]:
        """``(n_v,)`` whether each vertex is on the boundary."""
        return self.structure.is_boundary_vertex

    @property
    def cut_mesh(self) -> CutMesh:
        """The cage cut along its infinitely sharp edges, with the rules of its vertices."""
        return self.structure.cut

    @property
    def is_hole(self) -> NDArray[np.bool_]:
        """``(n_f,)`` faces that are not part of the surface: holes, and with the rule "none" those at the boundary."""
        return self.structure.is_hole

    @property
    def vertex_count(self) -> int:
        return len(self.positions)

    @property
    def face_count(self) -> int:
        return self.topology.face_count

    @property
    def face_sizes(self) -> IntArray:
        """``(n_f,)`` int64, number of vertices of each face; read-only. If all are equal, a broadcast scalar."""
        return self.topology.face_sizes

    @property
    def face_vertices(self) -> IndexArray:
        """``(n_h,)`` int32, 0-based vertices of all faces, face by face; read-only."""
        return self.topology.face_vertices

    @property
    def edges(self) -> IndexArray:
        """``(n_e, 2)`` int32, 0-based ends of each edge; read-only.

        The lower vertex comes first. Rows are sorted by the higher vertex, then by the lower.
        """
        return self.topology.edge_ends

    @property
    def triangles(self) -> IndexArray:
        """``(n, 3)`` int32, 0-based vertices of triangles that cover the faces, in order of faces; read-only."""
        corners, _ = triangle_corners(self.positions, self.face_sizes, self.face_vertices)
        return validation.read_only(self.face_vertices[corners])

    def laplacian(self) -> sparse.csr_array:
        """Return the uniform Laplacian of the cage's edges, ``(n_v, n_v)`` CSR array of float64.

        The diagonal has the number of neighbours of each vertex, and neighbours have -1. The matrix is symmetric and
        positive semi-definite; constants are in its null space. `LimitSurface.stiffness` respects lengths and angles.
        """
        return self.topology.laplacian()

    @property
    def contents(self) -> CageContents:
        """Contents of a file that stores the cage."""
        return CageContents(
            positions=self.positions,
            face_sizes=self.face_sizes,
            face_vertices=self.face_vertices,
            creases=self.tags.creases(self.topology),
            corners=self.tags.corners(),
            holes=self.holes,
            texcoords=self.texcoords,
            attributes=self.attributes,
            materials=self.materials,
            rules={name: getattr(self, name) for name in RULES},
            scheme=self.scheme,
            source=self.source,
        )

    def as_properties(self, mi: ModuleType | str) -> dict[str, Any]:
        """Return properties of the shape ``subdivision``, to merge into ``mi.load_dict({"type": "subdivision", ...})``.

        Parameters
        ----------
        mi : module or str
            ``mitsuba`` with a variant set, a variant such as ``mitsuba.llvm_ad_rgb``, or its name, "llvm_ad_rgb".

        Returns
        -------
        dict
            ``positions`` (TensorXd, ``(n_v, 3)``), ``face_sizes`` and ``face_vertices`` (TensorXu), and the rules by
            name. If the cage has them: ``creases`` (TensorXf, ``(n, 3)``), ``corners`` (TensorXf, ``(n, 2)``),
            ``holes`` (TensorXu) and ``scheme``; texture coordinates as ``texcoords`` (TensorXf, ``(n, 2)``) and
            ``texcoord_indices`` (TensorXu); attributes as ``vertex_NAME``, ``varying_NAME`` or ``face_varying_NAME``
            (TensorXf, ``(n, k)``) and ``face_varying_NAME_indices`` (TensorXu).

        Raises
        ------
        ValueError
            If ``mi`` is something else, the variant does not exist, or no variant is set.
        """
        return shape_properties(self.contents, variant_module(mi))

    def __repr__(self) -> str:
        return f"ControlCage({self.source.name}, {self.vertex_count} vertices, {self.face_count} faces)"


def cage_of(contents: CageContents, **options: Any) -> ControlCage:
    """Build the cage that a file stores; options, as of `ControlCage.from_arrays`, replace the file's."""
    stored = {item.name: getattr(contents, item.name) for item in fields(contents) if item.name != "rules"}
    return ControlCage.from_arrays(**{**stored, **contents.rules, **options})
