"""USD files read in a process of their own.

Damaged files can crash the USD library, and small ones can keep it busy for ever. Such a process ends after some
seconds and has a limit of memory, so that whatever the file does to it is an error like any other. It hands back
arrays and text, of which nothing is run.
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
from typing import Any

import numpy as np

from ..cage.attributes import Attribute
from ..cage.errors import CageError, CageWarning, warn
from ..cage.source import CageSource

# Seconds after which reading ends; if it is not set, USD files are read in the process that asks for them.
ENVIRONMENT_VARIABLE = "MITSUBA_SUBDIVISION_USD_PROCESS"
# What the process may take besides the libraries: a small scene, and arrays of a large one several times.
_LEAST_MEMORY = 2 << 30
_MEMORY_PER_BYTE = 64
_ARRAYS = ("positions", "face_sizes", "face_vertices", "creases", "corners", "holes")


def seconds_in_process() -> float | None:
    """Seconds that a USD file may take in a process of its own; None if it is to be read here.

    Raises
    ------
    CageError
        If the environment variable is no positive number.
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
) -> list[dict[str, Any]]:
    """As `usd_reader.read_meshes`, in a process of its own.

    Raises
    ------
    CageError
        Also if the process crashes, or takes longer than so many seconds.
    """
    name = f'"{path}"'
    request = {"path": str(path), "prim": prim, "time": None if time is None else float(time), "rules": dict(rules)}
    # Before anything is imported, as the working folder, where the file may lie, comes first otherwise.
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
            "file that refers to less"
        ) from None
    if done.returncode:
        end = _end(done.returncode)
        raise CageError(f"{name}: the process that read the file {end}; expected a USD file (is it damaged?)")
    try:
        told, meshes = _unpacked(done.stdout)
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        raise CageError(f"{name}: the process that read the file gave no answer; expected a USD file") from None
    for message in told["warnings"]:
        warn(message)
    if told["error"] is not None:
        raise CageError(told["error"])
    return meshes


def answer() -> None:
    """Read the file that standard input asks for, and write what it has to standard output."""
    request = json.load(sys.stdin.buffer)
    output = os.fdopen(os.dup(1), "wb")
    # What libraries print is no part of the answer.
    os.dup2(2, 1)
    from .usd_reader import read_meshes

    path = request["path"]
    _limit_memory(Path(path).stat().st_size)
    error, meshes = None, []
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", CageWarning)
        try:
            meshes = read_meshes(path, request["prim"], request["time"], request["rules"])
        except CageError as found:
            error = str(found)
    messages = [str(each.message) for each in told if issubclass(each.category, CageWarning)]
    with output:
        output.write(_packed(error, messages, meshes))
        output.flush()
        # Whatever a file did to this process, it ends here.
        os._exit(0)


def _packed(error: str | None, messages: list[str], meshes: list[dict[str, Any]]) -> memoryview:
    arrays, texts = {}, []
    for number, mesh in enumerate(meshes):
        arrays.update({f"{name} {number}": mesh[name] for name in _ARRAYS})
        data = [(None, mesh["texcoords"])] if mesh["texcoords"] else []
        data += mesh["attributes"].items()
        for row, (_, attribute) in enumerate(data):
            arrays[f"values {number} {row}"] = attribute.values
            if attribute.indices is not None:
                arrays[f"indices {number} {row}"] = attribute.indices
        texts.append(
            {
                "rules": {name: value for name, value in mesh.items() if isinstance(value, str)},
                "data": [(name, attribute.interpolation) for name, attribute in data],
                "source": mesh["source"].name,
            }
        )
    told = json.dumps({"error": error, "warnings": messages, "meshes": texts})
    content = io.BytesIO()
    np.savez(content, told=np.frombuffer(told.encode(), np.uint8), **arrays)
    return content.getbuffer()


def _unpacked(content: bytes) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    meshes = []
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        told = json.loads(arrays["told"].tobytes())
        for number, text in enumerate(told["meshes"]):
            data = {}
            for row, (name, interpolation) in enumerate(text["data"]):
                indices = f"indices {number} {row}"
                data[name] = Attribute(arrays[f"values {number} {row}"], interpolation, arrays.get(indices))
            meshes.append(
                {
                    **{name: arrays[f"{name} {number}"] for name in _ARRAYS},
                    **text["rules"],
                    "texcoords": data.pop(None, None),
                    "attributes": data,
                    "source": CageSource(text["source"]),
                }
            )
    return told, meshes


def _end(code: int) -> str:
    """How a process ended."""
    try:
        return f"crashed ({signal.Signals(-code).name})"
    except ValueError:
        return f"ended with the exit code {code}"


def _limit_memory(size: int) -> None:
    """Let this process have what it has and what reading a file of so many bytes takes, where the system can."""
    try:
        import resource
    except ImportError:  # On Windows.
        return
    # Of data, as the address space that threads reserve depends on the machine.
    used = 0
    if Path("/proc/self/statm").exists():
        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    limit = used + _LEAST_MEMORY + _MEMORY_PER_BYTE * size
    resource.setrlimit(resource.RLIMIT_DATA, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
