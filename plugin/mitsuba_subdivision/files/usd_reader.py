"""Reader of USD control cages."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..cage import validation
from ..cage.contents import RULES, Attribute, CageContents, validated_attribute
from ..cage.errors import CageError, CageSource, number_of_such, shortened, warn
from ..mesh import IntArray, Topology, ragged
from . import usd_stage
from .joined_cage import joined
from .usd_skinning import Skinning
from .usd_stage import FLAT_SCHEMES, INTERPOLATIONS, RULE_ATTRIBUTES, SCHEMES, TEXCOORDS, time_of, value_at

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

Read = TypeVar("Read")


def read_usd(
    path: str | Path, prim: str | None = None, time: float | None = None, rules: Mapping[str, str] | None = None
) -> CageContents:
    """Read a mesh of a USD file, or all meshes, with subdivision attributes and primvars, in world space.

    Arguments, errors and warnings are those of `ControlCage.from_file`; the cage is not validated. Faces of left-handed
    and mirrored meshes become counter-clockwise from outside. Skeletons and blend shapes move the points.
    """
    name = f'"{path}"'
    if time is not None and not math.isfinite(time):
        raise CageError(f"{name}: time {time}; expected a finite number, a time code")
    stage = usd_stage.open_stage(path)
    from pxr import Usd

    rules, code = rules or {}, Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(float(time))
    with usd_stage.usd_errors_at(name), usd_stage.usd_messages_of(name):
        meshes = usd_stage.chosen_meshes(stage, prim, name, code, rules.get("scheme"))
        locations = [f"{name}, prim {shortened(str(mesh.GetPath()))}" for mesh in meshes]
        skinning = Skinning(code, lambda what, path: warn(f"{name}, prim {shortened(str(path))}: {what}"))
    contents = []
    for mesh, location in zip(meshes, locations, strict=True):
        # Non-finite numbers become errors that name their location.
        with usd_stage.usd_errors_at(location), np.errstate(over="ignore", invalid="ignore"):
            contents.append(MeshReader(mesh, location, skinning, rules).contents())
    return joined(contents, name)


class MeshReader:
    """Reads the attributes of one mesh."""

    def __init__(
        self,
        mesh: UsdGeom.Mesh,
        location: str,  # Beginning of messages
        skinning: Skinning,  # Has the time at which the mesh is read
        rules: Mapping[str, str] | None = None,  # As for `read_usd`
        # Gets messages about omitted attributes and their paths; by default, they are errors
        report: Callable[[str, object], None] | None = None,
    ) -> None:
        self.mesh, self.location, self.skinning = mesh, location, skinning
        self._rules, self._report, self._source = rules or {}, report, CageSource(location)

    def contents(self, attributes: Collection[str] | None = None, texcoords: str | None = None) -> CageContents:
        """The mesh as contents of a cage in world space, with all primvars.

        If names of attributes are given, the mesh is in its own space, without a scheme if it is flat, and only these
        primvars and texture coordinates are read; values of faces become values of their corners. The primvar
        ``texcoords`` is preferred for texture coordinates.
        """
        mesh, is_local = self.mesh, attributes is not None
        points = self.array(mesh.GetPointsAttr(), np.float64, required=True, width=3)
        sizes = self.array(mesh.GetFaceVertexCountsAttr(), np.int64, required=True)
        vertices = self.array(mesh.GetFaceVertexIndicesAttr(), np.int64, required=True)
        if (sizes < 0).any() or sizes.sum() != len(vertices):
            problem = f"faceVertexCounts add up to {sizes.sum()}, but faceVertexIndices has {len(vertices)} entries"
            raise self.error(problem, "as many")
        points = self.skinning.points(mesh, points)
        matrix = np.eye(4) if is_local else self._local_to_world()
        mirrors = bool(np.linalg.det(matrix[:3, :3]) < 0)
        order = ragged.reversed_order(sizes) if mirrors != self.is_left_handed() else None
        vertices = vertices if order is None else vertices[order]
        if not np.array_equal(matrix, np.eye(4)):
            points = points @ matrix[:3, :3] + matrix[3, :3]
        points = validation.validated_positions(points, self._source)
        validation.require_vertices(len(points), sizes, vertices, self._source)
        topology = Topology(len(points), sizes, vertices)

        def tags(noun: str, read: Callable[[Topology], NDArray], otherwise: NDArray) -> NDArray:
            attribute = mesh.GetPrim().GetAttribute(f"{noun}Indices")
            return self.fitting(attribute, f"the {noun}s are left out", partial(read, topology), otherwise)

        def holes(topology: Topology) -> IntArray:
            faces = self.array(mesh.GetHoleIndicesAttr(), np.int64)
            return validation.validated_face_indices(topology, faces, "hole", self._source)

        rules = {rule: self._rule(rule) for rule in RULE_ATTRIBUTES if rule not in self._rules}
        is_flat = str(self.value(mesh.GetSubdivisionSchemeAttr())) in FLAT_SCHEMES
        scheme = None if is_local and is_flat else self._scheme()
        uv, data = self._primvars(order, topology, attributes, texcoords)
        return CageContents(
            points,
            sizes,
            vertices,
            creases=tags("crease", self._creases, np.zeros((0, 3))),
            corners=tags("corner", self._corners, np.zeros((0, 2))),
            holes=tags("hole", holes, np.zeros(0, np.int64)),
            texcoords=uv,
            attributes=data,
            rules=rules,
            scheme=scheme,
            source=self._source,
        )

    def fitting(self, attribute: Usd.Attribute, consequence: str, read: Callable[[], Read], otherwise: Read) -> Read:
        """Read an attribute; if it does not fit the mesh, report the consequence and return ``otherwise``.

        Without a function for reports, this is an error.
        """
        try:
            return read()
        except CageError as error:
            if self._report is None:
                raise
            self._tell(f"{error}; {consequence}", attribute.GetPath())
            return otherwise

    def _tell(self, message: str, path: object) -> None:
        if self._report is None:
            warn(message)
        else:
            self._report(message, path)

    def error(self, problem: str, expected: str) -> CageError:
        return CageError(f"{self.location}: {problem}; expected {expected}")

    def value(self, attribute: Usd.Attribute) -> Any:
        return attribute.Get(self._time_of(attribute))

    def _time_of(self, attribute: Usd.Attribute) -> Usd.TimeCode:
        from pxr import Usd

        if self._first_time is not None and attribute.GetNumTimeSamples():
            return Usd.TimeCode(self._first_time)
        return time_of(attribute, self.skinning.time)

    @cached_property
    def _first_time(self) -> float | None:
        """First time with points and faces; None if a time is given, or the mesh has them by default."""
        mesh, code = self.mesh, self.skinning.time
        # Points come last, as they take longest to read.
        needed = (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetPointsAttr())
        if not code.IsEarliestTime() or all(_size(value_at(attribute, code)) for attribute in needed):
            return None
        times = sorted({time for attribute in needed for time in attribute.GetTimeSamples()})
        return next((time for time in times if all(_size(attribute.Get(time)) for attribute in needed)), None)

    def array(self, attribute: Usd.Attribute, kind: type, required: bool = False, width: int | None = None) -> NDArray:
        """Values of an array attribute, ``(n,)`` or ``(n, width)``, as int64 or float64."""
        value = self.value(attribute)
        if required and not _size(value):
            raise self.error(f"there are no {attribute.GetName()}", "a mesh with points and faces")
        try:
            array = np.asarray([] if value is None else value)
        except ValueError:  # For example, rows of different lengths.
            array = np.array(None)
        if not array.size and array.ndim:
            return np.zeros((0,) if width is None else (0, width), kind)
        is_table = array.ndim == 2 and array.shape[1] == width if width else array.ndim == 1
        if not is_table or array.dtype.kind not in ("iu" if kind is np.int64 else "iuf"):
            what = "integers" if kind is np.int64 else "numbers" if width is None else f"vectors of {width} numbers"
            raise self.error(f"{attribute.GetName()} is of the type {type(value).__name__}", f"an array of {what}")
        return array.astype(kind)

    def _token(self, attribute: Usd.Attribute, known: Sequence[str]) -> str:
        """Value of an attribute from a list, which begins with the schema's fallback."""

        def read() -> str:
            value = str(self.value(attribute))
            if value not in known:
                raise self.error(f'{attribute.GetName()} is "{shortened(value)}"', f"one of {', '.join(known)}")
            return value

        return self.fitting(attribute, f"{known[0]} is used", read, known[0])

    def is_left_handed(self) -> bool:
        """Whether faces are clockwise from outside."""
        return self._token(self.mesh.GetOrientationAttr(), ("rightHanded", "leftHanded")) == "leftHanded"

    def _rule(self, rule: str) -> str:
        attribute = self.mesh.GetPrim().GetAttribute(RULE_ATTRIBUTES[rule])
        value = self._token(attribute, [usd_stage.token(name) for name in RULES[rule]])
        return re.sub("([A-Z])", lambda match: f"_{match[1].lower()}", value)

    def _scheme(self) -> str:
        given = self._rules.get("scheme")
        asked = self._token(self.mesh.GetSubdivisionSchemeAttr(), [*SCHEMES, *FLAT_SCHEMES])
        if given is None:
            if asked not in SCHEMES:
                what = "is not to be subdivided" if asked == "none" else "is to be subdivided without smoothing"
                expected = f"{' or '.join(SCHEMES)}, or a scheme given in its place"
                raise self.error(f'the mesh {what}: its subdivisionScheme is "{asked}"', expected)
            return SCHEMES[asked]
        if SCHEMES.get(asked) != given:
            warn(f'{self.location}: subdivisionScheme is "{asked}"; the scheme "{given}" is used in its place')
        return given

    def _creases(self, topology: Topology) -> NDArray[np.float64]:
        """Rows (vertex, vertex, sharpness)."""
        mesh = self.mesh
        indices = self.array(mesh.GetCreaseIndicesAttr(), np.int64)
        lengths = self.array(mesh.GetCreaseLengthsAttr(), np.int64)
        sharpness = self.array(mesh.GetCreaseSharpnessesAttr(), np.float64)
        for short in np.flatnonzero(lengths < 2)[:1]:
            raise self.error(f"creaseLengths has the value {lengths[short]} at {short}", "2 or more vertices")
        if lengths.sum() != len(indices):
            problem = f"creaseLengths add up to {lengths.sum()}, but creaseIndices has {len(indices)} entries"
            raise self.error(problem, "as many")
        edges = lengths - 1
        validation.require_sharpness(sharpness, lambda row: f"{self.location}: value {row} of creaseSharpnesses")
        if len(sharpness) == len(lengths):
            sharpness = np.repeat(sharpness, edges)
        elif len(sharpness) != edges.sum():
            expected = f"{len(lengths)}, one per crease, or {edges.sum()}, one per edge"
            raise self.error(f"creaseSharpnesses has {len(sharpness)} entries", expected)
        start = np.delete(np.arange(len(indices)), np.cumsum(lengths) - 1)
        return self._rows_of_mesh(np.stack([indices[start], indices[start + 1], sharpness], 1), topology, "crease")

    def _corners(self, topology: Topology) -> NDArray[np.float64]:
        """Rows (vertex, sharpness)."""
        indices = self.array(self.mesh.GetCornerIndicesAttr(), np.int64)
        sharpness = self.array(self.mesh.GetCornerSharpnessesAttr(), np.float64)
        if len(indices) != len(sharpness):
            problem = f"cornerSharpnesses has {len(sharpness)} entries, but cornerIndices has {len(indices)}"
            raise self.error(problem, "as many")
        validation.require_sharpness(sharpness, lambda row: f"{self.location}: value {row} of cornerSharpnesses")
        return self._rows_of_mesh(np.stack([indices, sharpness], axis=1), topology, "corner")

    def _rows_of_mesh(self, rows: NDArray[np.float64], topology: Topology, noun: str) -> NDArray[np.float64]:
        """Rows of creases or corners with valid vertices, as others would be other meshes' in a joined cage."""
        vertices, vertex_count = rows[:, :-1], topology.vertex_count
        is_inside = ((vertices >= 0) & (vertices < vertex_count)).all(axis=1)
        for row in np.flatnonzero(~is_inside)[:1]:
            numbers = ", ".join(f"{vertex:.0f}" for vertex in vertices[row])
            such = number_of_such(int((~is_inside).sum()), noun)
            expected = f"expected vertices from 0 to {vertex_count - 1}"
            path = self.mesh.GetPrim().GetAttribute(f"{noun}Indices").GetPath()
            self._tell(f"{self.location}: {noun} at ({numbers}) is ignored; {expected} ({such})", path)
        return rows[is_inside]

    def _local_to_world(self) -> NDArray[np.float64]:
        matrix = np.array(usd_stage.local_to_world(self.mesh.GetPrim(), self._time_of))
        # The determinant is meaningless for a non-finite matrix.
        if not np.isfinite(matrix).all() or np.linalg.det(matrix[:3, :3]) == 0:
            problem = f"the transform to world space is {shortened(str(matrix.tolist()), 200)}"
            raise self.error(problem, "an invertible matrix")
        return matrix

    def _primvars(
        self, order: IntArray | None, topology: Topology, chosen: Collection[str] | None, first_name: str | None
    ) -> tuple[Attribute | None, dict[str, Attribute]]:
        """Texture coordinates and attributes, from primvars of floating-point numbers.

        Texture coordinates are the first of "st", "UVMap" and "texcoords", or else one of type ``texCoord2``.
        Constants, joints, and normals, which follow from the surface, are skipped without a warning.
        """
        from pxr import UsdGeom

        preferred = TEXCOORDS if first_name is None else (first_name, *TEXCOORDS)
        known = INTERPOLATIONS if chosen is None else (*INTERPOLATIONS, "uniform")
        attributes: dict[str, Attribute] = {}
        pairs: list[str] = []
        left_out: dict[str, str] = {}
        for primvar in UsdGeom.PrimvarsAPI(self.mesh).GetPrimvarsWithAuthoredValues():
            name, kind, interpolation = primvar.GetPrimvarName(), str(primvar.GetTypeName()), primvar.GetInterpolation()
            if interpolation == UsdGeom.Tokens.constant or name == "normals" or name.startswith("skel:"):
                continue
            is_pair = kind.startswith("texCoord2")
            if chosen is not None and not (is_pair or name in preferred or name in chosen):
                continue
            attribute = primvar.GetAttr()
            table = _table(self.value(attribute), primvar.GetElementSize())
            if table is None or interpolation not in known:
                left_out[str(attribute.GetPath())] = f'"{name}" ({kind}, {interpolation})'
                continue
            indexed = primvar.GetIndicesAttr() if primvar.IsIndexed() else None
            width = 2 if name == first_name else None
            read = partial(self._attribute, name, table, indexed, interpolation, order, topology, width)
            if (values := self.fitting(attribute, "the primvar is left out", read, None)) is not None:
                attributes[name] = values
                pairs += [name] if is_pair else []
        if left_out:
            shown = shortened(", ".join(left_out.values()), 200)
            message = f"{self.location}: primvars {shown} left out; expected floats, at vertices or face corners"
            self._tell(message, ", ".join(left_out))
        known_pairs = [name for name, values in attributes.items() if values.values.shape[1] == 2]
        first = next((name for name in (*preferred, *pairs) if name in known_pairs), None)
        texcoords = None if first is None else attributes[first]
        kept = attributes.keys() - {first} if chosen is None else chosen
        return texcoords, {name: values for name, values in attributes.items() if name in kept}

    def normals(self, cage: CageContents) -> NDArray[np.float64] | None:
        """Authored normals of a polygon mesh in its own space after skinning, ``(n_h, 3)`` at face corners, if any."""
        from pxr import UsdGeom

        mesh, primvar = self.mesh, UsdGeom.PrimvarsAPI(self.mesh).GetPrimvar("normals")
        is_primvar = primvar and primvar.HasAuthoredValue()
        attribute = primvar.GetAttr() if is_primvar else mesh.GetNormalsAttr()
        interpolation = primvar.GetInterpolation() if is_primvar else mesh.GetNormalsInterpolation()
        topology = Topology(len(cage.positions), cage.face_sizes, cage.face_vertices)

        def read() -> NDArray[np.float64] | None:
            values = self.array(attribute, np.float64, width=3)
            if not len(values):
                return None
            known = (*INTERPOLATIONS, "uniform", "constant")
            if interpolation not in known:
                raise self.error(f'normals have the interpolation "{interpolation}"', f"one of {', '.join(known)}")
            indexed = primvar.GetIndicesAttr() if is_primvar and primvar.IsIndexed() else None
            order = ragged.reversed_order(cage.face_sizes) if self.is_left_handed() else None
            normals = self._attribute("normals", values, indexed, interpolation, order, topology)
            return normals.values[topology.face_vertices if normals.indices is None else normals.indices]

        if (normals := self.fitting(attribute, "the normals are left out", read, None)) is None:
            return None
        return self.skinning.normals(mesh, cage.positions, cage.face_vertices, normals)

    def _attribute(
        self,
        name: str,
        values: NDArray[np.float64],
        indexed: Usd.Attribute | None,
        interpolation: str,
        order: IntArray | None,
        topology: Topology,
        width: int | None = None,
    ) -> Attribute:
        """An attribute from a primvar; values of faces or of the mesh become values of face corners."""
        where = f'{self.location}: primvar "{shortened(name)}"'
        sizes, vertices = topology.face_sizes, topology.face_vertices
        indices = None if indexed is None else self.array(indexed, np.int64)
        if interpolation in ("vertex", "varying"):
            if indices is not None:
                validation.require_range(indices, len(values), f"{where} has")
                values, indices = values[indices], None
        else:
            rows, count, per = order, len(vertices), "face corner"
            if interpolation == "uniform":
                rows, count, per = np.repeat(np.arange(len(sizes)), sizes), len(sizes), "face"
            elif interpolation == "constant":
                rows, count, per = np.zeros(len(vertices), np.int64), 1, "mesh"
            elif indices is None:
                # The order is its own inverse.
                values, indices = _with_shared_values(values, sizes, vertices if order is None else vertices[order])
            if rows is not None:
                indices = np.arange(len(values)) if indices is None else indices
                if len(indices) != count:
                    raise CageError(f"{where} has {len(indices)} values or indices; expected {count}, one per {per}")
                indices = indices[rows]
        attribute = Attribute(values, INTERPOLATIONS.get(interpolation, "face_varying"), indices)
        return validated_attribute(attribute, name, topology, self._source, width=width)


