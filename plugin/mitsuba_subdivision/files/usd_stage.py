"""Opening USD files, and choosing the meshes to read."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..cage.errors import CageError, shortened, warn
from .usd_values import FLAT_SCHEMES, HIDDEN_PURPOSES, SCHEMES, value_at

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

# Value of `prim` that selects every mesh in the file.
ALL = "*"
# Characters of a message of the USD library that are shown, and that are searched for a reason.
_MOST_SHOWN, _MOST_SEARCHED = 200, 10_000
_MATERIALX = re.compile(r"Could not open asset @([^@]*\.mtlx)[@:]", re.IGNORECASE)
# The function of the library that reports composition errors, which `open_stage` names.
_REPORTS_COMPOSITION = "_ReportErrors"
_OUT_OF_MEMORY = ("std::bad_alloc", "cannot create std::vector")


def require_usd(name: str) -> None:
    """Raise CageError if the package usd-core is missing; the message begins with the name of a file."""
    try:
        import pxr  # noqa: F401 - only to find out whether it is missing
    except ImportError:
        raise CageError(
            f'{name}: the package usd-core, which reads USD files, is missing; pip install "mitsuba-subdivision[files]"'
        ) from None


def open_stage(
    path: str | Path,
    name: str,  # Beginning of messages
    # Makes of the stage and its name one that has what USD itself cannot open
    completed: Callable[[Usd.Stage, str], Usd.Stage] | None = None,
) -> Usd.Stage:
    """Open the stage of a file, with everything that it refers to. Raises CageError if the file is malformed.

    Warns if the file refers to something that is not there.
    """
    from pxr import Tf, Usd

    try:
        stage = Usd.Stage.Open(str(path))
        if completed is not None:
            stage = completed(stage, name)
    except Tf.ErrorException as error:
        raise CageError(f"{_where_and_why(error, path, name)}; expected a USD file (is it damaged?)") from None
    _warn_of_missing(name, [str(error) for error in stage.GetCompositionErrors()])
    return stage


def _warn_of_missing(name: str, errors: list[str]) -> None:
    """Warn of assets that a stage refers to and that could not be opened, in one line for each kind."""
    documents = [found[1] for found in map(_MATERIALX.search, errors) if found]
    if documents:
        files = _listed(sorted({Path(each).name for each in documents}), 3)
        count = f"{len(documents)} references" if len(documents) > 1 else "a reference"
        warn(
            f"{name}: {count} to MaterialX documents left out, which usd-core cannot open ({files}); prims without "
            "another material have their display colours (the package materialx reads documents; pip install "
            '"mitsuba-subdivision[files]")'
        )
    others = [error for error in errors if not _MATERIALX.search(error)]
    if others:
        more = f" ({len(others)} such errors)" if len(others) > 1 else ""
        warn(f"{name}: the stage is incomplete: {_clear(others[0])}{more}")


def stage_up_axis(path: str | Path) -> str:
    """Axis that points up in a USD file: "y" or "z".

    Raises CageError if the package usd-core is missing, or the file is malformed.
    """
    name = f'"{path}"'
    require_usd(name)
    from pxr import UsdGeom

    with usd_errors_at(name), usd_messages_of(name):
        return str(UsdGeom.GetStageUpAxis(open_stage(path, name))).lower()


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
    """Keep the USD library from printing in a ``with`` block; at its end, warn in one line of what it reported.

    Messages begin with the name. Composition errors are left out, as `open_stage` names them.
    """
    from pxr import UsdUtils

    # While it exists, it takes the messages of all threads.
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
        found = delegate.TakeUncoalescedDiagnostics()
    finally:
        del delegate
    texts = {_clear(each.commentary): None for each in found if not each.sourceFunction.endswith(_REPORTS_COMPOSITION)}
    if texts:
        more = f" (and {len(texts) - 1} other messages)" if len(texts) > 1 else ""
        warn(f"{name}: the USD library reports: {next(iter(texts))}{more}")


def chosen_meshes(
    stage: Usd.Stage,
    # Path of the mesh, or of a prim with one mesh below it; "*" for all meshes; None for the only mesh of the stage
    path: str | None,
    name: str,  # Of the file in messages
    time: Usd.TimeCode,  # At which visibility and schemes are read
    scheme: str | None,  # Replaces the meshes' own
) -> list[UsdGeom.Mesh]:
    """The mesh to read, or all meshes.

    Meshes that are not to be smoothed are skipped if there are others. If all meshes are requested, so are meshes that
    renderers do not show. Warns if meshes are skipped.

    Raises CageError if there is no such mesh, or more than one and not all are requested.
    """
    from pxr import Sdf, Usd, UsdGeom

    prims = stage.Traverse(Usd.TraverseInstanceProxies())
    meshes = {prim.GetPath(): UsdGeom.Mesh(prim) for prim in prims if prim.IsA(UsdGeom.Mesh)}
    if not meshes:
        raise CageError(f"{name}: there are no meshes; expected a prim of the type Mesh")
    if path is None or path == ALL:
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
    if path == ALL:
        hidden = {each for each in below if not _is_shown(meshes[each], time)}
        below = _without(below, hidden, "as they are invisible, guides or proxies; expected meshes to be seen", name)
    if scheme is None:
        flat = {each for each in below if str(value_at(meshes[each].GetSubdivisionSchemeAttr(), time)) in FLAT_SCHEMES}
        given, expected = " or ".join(FLAT_SCHEMES), " or ".join(SCHEMES)
        why = f"as their subdivisionScheme is {given}; expected {expected}, or a scheme given"
        below = _without(below, flat, why, name)
    if len(below) > 1 and path != ALL:
        where = f" below {path}" if path else ""
        raise CageError(
            f'{name}: there are {len(below)} meshes{where}; expected prim to name one of {_listed(below)}, or "{ALL}" '
            "for all"
        )
    return [meshes[each] for each in below]


def _is_shown(mesh: UsdGeom.Mesh, time: Usd.TimeCode) -> bool:
    return mesh.ComputeVisibility(time) != "invisible" and mesh.ComputePurpose() not in HIDDEN_PURPOSES


def _without(paths: list[Any], skipped: set[Any], why: str, name: str) -> list[Any]:
    """The paths of meshes that are not skipped, with a warning about the others; all paths if all would be skipped."""
    if not skipped or len(skipped) == len(paths):
        return paths
    warn(f"{name}: meshes {_listed(path for path in paths if path in skipped)} left out, {why}")
    return [path for path in paths if path not in skipped]


def _listed(paths: Iterable[Any], shown: int = 20) -> str:
    names = [str(path) for path in paths]
    listed = shortened(", ".join(names[:shown]), _MOST_SHOWN)
    return listed + (f" and {len(names) - shown} more" if len(names) > shown else "")


def _where_and_why(error: Exception, path: str | Path, name: str) -> str:
    """Beginning of a message: where in a file, and why, the USD library failed."""
    reason = _commentary(error)
    where = re.match(re.escape(str(Path(path).absolute())) + r":(\d+):\d+: ", reason)
    if not where:
        return f"{name}: {_clear(reason)}"
    # The parser names the rules of its grammar, which are in C++.
    what = re.sub("parse error matching .* at ", "syntax error at ", reason[where.end() :], flags=re.DOTALL)
    return f"{name}, line {where[1]}: {_clear(what)}"


def _commentary(error: Exception) -> str:
    """Text of the first error of the library, which is the most telling one."""
    try:
        return error.args[0].commentary.strip()[:_MOST_SEARCHED]
    except UnicodeError:
        return "there are bytes that are not UTF-8"


def _clear(reason: str) -> str:
    """A short reason, without terms of C++ and without the path, which the message names already."""
    if any(words in reason for words in _OUT_OF_MEMORY):
        return "a number in the file asks for more memory than there is"
    what = re.sub(", while reading @[^@]*@$", "", reason.removeprefix("Encountered: "))
    return shortened(" ".join(what.split()), _MOST_SHOWN)
