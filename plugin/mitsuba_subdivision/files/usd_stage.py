"""USD stages: opening files, values and transforms at a time, and selection of meshes.

Without a time (the time code `EarliestTime`), a value is the default, or else the first sample. USD itself prefers the
sample, and at the default time the schema's fallback to the sample.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..cage.contents import Interpolation
from ..cage.errors import CageError, shortened, warn

if TYPE_CHECKING:
    from pxr import Gf, Sdf, Usd, UsdGeom

# Attributes of a mesh for rules of a cage. Chaikin's rule has none.
RULE_ATTRIBUTES = {
    "boundary": "interpolateBoundary",
    "triangle_rule": "triangleSubdivisionRule",
    "face_varying": "faceVaryingLinearInterpolation",
}
# Values of subdivisionScheme for smooth and for flat surfaces.
SCHEMES = {"catmullClark": "catmull_clark", "loop": "loop"}
FLAT_SCHEMES = ("none", "bilinear")
INTERPOLATIONS: dict[str, Interpolation] = {"vertex": "vertex", "varying": "varying", "faceVarying": "face_varying"}
TEXCOORDS = ("st", "UVMap", "texcoords")  # Names of primvars for texture coordinates; the first is written
HIDDEN_PURPOSES = ("guide", "proxy")  # Values of purpose that renderers do not show
ALL = "*"  # Value of `prim` that selects every mesh in the file
_MOST_SHOWN, _MOST_SEARCHED = 200, 10_000  # Characters of USD's messages to show, and to search for a reason
_MATERIALX = re.compile(r"Could not open asset @([^@]*\.mtlx)[@:]", re.IGNORECASE)


def require_usd(name: str, use: str = "reads") -> None:
    """Raise CageError if the package usd-core is missing; the message begins with the name of a file."""
    try:
        import pxr  # noqa: F401 - only to find out whether it is missing
    except ImportError:
        what = f"the package usd-core, which {use} USD files, is missing"
        raise CageError(f'{name}: {what}; pip install "mitsuba-subdivision[files]"') from None


def open_stage(
    path: str | Path,
    # Returns a stage with layers that USD itself cannot open, from the stage and the beginning of messages
    completed: Callable[[Usd.Stage, str], Usd.Stage] | None = None,
    over: str | Path | None = None,  # A layer that is stronger than the file
) -> Usd.Stage:
    """Open the stage of a file, with its references. Warns of missing ones."""
    name = f'"{path}"'
    layer = _opened_layer(path)
    stronger = None if over is None else _opened_layer(over)
    from pxr import Usd

    with usd_errors_at(name), usd_messages_of(name):
        stage = Usd.Stage.Open(layer if stronger is None else _sublayered(stronger, layer))
        if completed is not None:
            stage = completed(stage, name)
        _warn_of_missing(name, [str(error) for error in stage.GetCompositionErrors()])
        if stronger is not None:
            _warn_of_no_effect(f'"{over}"', stronger, stage)
        return stage


def _opened_layer(path: str | Path) -> Sdf.Layer:
    with open(path, "rb"):
        pass  # A missing file is an OSError, as for other formats.
    name = f'"{path}"'
    require_usd(name)
    from pxr import Sdf, Tf

    with usd_errors_at(name), usd_messages_of(name):
        try:
            return Sdf.Layer.FindOrOpen(str(path))
        except Tf.ErrorException as error:
            reason = _commentary(error)
            if where := re.match(re.escape(os.path.abspath(path)) + r":(\d+):\d+: ", reason):
                # The parser names rules of its grammar, terms of C++.
                what = re.sub("parse error matching .* at ", "syntax error at ", reason[where.end() :], flags=re.DOTALL)
                name, reason = f"{name}, line {where[1]}", what
            raise CageError(f"{name}: {_clear(reason)}; expected a USD file (is it damaged?)") from None


def _sublayered(stronger: Sdf.Layer, weaker: Sdf.Layer) -> Sdf.Layer:
    """A root layer with two sublayers and their stage metadata, such as the up axis."""
    from pxr import Sdf

    root = Sdf.Layer.CreateAnonymous(".usda")
    for layer in (weaker, stronger):
        for key in layer.pseudoRoot.ListInfoKeys():
            if key not in ("subLayers", "subLayerOffsets"):
                root.pseudoRoot.SetInfo(key, layer.pseudoRoot.GetInfo(key))
    root.subLayerPaths = [stronger.identifier, weaker.identifier]
    return root


def _warn_of_no_effect(name: str, layer: Sdf.Layer, stage: Usd.Stage) -> None:
    """Warn of opinions about prims that do not exist, and about parts of instances, where USD ignores them."""
    missing: list[str] = []
    in_instances: list[str] = []

    def visit(path: Sdf.Path) -> None:
        if not path.IsPrimPath() or path.ContainsPrimVariantSelection():
            return
        prim = stage.GetPrimAtPath(path)
        if not prim or not (prim.IsDefined() or len(prim.GetPrimStack()) > 1):
            missing.append(str(path))
        elif prim.IsInstanceProxy():
            in_instances.append(str(path))

    layer.Traverse(layer.pseudoRoot.path, visit)
    if missing:
        warn(f"{name}: there are no prims {listed(sorted(missing), 3)} to change")
    if in_instances:
        parts = listed(sorted(in_instances), 3)
        warn(f"{name}: {parts} are parts of instances, which USD shares; expected instanceable = false above them")


def _warn_of_missing(name: str, errors: list[str]) -> None:
    if documents := [match[1] for match in map(_MATERIALX.search, errors) if match]:
        files = listed(sorted({os.path.basename(document) for document in documents}), 3)
        count = f"{len(documents)} references" if len(documents) > 1 else "a reference"
        hint = 'the package materialx reads documents; pip install "mitsuba-subdivision[files]"'
        left_out = f"{count} to MaterialX documents left out, which usd-core cannot open ({files})"
        warn(f"{name}: {left_out}; prims without another material have their display colours ({hint})")
    if others := [error for error in errors if not _MATERIALX.search(error)]:
        more = f" ({len(others)} such errors)" if len(others) > 1 else ""
        warn(f"{name}: the stage is incomplete: {_clear(others[0])}{more}")


def stage_up_axis(path: str | Path) -> str:
    """Up axis of a USD file, "y" or "z"; errors are those of `open_stage`."""
    stage = open_stage(path)
    from pxr import UsdGeom

    return str(UsdGeom.GetStageUpAxis(stage)).lower()


@contextmanager
def usd_errors_at(where: str) -> Iterator[None]:
    """Turn errors of the USD library in a ``with`` block into a `CageError` that begins with ``where``."""
    from pxr import Tf

    try:
        yield
    except UnicodeError:
        raise CageError(f"{where}: there are names or words that are not UTF-8; expected UTF-8") from None
    except Tf.ErrorException as error:
        raise CageError(f"{where}: {_clear(_commentary(error))}; expected a USD file") from None
    except MemoryError:
        raise CageError(f"{where}: the file asks for more memory than there is; expected a USD file") from None


@contextmanager
def usd_messages_of(name: str) -> Iterator[None]:
    """Turn messages of the USD library in a ``with`` block into one warning that begins with a name.

    Composition errors are omitted, as `open_stage` reports them.
    """
    from pxr import UsdUtils

    delegate = UsdUtils.CoalescingDiagnosticDelegate()  # Takes the messages of all threads while it exists
    try:
        yield
        reports = delegate.TakeUncoalescedDiagnostics()
    finally:
        del delegate
    # The function of the library that reports composition errors.
    others = [report for report in reports if not report.sourceFunction.endswith("_ReportErrors")]
    if texts := [_clear(report.commentary) for report in others]:
        count = len(set(texts)) - 1
        more = f" (and {count} other messages)" if count else ""
        warn(f"{name}: the USD library reports: {texts[0]}{more}")


def _commentary(error: Exception) -> str:
    """Text of the library's first error, the most informative one."""
    try:
        return error.args[0].commentary.strip()[:_MOST_SEARCHED]
    except UnicodeError:
        return "there are bytes that are not UTF-8"