def _table(value: Any, element_size: int) -> NDArray[np.float64] | None:
    """Table with one row per element; None if the values are not floating-point numbers."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return None
    if array.dtype.kind != "f" or array.ndim not in (1, 2) or not len(array):
        return None
    width = max(element_size, 1) * (array.shape[1] if array.ndim == 2 else 1)
    return array.astype(np.float64).reshape(-1, width) if array.size % width == 0 else None


def _with_shared_values(
    values: NDArray[np.float64], sizes: IntArray, vertices: IntArray
) -> tuple[NDArray[np.float64], IntArray | None]:
    """Values and the index of each face corner; corners at a vertex share equal values.

    As in Blender, only faces of the same winding in the texture's plane share pairs of numbers: a mirrored half is a
    separate island. If there are not as many values as corners, they are returned unchanged.
    """
    if len(values) != len(vertices) or sizes.sum() != len(vertices) or not sizes.all():
        return values, None
    keys = [*(values + 0.0).T]
    if values.shape[1] == 2:
        starts = np.cumsum(sizes) - sizes
        after = np.arange(1, len(vertices) + 1)
        after[starts + sizes - 1] = starts
        (u, v), (next_u, next_v) = values.T, values[after].T
        keys.append(np.repeat(np.add.reduceat(u * next_v - v * next_u, starts) > 0, sizes))
    # Most corners have the values of the first corner at their vertex; only the others are sorted.
    source = ragged.first_indices(vertices, int(vertices.max(initial=-1)) + 1)[vertices]
    rest = np.flatnonzero(np.any([key != key[source] for key in keys], axis=0))
    sorted_keys = [vertices[rest], *(key[rest] for key in keys)]
    rest = rest[order := np.lexsort(sorted_keys)]
    is_first = np.any([np.diff(key[order], prepend=np.nan) != 0 for key in sorted_keys], axis=0)
    source[rest] = rest[is_first][np.cumsum(is_first) - 1]
    is_row = np.bincount(source, minlength=len(source)) > 0
    return values[is_row], (np.cumsum(is_row) - 1)[source]


def _size(value: Any) -> int:
    """Number of entries of an array: 0 for None, and 1 for a value that is no array."""
    try:
        return len(value)
    except TypeError:
        return 0 if value is None else 1
