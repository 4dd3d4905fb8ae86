"""USD files read in a process of their own.

A damaged file can crash the USD library, and a small one can keep it busy without end. A process of its own has a limit
of time and of memory, so that whatever a file does there is an error like any other. The process answers with arrays
and JSON, and nothing that it answers is executed.
"""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
import math
import os
import signal
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
_CAGE_TYPES = (CageContents, Attribute, CageSource)


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


def call_in_process(
    function: Callable[..., Any],
    path: str | Path,
    arguments: Mapping[str, Any],
    seconds: float,
    types: Iterable[type] = (),
) -> Any:
    """Call a function that reads a USD file in a process of its own, with a limit of time.

    Parameters
    ----------
    function : callable
        At the top of a module. It takes the path as a string, and the arguments by name.
    path : str or Path
    arguments : dict
        What JSON can hold.
    seconds : float
    types : iterable of dataclasses
        That the answer may hold, besides those of a cage's contents, arrays, and what JSON can hold.

    Raises
    ------
    CageError
        As the function does, and if the process crashes or takes longer than ``seconds``.
    """
    name = f'"{path}"'
    request = {
        "function": [function.__module__, function.__name__],
        "path": str(path),
        "arguments": dict(arguments),
    }
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
        answered = _unpacked(done.stdout, {each.__name__: each for each in (*_CAGE_TYPES, *types)})
        error, messages, value = answered["error"], answered["warnings"], answered["value"]
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        raise CageError(f"{name}: the process that read the file gave no answer; expected a USD file") from None
    for message in messages:
        warn(message)
    if error is not None:
        raise CageError(error)
    return value


def answer() -> None:
    """Call the function that standard input names, and write its result to standard output; in the process."""
    request = json.load(sys.stdin.buffer)
    output = os.fdopen(os.dup(1), "wb")
    # What libraries print goes to standard error: it is not part of the answer.
    os.dup2(2, 1)
    module, name = request["function"]
    function = getattr(importlib.import_module(module), name)

    path = request["path"]
    _limit_memory(Path(path).stat().st_size)
    error, value = None, None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CageWarning)
        try:
            value = function(path, **request["arguments"])
        except CageError as found:
            error = str(found)
    messages = [str(each.message) for each in caught if issubclass(each.category, CageWarning)]
    with output:
        output.write(_packed({"error": error, "warnings": messages, "value": value}))
        output.flush()
        # At once, as the file may have damaged this process so that it would not end.
        os._exit(0)


def _packed(value: Any) -> memoryview:
    """Nested data as the bytes of an ``npz`` archive: arrays, and the rest as JSON."""
    arrays: list[NDArray] = []

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            arrays.append(value)
            return {"array": len(arrays) - 1}
        if dataclasses.is_dataclass(value):
            members = {each.name: plain(getattr(value, each.name)) for each in dataclasses.fields(value)}
            return {"type": type(value).__name__, "members": members}
        if isinstance(value, Mapping):
            # Apart from the two forms above, whatever its keys are.
            return {"mapping": {name: plain(each) for name, each in value.items()}}
        return [plain(each) for each in value] if isinstance(value, (list, tuple)) else value

    text = json.dumps(plain(value)).encode()
    content = io.BytesIO()
    named: dict[str, Any] = {f"array {i}": each for i, each in enumerate(arrays)}
    np.savez(content, text=np.frombuffer(text, np.uint8), **named)
    return content.getbuffer()


def _unpacked(content: bytes, types: Mapping[str, type]) -> Any:
    """The data of `_packed`; tuples have become lists."""
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:

        def value_of(plain: Any) -> Any:
            if isinstance(plain, list):
                return [value_of(each) for each in plain]
            if not isinstance(plain, dict):
                return plain
            if "array" in plain:
                return arrays[f"array {plain['array']}"]
            if "type" in plain:
                return types[plain["type"]](**{name: value_of(each) for name, each in plain["members"].items()})
            return {name: value_of(each) for name, each in plain["mapping"].items()}

        return value_of(json.loads(arrays["text"].tobytes()))


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
