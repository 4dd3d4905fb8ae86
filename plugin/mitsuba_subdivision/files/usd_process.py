"""USD files read in a process of their own.

A damaged file can crash the USD library, and a small one can keep it busy for ever. A process of its own has a limit
of time and of memory, so that whatever a file does there is an error like any other. The process answers with arrays
and JSON, and nothing that it answers is executed.
"""

from __future__ import annotations

import io
import json
import math
import os
import signal
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..cage.attributes import Attribute
from ..cage.contents import CageContents
from ..cage.errors import CageError, CageWarning, warn
from ..cage.source import CageSource

# Seconds that reading a USD file may take. If it is not set, USD files are read in the calling process.
ENVIRONMENT_VARIABLE = "MITSUBA_SUBDIVISION_USD_PROCESS"
# Memory that the process may take besides its libraries: enough for a small scene, and for several copies of the
# arrays of a large one.
_LEAST_MEMORY = 2 << 30
_MEMORY_PER_BYTE = 64
_ARRAYS = ("positions", "face_sizes", "face_vertices", "creases", "corners", "holes")


def seconds_in_process() -> float | None:
    """Seconds that reading a USD file may take in a process of its own; None to read it in this process.

    Raises
    ------
    CageError
        If the environment variable is not a positive number.
    """
    text = os.environ.get(ENVIRONMENT_VARIABLE, "")
    if not text:
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise CageError(
            f'environment variable {ENVIRONMENT_VARIABLE} is "{text}"; expected a positive number, the seconds that '
            "reading a USD file may take"
        )
    return seconds


def read_in_process(
    path: str | Path, prim: str | None, time: float | None, rules: Mapping[str, str], seconds: float
) -> list[CageContents]:
    """Read meshes in a process of its own, with the parameters of `usd_reader.read_meshes` and a limit of time.

    Raises
    ------
    CageError
        As `usd_reader.read_meshes` does, and if the process crashes or takes longer than ``seconds``.
    """
    name = f'"{path}"'
    request = {"path": str(path), "prim": prim, "time": None if time is None else float(time), "rules": dict(rules)}
    # Python would look for modules in the working folder first, in which the file may lie.
    paths = f"import sys; sys.path[:] = {[str(Path(entry).absolute()) for entry in sys.path]!r}"
    try:
        done = subprocess.run(
            [sys.executable, "-c", f"{paths}; from {__name__} import answer; answer()"],
            input=json.dumps(request).encode(),
            stdout=subprocess.PIPE,
            timeout=seconds,
            env={**os.environ, ENVIRONMENT_VARIABLE: ""},
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise CageError(
            f"{name}: reading takes longer than {seconds:g} s, the limit that {ENVIRONMENT_VARIABLE} sets; expected a "
            "smaller file or a longer limit"
        ) from None
    if done.returncode:
        end = _end(done.returncode)
        raise CageError(f"{name}: the process that read the file {end}; expected a USD file (is it damaged?)")
    try:
        error, messages, meshes = _unpacked(done.stdout)
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        raise CageError(f"{name}: the process that read the file gave no answer; expected a USD file") from None
    for message in messages:
        warn(message)
    if error is not None:
        raise CageError(error)
    return meshes


def answer() -> None:
    """Read the file that standard input asks for, and write its contents to standard output; run in the process."""
    request = json.load(sys.stdin.buffer)
    output = os.fdopen(os.dup(1), "wb")
    # What libraries print goes to standard error: it is not part of the answer.
    os.dup2(2, 1)
    from .usd_reader import read_meshes

    path = request["path"]
    _limit_memory(Path(path).stat().st_size)
    error, meshes = None, []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CageWarning)
        try:
            meshes = read_meshes(path, request["prim"], request["time"], request["rules"])
        except CageError as found:
            error = str(found)
    messages = [str(each.message) for each in caught if issubclass(each.category, CageWarning)]
    with output:
        output.write(_packed(error, messages, meshes))
        output.flush()
        # At once, as the file may have damaged this process so that it would not end.
        os._exit(0)


def _packed(error: str | None, messages: list[str], meshes: list[CageContents]) -> memoryview:
    """An error, warnings and meshes as the bytes of an ``npz`` archive: arrays, and the rest as JSON."""
    arrays, texts = {}, []
    for number, mesh in enumerate(meshes):
        arrays.update({f"{name} {number}": getattr(mesh, name) for name in _ARRAYS})
        data: list[tuple[str | None, Attribute]] = [] if mesh.texcoords is None else [(None, mesh.texcoords)]
        data += mesh.attributes.items()
        for row, (_, attribute) in enumerate(data):
            arrays[f"values {number} {row}"] = attribute.values
            if attribute.indices is not None:
                arrays[f"indices {number} {row}"] = attribute.indices
        texts.append(
            {
                "rules": dict(mesh.rules),
                "scheme": mesh.scheme,
                # Texture coordinates have no name.
                "data": [(name, attribute.interpolation) for name, attribute in data],
                "source": mesh.source.name,
            }
        )
    text = json.dumps({"error": error, "warnings": messages, "meshes": texts})
    content = io.BytesIO()
    np.savez(content, text=np.frombuffer(text.encode(), np.uint8), **arrays)
    return content.getbuffer()


def _unpacked(content: bytes) -> tuple[str | None, list[str], list[CageContents]]:
    """Error, warnings and meshes of `_packed`."""
    meshes = []
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        text = json.loads(arrays["text"].tobytes())
        for number, mesh in enumerate(text["meshes"]):
            data = {}
            for row, (name, interpolation) in enumerate(mesh["data"]):
                indices = f"indices {number} {row}"
                data[name] = Attribute(arrays[f"values {number} {row}"], interpolation, arrays.get(indices))
            meshes.append(
                CageContents(
                    **{name: arrays[f"{name} {number}"] for name in _ARRAYS},
                    texcoords=data.pop(None, None),
                    attributes=data,
                    rules=mesh["rules"],
                    scheme=mesh["scheme"],
                    source=CageSource(mesh["source"]),
                )
            )
    return text["error"], text["warnings"], meshes


def _end(code: int) -> str:
    """How a process ended, by its exit code."""
    try:
        return f"crashed ({signal.Signals(-code).name})"
    except ValueError:
        return f"ended with the exit code {code}"


def _limit_memory(size: int) -> None:
    """Limit the memory of this process to what it has now and what reading a file of ``size`` bytes may take."""
    try:
        import resource
    except ImportError:  # On Windows, which has no such limit.
        return
    # The limit is for data: how much address space threads reserve depends on the machine.
    used = 0
    if Path("/proc/self/statm").exists():
        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    limit = used + _LEAST_MEMORY + _MEMORY_PER_BYTE * size
    resource.setrlimit(resource.RLIMIT_DATA, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
