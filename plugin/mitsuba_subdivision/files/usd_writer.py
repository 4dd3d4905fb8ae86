"""Writers of USD files: control cages, and triangles."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import RULES, Attribute, CageContents
from ..whole_file import whole_file
from .formats import Triangles, warn_of_losses
from .usd_stage import RULE_ATTRIBUTES, SCHEMES, TEXCOORDS, is_possible, require_usd, token

if TYPE_CHECKING:
    from pxr import UsdGeom


def write_usd(contents: CageContents, path: str | Path) -> None:
    """Write a cage to a USD file in single precision, with its primvars; without a scheme, as Catmull-Clark mesh."""
    with _new_mesh(path, "cage", contents.positions, contents.face_sizes, contents.face_vertices) as mesh:
        attributes = {name: values for name, values in contents.attributes.items() if is_possible(name)}
        warn_of_losses(
            path,
            {
                'crease_method "chaikin"': contents.rules.get("crease_method") == "chaikin",
                f'scheme "{contents.scheme}"': contents.scheme not in (None, *SCHEMES.values()),
                **{f'attribute "{name}"': name not in attributes for name in contents.attributes},
                "materials": bool(contents.materials),
            },
        )
        scheme = next((name for name, scheme in SCHEMES.items() if scheme == contents.scheme), "catmullClark")
        mesh.CreateSubdivisionSchemeAttr(scheme)
        for rule, attribute in RULE_ATTRIBUTES.items():
            mesh.GetPrim().GetAttribute(attribute).Set(token(contents.rules.get(rule, RULES[rule][0])))
        creases, corners = contents.creases, contents.corners
        if len(creases):
            mesh.CreateCreaseIndicesAttr(_integers(creases[:, :2]))
            mesh.CreateCreaseLengthsAttr(_integers(np.full(len(creases), 2)))
            mesh.CreateCreaseSharpnessesAttr(_floats(creases[:, 2]))
        if len(corners):
            mesh.CreateCornerIndicesAttr(_integers(corners[:, 0]))
            mesh.CreateCornerSharpnessesAttr(_floats(corners[:, 1]))
        if len(contents.holes):
            mesh.CreateHoleIndicesAttr(_integers(contents.holes))
        _set_primvars(mesh, contents.texcoords, attributes)


def write_usd_triangles(path: str | Path, surface: Triangles) -> None:
    """Write triangles to a USD file in single precision, as a mesh without subdivision."""
    positions, normals, triangles, texcoords, attributes = surface
    with _new_mesh(path, "surface", positions, np.full(len(triangles), 3), triangles) as mesh:
        mesh.CreateSubdivisionSchemeAttr("none")
        mesh.CreateNormalsAttr(_floats(normals))
        mesh.SetNormalsInterpolation("vertex")
        possible = {name: Attribute(values) for name, values in attributes.items() if is_possible(name)}
        warn_of_losses(path, {f'attribute "{name}"': name not in possible for name in attributes})
        _set_primvars(mesh, None if texcoords is None else Attribute(texcoords), possible)


@contextmanager
def _new_mesh(
    path: str | Path, name: str, points: NDArray, sizes: NDArray, vertices: NDArray
) -> Iterator[UsdGeom.Mesh]:
    """The only mesh of a new file, which is written completely when the ``with`` block ends."""
    require_usd(f'"{path}"', "writes")
    from pxr import Tf, Usd, UsdGeom

    with whole_file(path) as beside:
        try:
            stage = Usd.Stage.CreateNew(str(beside))
            mesh = UsdGeom.Mesh.Define(stage, f"/{name}")
            stage.SetDefaultPrim(mesh.GetPrim())
            mesh.CreatePointsAttr(_floats(points))
            mesh.CreateFaceVertexCountsAttr(_integers(sizes))
            mesh.CreateFaceVertexIndicesAttr(_integers(vertices))
            mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
            yield mesh
            stage.Save()
        except Tf.ErrorException as error:
            reason = "; ".join(part.commentary.strip() for part in error.args)
            raise OSError(f'"{path}": {reason}') from None


def _set_primvars(mesh: UsdGeom.Mesh, texcoords: Attribute | None, attributes: dict[str, Attribute]) -> None:
    from pxr import Sdf, UsdGeom, Vt

    types = Sdf.ValueTypeNames
    by_width = {1: types.FloatArray, 2: types.Float2Array, 3: types.Float3Array, 4: types.Float4Array}
    api = UsdGeom.PrimvarsAPI(mesh)
    for name, attribute in {**attributes, **({TEXCOORDS[0]: texcoords} if texcoords else {})}.items():
        width = attribute.values.shape[1]
        kind = by_width.get(width, types.FloatArray)
        if attribute is texcoords:
            kind = types.TexCoord2fArray
        elif name == "displayColor" and width == 3:
            kind = types.Color3fArray
        primvar = api.CreatePrimvar(name, kind, token(attribute.interpolation))
        primvar.Set(_floats(attribute.values))
        if width not in by_width:
            primvar.SetElementSize(width)
        if attribute.indices is not None:
            primvar.SetIndices(Vt.IntArray.FromNumpy(_integers(attribute.indices)))


def _floats(values: NDArray) -> NDArray[np.float32]:
    """Values in single precision; flat if USD has no vectors of this size."""
    values = np.ascontiguousarray(values, dtype=np.float32)
    return values if values.ndim == 2 and values.shape[1] in (2, 3, 4) else values.ravel()


def _integers(values: NDArray) -> NDArray[np.int32]:
    return np.ascontiguousarray(values, dtype=np.int32).ravel()
