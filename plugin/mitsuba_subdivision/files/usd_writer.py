"""Writer of USD meshes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage.attributes import Attribute
from ..cage.errors import CageError
from ..whole_file import whole_file
from .left_out import warn_of_left_out
from .usd_names import INTERPOLATIONS, RULE_ATTRIBUTES, SCHEMES, token

if TYPE_CHECKING:
    from pxr import UsdGeom

    from ..cage.control_cage import ControlCage


def write_usd(cage: ControlCage, path: str | Path) -> None:
    """Write ``cage`` to a USD file, in single precision as USD has it, with all subdivision attributes and primvars.

    A cage that names no scheme becomes a Catmull-Clark mesh.

    Raises
    ------
    CageError
        If the package usd-core is missing.
    OSError
        If the file cannot be written.

    Warns
    -----
    CageWarning
        If the cage has more than USD files can hold: Chaikin's rule, a scheme other than Catmull-Clark and Loop,
        attributes whose names are no names of primvars.
    """
    with _new_mesh(path, "cage", cage.positions, cage.face_sizes, cage.face_vertices) as mesh:
        attributes = {name: cage.attributes[name] for name in cage.attributes if _is_possible(name)}
        warn_of_left_out(
            path,
            {
                'crease_method "chaikin"': cage.crease_method == "chaikin",
                f'scheme "{cage.scheme}"': cage.scheme not in (None, *SCHEMES.values()),
                **{f'attribute "{name}"': name not in attributes for name in cage.attributes},
            },
        )
        scheme = next((name for name, scheme in SCHEMES.items() if scheme == cage.scheme), "catmullClark")
        mesh.CreateSubdivisionSchemeAttr(scheme)
        for rule, attribute in RULE_ATTRIBUTES.items():
            mesh.GetPrim().GetAttribute(attribute).Set(token(getattr(cage, rule)))
        creases, corners = cage.tags.creases(cage.topology), cage.tags.corners()
        if len(creases):
            mesh.CreateCreaseIndicesAttr(_integers(creases[:, :2]))
            mesh.CreateCreaseLengthsAttr(_integers(np.full(len(creases), 2)))
            mesh.CreateCreaseSharpnessesAttr(_floats(creases[:, 2]))
        if len(corners):
            mesh.CreateCornerIndicesAttr(_integers(corners[:, 0]))
            mesh.CreateCornerSharpnessesAttr(_floats(corners[:, 1]))
        if len(cage.holes):
            mesh.CreateHoleIndicesAttr(_integers(cage.holes))
        _set_primvars(mesh, cage.texcoords, attributes)


def write_usd_polygons(
    path: str | Path,
    positions: NDArray,
    normals: NDArray,
    triangles: NDArray,
    texcoords: Attribute | None,
    attributes: dict[str, Attribute],
) -> None:
    """Write triangles that are not to be subdivided to a USD file.

    Parameters
    ----------
    path : str or Path
    positions, normals : (n, 3)
    triangles : (m, 3) int
        0-based.
    texcoords : Attribute, optional
    attributes : dict of str to Attribute

    Raises
    ------
    CageError
        If the package usd-core is missing.
    OSError
        If the file cannot be written.
    """
    with _new_mesh(path, "surface", positions, np.full(len(triangles), 3), triangles) as mesh:
        from pxr import UsdGeom

        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateNormalsAttr(_floats(normals))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        warn_of_left_out(path, {f'attribute "{name}"': not _is_possible(name) for name in attributes})
        _set_primvars(mesh, texcoords, {name: attributes[name] for name in attributes if _is_possible(name)})


@contextmanager
def _new_mesh(
    path: str | Path, name: str, points: NDArray, sizes: NDArray, vertices: NDArray
) -> Iterator[UsdGeom.Mesh]:
    """The only mesh of a file that is written at the end, whole or not at all."""
    try:
        from pxr import Tf, Usd, UsdGeom
    except ImportError:
        raise CageError(
            f'"{path}": the package usd-core, which writes USD files, is missing; '
            'pip install "mitsuba-subdivision[usd]"'
        ) from None
    with whole_file(Path(path)) as beside:
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
            reason = "; ".join(found.commentary.strip() for found in error.args)
            raise OSError(f'"{path}": {reason}') from None


def _set_primvars(mesh: UsdGeom.Mesh, texcoords: Attribute | None, attributes: dict[str, Attribute]) -> None:
    from pxr import Sdf, UsdGeom

    types = Sdf.ValueTypeNames
    by_width = {1: types.FloatArray, 2: types.Float2Array, 3: types.Float3Array, 4: types.Float4Array}
    usd_interpolation = {ours: name for name, ours in INTERPOLATIONS.items()}
    api = UsdGeom.PrimvarsAPI(mesh)
    for name, attribute in {**attributes, **({"st": texcoords} if texcoords else {})}.items():
        width = attribute.values.shape[1]
        kind = by_width.get(width, types.FloatArray)
        if attribute is texcoords:
            kind = types.TexCoord2fArray
        elif name == "displayColor" and width == 3:
            kind = types.Color3fArray
        primvar = api.CreatePrimvar(name, kind, usd_interpolation[attribute.interpolation])
        primvar.Set(_floats(attribute.values))
        if width not in by_width:
            primvar.SetElementSize(width)
        if attribute.indices is not None:
            primvar.SetIndices(_integers(attribute.indices))


def _is_possible(name: str) -> bool:
    from pxr import Sdf

    return Sdf.Path.IsValidNamespacedIdentifier(name)


def _floats(values: NDArray) -> object:
    """Array of USD in single precision, of vectors where there are two to four columns."""
    from pxr import Vt

    values = np.ascontiguousarray(values, dtype=np.float32)
    width = values.shape[1] if values.ndim == 2 else 1
    kind = {2: Vt.Vec2fArray, 3: Vt.Vec3fArray, 4: Vt.Vec4fArray}.get(width, Vt.FloatArray)
    return kind.FromNumpy(values if kind is not Vt.FloatArray else values.ravel())


def _integers(values: NDArray) -> object:
    from pxr import Vt

    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, dtype=np.int32).ravel())
