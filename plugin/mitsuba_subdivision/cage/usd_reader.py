"""Reader of USD control cages."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .errors import CageError, warn
from .rules import RULES
from .source import CageSource
from .usd_names import RULE_ATTRIBUTES, SCHEMES, rule_name, token
from .usd_primvars import read_primvars

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom


def read_usd(
    path: str | Path, prim: str | None = None, time: float | None = None, scheme: str | None = None
) -> dict[str, Any]:
    """Read a mesh of a USD file, with its subdivision attributes and primvars, in world space.

    Faces of left-handed meshes, and of meshes that their transform mirrors, are turned round, so that they are
    counter-clockwise from outside. The stage's units and up axis are left alone.

    Parameters
    ----------
    path : str or Path
    prim : str, optional
        Path of the mesh, or of a prim with one mesh below it. By default the file's only mesh.
    time : float, optional
        Time code. By default each value is the one that does not depend on time, or else the first one.
    scheme : str, optional
        Scheme in place of the mesh's own.

    Returns
    -------
    dict
        Arguments of `ControlCage.from_arrays`.

    Raises
    ------
    CageError
        If the package usd-core is missing; if the file is malformed; if there is no such mesh, or more than one; if
        the mesh is not a subdivision surface of a known scheme and none is given; if its attributes do not fit
        together. The cage itself is not validated.
    OSError
        If the file cannot be read.

    Warns
    -----
    CageWarning
        If another scheme is given than the mesh's, references of the stage lead nowhere, or primvars are left out.
    """
    name = f'"{path}"'
    stage = _open(path, name)
    if time is not None and not math.isfinite(time):
        raise CageError(f"{name}: time {time}; expected a finite number, a time code")
    mesh = _chosen_mesh(stage, prim, name)
    return _MeshReader(mesh, f"{name}, prim {mesh.GetPath()}", time).arguments(scheme)


def _open(path: str | Path, name: str) -> Usd.Stage:
    try:
        from pxr import Tf, Usd
    except ImportError:
        raise CageError(
            f'{name}: the package usd-core, which reads USD files, is missing; pip install "mitsuba-subdivision[usd]"'
        ) from None
    with Path(path).open("rb"):
        pass  # A missing file is an OSError, as for other formats.
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise CageError(f"{_reason(error, path, name)}; expected a USD file (is it cut short?)") from None
    errors = stage.GetCompositionErrors()
    if errors:
        more = f" ({len(errors)} such errors)" if len(errors) > 1 else ""
        warn(f"{name}: the stage is incomplete: {str(errors[0]).strip()}{more}")
    return stage


def _reason(error: Exception, path: str | Path, name: str) -> str:
    """Beginning of a message: where and why USD could not read a file; its first reason says most."""
    reason = error.args[0].commentary.strip()
    place = re.match(re.escape(str(Path(path).absolute())) + r":(\d+):\d+: ", reason)
    if not place:
        return f"{name}: {reason}"
    # The parser names rules of its grammar, in C++.
    what = re.sub("parse error matching .* at ", "syntax error at ", reason[place.end() :], flags=re.DOTALL)
    return f"{name}, line {place[1]}: {what}"


def _chosen_mesh(stage: Usd.Stage, path: str | None, name: str) -> UsdGeom.Mesh:
    from pxr import Sdf, Usd, UsdGeom

    prims = stage.Traverse(Usd.TraverseInstanceProxies())
    meshes = {prim.GetPath(): UsdGeom.Mesh(prim) for prim in prims if prim.IsA(UsdGeom.Mesh)}
    if not meshes:
        raise CageError(f"{name}: there are no meshes; expected a prim of the type Mesh")
    if path is None:
        below = list(meshes)
    else:
        if not Sdf.Path.IsValidPathString(path):
            raise CageError(f'{name}: prim "{path}" is no path; expected one such as {_listed(meshes)}')
        wanted = Sdf.Path(path)
        below = [wanted] if wanted in meshes else [found for found in meshes if found.HasPrefix(wanted)]
    if not below:
        found = stage.GetPrimAtPath(path)
        what = f'is a prim of the type "{found.GetTypeName()}" without meshes' if found else "is not in the file"
        raise CageError(f"{name}: prim {path} {what}; expected one of {_listed(meshes)}")
    if len(below) > 1:
        place = f" below {path}" if path else ""
        raise CageError(f"{name}: there are {len(below)} meshes{place}; expected prim to name one of {_listed(below)}")
    return meshes[below[0]]


def _listed(paths: Any, shown: int = 20) -> str:
    names = [str(path) for path in paths]
    return ", ".join(names[:shown]) + (f" and {len(names) - shown} more" if len(names) > shown else "")


class _MeshReader:
    """Reads the attributes of one mesh."""

    def __init__(self, mesh: UsdGeom.Mesh, place: str, time: float | None) -> None:
        self.mesh = mesh
        self.place = place
        self.time = time

    def arguments(self, scheme: str | None) -> dict[str, Any]:
        mesh = self.mesh
        points = self.array(mesh.GetPointsAttr(), np.float64, required=True)
        sizes = self.array(mesh.GetFaceVertexCountsAttr(), np.int64, required=True)
        vertices = self.array(mesh.GetFaceVertexIndicesAttr(), np.int64, required=True)
        if (sizes < 0).any() or sizes.sum() != len(vertices):
            raise self.error(
                f"faceVertexCounts add up to {sizes.sum()}, but faceVertexIndices has {len(vertices)} entries",
                "as many",
            )
        matrix = self.local_to_world()
        mirrors = bool(np.linalg.det(matrix[:3, :3]) < 0)
        turned = None
        if mirrors != (self.token(mesh.GetOrientationAttr(), ("rightHanded", "leftHanded")) == "leftHanded"):
            turned = _turned_round(sizes)
            vertices = vertices[turned]
        if not np.array_equal(matrix, np.eye(4)):
            points = points @ matrix[:3, :3] + matrix[3, :3]
        return {
            "positions": points,
            "face_sizes": sizes,
            "face_vertices": vertices,
            "creases": self.creases(),
            "corners": self.corners(),
            "holes": self.array(mesh.GetHoleIndicesAttr(), np.int64),
            **{rule: self.rule(rule) for rule in RULE_ATTRIBUTES},
            **read_primvars(mesh, self.value, self.place, turned),
            "scheme": self.scheme(scheme),
            "source": CageSource(self.place),
        }

    def error(self, problem: str, expected: str) -> CageError:
        return CageError(f"{self.place}: {problem}; expected {expected}")

    def value(self, attribute: Usd.Attribute) -> Any:
        """Value at the time code; by default the one that does not depend on time, or else the first."""
        return attribute.Get(self.time_of(attribute))

    def time_of(self, attribute: Usd.Attribute) -> Usd.TimeCode:
        """Time code of an attribute's value."""
        from pxr import Usd

        if self.time is not None:
            return Usd.TimeCode(float(self.time))
        default = Usd.TimeCode.Default()
        return Usd.TimeCode.EarliestTime() if attribute.Get(default) is None else default

    def array(self, attribute: Usd.Attribute, kind: type, required: bool = False) -> NDArray:
        value = self.value(attribute)
        if required and (value is None or not len(value)):
            raise self.error(f"there are no {attribute.GetName()}", "a mesh with points and faces")
        return np.array([] if value is None else value, dtype=kind)

    def token(self, attribute: Usd.Attribute, known: Any) -> str:
        value = self.value(attribute)
        if value not in known:
            raise self.error(f'{attribute.GetName()} is "{value}"', f"one of {', '.join(known)}")
        return value

    def rule(self, rule: str) -> str:
        """A rule of the cage by the name it has here."""
        attribute = self.mesh.GetPrim().GetAttribute(RULE_ATTRIBUTES[rule])
        return rule_name(self.token(attribute, [token(name) for name in RULES[rule]]))

    def scheme(self, given: str | None) -> str:
        asked = self.token(self.mesh.GetSubdivisionSchemeAttr(), [*SCHEMES, "bilinear", "none"])
        if given is None:
            if asked not in SCHEMES:
                what = "is not to be subdivided" if asked == "none" else "is to be subdivided without smoothing"
                raise self.error(
                    f'the mesh {what}: its subdivisionScheme is "{asked}"',
                    f"{' or '.join(SCHEMES)}, or a scheme given in its place",
                )
            return SCHEMES[asked]
        if SCHEMES.get(asked) != given:
            warn(f'{self.place}: subdivisionScheme is "{asked}"; the scheme "{given}" is used in its place')
        return given

    def creases(self) -> list[tuple[int, int, float]]:
        mesh = self.mesh
        indices = self.array(mesh.GetCreaseIndicesAttr(), np.int64)
        lengths = self.array(mesh.GetCreaseLengthsAttr(), np.int64)
        sharpness = self.array(mesh.GetCreaseSharpnessesAttr(), np.float64)
        if (lengths < 2).any():
            first = int(np.argmax(lengths < 2))
            raise self.error(f"creaseLengths has the value {lengths[first]} at {first}", "2 or more vertices")
        if lengths.sum() != len(indices):
            raise self.error(
                f"creaseLengths add up to {lengths.sum()}, but creaseIndices has {len(indices)} entries", "as many"
            )
        edges = lengths - 1
        if len(sharpness) == len(lengths):
            sharpness = np.repeat(sharpness, edges)
        elif len(sharpness) != edges.sum():
            raise self.error(
                f"creaseSharpnesses has {len(sharpness)} entries",
                f"{len(lengths)}, one per crease, or {edges.sum()}, one per edge",
            )
        is_start = np.ones(len(indices), dtype=bool)
        is_start[np.cumsum(lengths) - 1] = False
        start = np.flatnonzero(is_start)
        return list(zip(indices[start].tolist(), indices[start + 1].tolist(), sharpness.tolist(), strict=True))

    def corners(self) -> list[tuple[int, float]]:
        indices = self.array(self.mesh.GetCornerIndicesAttr(), np.int64)
        sharpness = self.array(self.mesh.GetCornerSharpnessesAttr(), np.float64)
        if len(indices) != len(sharpness):
            raise self.error(
                f"cornerSharpnesses has {len(sharpness)} entries, but cornerIndices has {len(indices)}", "as many"
            )
        return list(zip(indices.tolist(), sharpness.tolist(), strict=True))

    def local_to_world(self) -> NDArray[np.float64]:
        """Matrix for row vectors."""
        from pxr import UsdGeom

        matrix, prim = np.eye(4), self.mesh.GetPrim()
        while not prim.IsPseudoRoot():
            here = UsdGeom.Xformable(prim)
            if here:
                # One by one, as each may have a value that does not depend on time, or another first time.
                for operation in reversed(here.GetOrderedXformOps()):
                    matrix = matrix @ np.array(operation.GetOpTransform(self.time_of(operation.GetAttr())))
                if here.GetResetXformStack():
                    break
            prim = prim.GetParent()
        # The determinant of a matrix that is not finite may be anything.
        if not np.isfinite(matrix).all() or np.linalg.det(matrix[:3, :3]) == 0:
            raise self.error(f"the transform to world space is {matrix.tolist()}", "an invertible matrix")
        return matrix


def _turned_round(sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Face corners in the order of faces that begin at the same vertex and go round the other way."""
    size = np.repeat(sizes, sizes)
    first = np.repeat(np.cumsum(sizes) - sizes, sizes)
    return first + (first - np.arange(len(first))) % np.maximum(size, 1)