def _clear(reason: str) -> str:
    """A short reason, without terms of C++ and without the path, which is in the message."""
    if "std::bad_alloc" in reason or "cannot create std::vector" in reason:
        return "a number in the file asks for more memory than there is"
    what = re.sub(", while reading @[^@]*@$", "", reason.removeprefix("Encountered: "))
    return shortened(" ".join(what.split()), _MOST_SHOWN)


def time_of(attribute: Usd.Attribute, time: Usd.TimeCode) -> Usd.TimeCode:
    """Time code at which an attribute is read."""
    from pxr import Usd

    if not time.IsEarliestTime():
        return time
    default = Usd.TimeCode.Default()
    if not attribute.HasAuthoredValue():
        return default
    return default if attribute.GetResolveInfo(default).GetSource() == Usd.ResolveInfoSourceDefault else time


def value_at(attribute: Usd.Attribute, time: Usd.TimeCode) -> Any:
    """Value of an attribute; None if there is no such attribute."""
    return attribute.Get(time_of(attribute, time)) if attribute else None


def require_types(prim: Usd.Prim, time: Usd.TimeCode) -> None:
    """Raise ValueError unless a prim's attributes have the types of its schema; USD reads others as missing."""
    for attribute in prim.GetAuthoredAttributes():
        value, declared = value_at(attribute, time), attribute.GetTypeName().defaultValue
        are_numbers = isinstance(value, (int, float)) and isinstance(declared, (int, float))
        if value is not None and declared is not None and not are_numbers and not isinstance(value, type(declared)):
            kind, expected = type(value).__name__, type(declared).__name__
            raise ValueError(f"{attribute.GetName()} is of the type {kind}; expected {expected}")


def local_to_world(
    prim: Usd.Prim, time_of: Callable[[Usd.Attribute], Usd.TimeCode], known: dict[str, Gf.Matrix4d] | None = None
) -> Gf.Matrix4d:
    """Transform of a prim to world space, for row vectors, with operations at their own times.

    Adds the transforms of the prim and its ancestors to the known ones, by path.
    """
    from pxr import Gf, UsdGeom

    path, known = str(prim.GetPath()), {} if known is None else known
    if path not in known:
        matrix, resets = Gf.Matrix4d(1), prim.IsPseudoRoot()
        if here := UsdGeom.Xformable(prim):
            # Not by times of samples: with timeCodesPerSecond = 0, USD never finishes its search for them.
            for operation in reversed(here.GetOrderedXformOps()):
                matrix *= operation.GetOpTransform(time_of(operation.GetAttr()))
            resets = here.GetResetXformStack()
        known[path] = matrix if resets else matrix * local_to_world(prim.GetParent(), time_of, known)
    return known[path]


def token(name: str) -> str:
    """USD's name of a rule: ``edgeAndCorner`` for ``edge_and_corner``."""
    return re.sub("_(.)", lambda match: match[1].upper(), name)


def is_possible(name: str) -> bool:
    """Whether a primvar can have this name."""
    from pxr import Sdf

    return Sdf.Path.IsValidNamespacedIdentifier(name)


def chosen_meshes(
    stage: Usd.Stage,
    # Path of the mesh, or of a prim with one mesh below it; "*" for all meshes; None for the only mesh of the stage
    path: str | None,
    name: str,
    time: Usd.TimeCode,
    scheme: str | None,  # Replaces the meshes' own
) -> list[UsdGeom.Mesh]:
    """The selected mesh, or all meshes; flat and hidden ones are skipped with a warning if there are others."""
    from pxr import Sdf, Usd, UsdGeom

    prims = stage.Traverse(Usd.TraverseInstanceProxies())
    meshes = {prim.GetPath(): UsdGeom.Mesh(prim) for prim in prims if prim.IsA(UsdGeom.Mesh)}
    if not meshes:
        raise CageError(f"{name}: there are no meshes; expected a prim of the type Mesh")
    below = list(meshes)
    if path not in (None, ALL):
        if not Sdf.Path.IsValidPathString(path):
            raise CageError(f'{name}: prim "{path}" is no path; expected one such as {listed(meshes)}')
        wanted = Sdf.Path(path)
        below = [wanted] if wanted in meshes else [mesh for mesh in meshes if mesh.HasPrefix(wanted)]
    if not below:
        prim = stage.GetPrimAtPath(path)
        what = f'is a prim of the type "{prim.GetTypeName()}" without meshes' if prim else "is not in the file"
        raise CageError(f"{name}: prim {path} {what}; expected one of {listed(meshes)}")

    def without(paths: list[Sdf.Path], is_skipped: Callable[[UsdGeom.Mesh], bool], why: str) -> list[Sdf.Path]:
        """The meshes that are not skipped, with a warning about the others; all meshes if none would remain."""
        kept = [mesh for mesh in paths if not is_skipped(meshes[mesh])]
        if kept and len(kept) < len(paths):
            warn(f"{name}: meshes {listed(mesh for mesh in paths if mesh not in kept)} left out, as {why}")
        return kept or paths

    if path == ALL:

        def is_hidden(mesh: UsdGeom.Mesh) -> bool:
            return mesh.ComputeVisibility(time) == "invisible" or mesh.ComputePurpose() in HIDDEN_PURPOSES

        below = without(below, is_hidden, "they are invisible, guides or proxies; expected meshes to be seen")
    if scheme is None:
        flat, smooth = " or ".join(FLAT_SCHEMES), " or ".join(SCHEMES)
        why = f"their subdivisionScheme is {flat}; expected {smooth}, or a scheme given"
        below = without(below, lambda mesh: str(value_at(mesh.GetSubdivisionSchemeAttr(), time)) in FLAT_SCHEMES, why)
    if len(below) > 1 and path != ALL:
        where = f" below {path}" if path else ""
        expected = f'expected prim to name one of {listed(below)}, or "{ALL}" for all'
        raise CageError(f"{name}: there are {len(below)} meshes{where}; {expected}")
    return [meshes[mesh] for mesh in below]


def listed(paths: Iterable[Any], shown: int = 20) -> str:
    """The first names, shortened, and the number of the others."""
    names = [str(path) for path in paths]
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return shortened(", ".join(names[:shown]), _MOST_SHOWN) + more
