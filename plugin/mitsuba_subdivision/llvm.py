"""The choice of the LLVM library that Dr.Jit loads.

Dr.Jit loads the first library that it finds when it is imported. On x86-64 its kernels need LLVM 17 or newer: with an
older library, the first kernel with a minimum or a maximum ends the process. So this package chooses a library before
Dr.Jit does.
"""

from __future__ import annotations

import ctypes
import functools
import glob
import os
import platform
import re
import site
import subprocess
import sys
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

ENVIRONMENT_VARIABLE = "DRJIT_LIBLLVM_PATH"
INSTALL_HINT = (
    f"pip install 'mitsuba-subdivision[llvm]', or set {ENVIRONMENT_VARIABLE} to the path of an LLVM library"
    " before Python starts"
)
# Path in place of a usable library. Dr.Jit prints the path that it cannot load, so it contains the reason.
NO_USABLE_LLVM = "no LLVM library that Dr.Jit runs without aborting; see mitsuba_subdivision.llvm"

_TOO_LATE = "Dr.Jit was imported first"
_SYSTEM_FOLDERS = (
    *("/usr/local/lib", "/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/lib"),
    *("/usr/lib/wsl/lib", "/usr/lib/llvm-*/lib", "/opt/llvm*/lib"),
)


class LlvmChoice(NamedTuple):
    """The library for Dr.Jit to load."""

    path: str | None  # None if Dr.Jit searches itself, or if no library is usable
    version: int | None  # Major version, None if unknown; without a path, of the newest library, which is too old
    reason: str


def lowest_version() -> int:
    """Oldest major version of LLVM that runs Dr.Jit's kernels on this machine."""
    return 17 if platform.machine().lower() in ("x86_64", "amd64") else 15


@functools.cache
def select_llvm() -> LlvmChoice:
    """Choose an LLVM library and set ``DRJIT_LIBLLVM_PATH`` to it. Call it before Dr.Jit is imported.

    A setting by the user has precedence. Otherwise the library comes from the extra ``mitsuba-subdivision[llvm]``, from
    the Python environment (as with conda), or else from the system. If all libraries are too old, LLVM variants fail
    with an exception instead of ending the process. If there is none, or no Linux, Dr.Jit searches by its own rules.
    """
    chosen = os.environ.get(ENVIRONMENT_VARIABLE)
    if chosen and chosen != NO_USABLE_LLVM:  # Set by a parent process that found no usable library
        return LlvmChoice(chosen, library_version(chosen), f"{ENVIRONMENT_VARIABLE} is set")
    if "drjit" in sys.modules:
        return LlvmChoice(None, loaded_version(), _TOO_LATE)
    if not sys.platform.startswith("linux"):
        return LlvmChoice(None, None, "Dr.Jit searches by its own rules on this system")

    choice = _search()
    if choice.path:
        os.environ[ENVIRONMENT_VARIABLE] = choice.path
    elif choice.version:
        os.environ[ENVIRONMENT_VARIABLE] = NO_USABLE_LLVM
    return choice


def library_version(path: str | Path) -> int | None:
    """Major version of an LLVM library, by the name of its file or of its folders; None if no name has one."""
    resolved = os.path.realpath(path)
    folder = os.path.dirname(resolved)
    for name in (os.path.basename(resolved), os.path.basename(path), folder, os.path.dirname(folder)):
        if match := re.search(r"(?:LLVM-|LLVM\.(?:so|dylib)\.|llvm[-/])(\d+)", name):
            return int(match[1])
    return None


def loaded_version() -> int | None:
    """Major version of the library that Dr.Jit has loaded, None if its LLVM backend is inactive. Imports Dr.Jit."""
    import drjit as dr

    return int(dr.detail.llvm_version()[0]) if dr.has_backend(dr.JitBackend.LLVM) else None


def llvm_problem() -> str | None:
    """One line that says why LLVM variants cannot run here and what to do; None if they can. Imports Dr.Jit."""
    choice, version, lowest = select_llvm(), loaded_version(), lowest_version()
    if version is None:
        if choice.path:
            return f'Dr.Jit could not use "{choice.path}" ({choice.reason}): {INSTALL_HINT}'
        loaded = f" but LLVM {choice.version}, which would abort the process" if choice.version else ""
        return f"Dr.Jit has no LLVM library{loaded}: {INSTALL_HINT}"
    if version >= lowest:
        return None
    why = f"Dr.Jit has loaded LLVM {version}, which aborts the process, and needs {lowest} or newer"
    if choice.reason == _TOO_LATE:
        return f"{why}: import mitsuba_subdivision before mitsuba and drjit; if that does not help, {INSTALL_HINT}"
    return f"{why} ({choice.reason}): {INSTALL_HINT}"


def imported_too_late() -> bool:
    """Whether Dr.Jit lacks a usable library only because it was imported first."""
    return llvm_problem() is not None and select_llvm().reason == _TOO_LATE and _search().path is not None


@functools.cache
def require_llvm() -> None:
    """Raise RuntimeError with `llvm_problem`, if any: with too old a library, the first kernel ends the process."""
    if problem := llvm_problem():
        raise RuntimeError(problem)


def warn_if_unusable() -> None:
    """Warn if Dr.Jit has loaded an LLVM library that aborts the process. Imports Dr.Jit."""
    if loaded_version() is not None and (problem := llvm_problem()):
        warnings.warn(problem, RuntimeWarning, stacklevel=3)


def version_without_package() -> int | None:
    """Major version of the library that Dr.Jit loads in a process that imports Mitsuba first; None if it finds none."""
    environment = dict(os.environ)
    if not select_llvm().reason.startswith(ENVIRONMENT_VARIABLE):
        environment.pop(ENVIRONMENT_VARIABLE, None)
    code = "import drjit as dr; print(dr.detail.llvm_version()[0] if dr.has_backend(dr.JitBackend.LLVM) else 0)"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    return int(done.stdout.strip() or 0) or None


def best_variant() -> str:
    """Fastest variant that needs no GPU: "llvm_ad_rgb", or else "scalar_rgb", with a line on standard error."""
    if (problem := llvm_problem()) is None:
        return "llvm_ad_rgb"
    sys.stderr.write(f"mitsuba-subdivision: using the slower variant scalar_rgb. {problem}.\n")
    return "scalar_rgb"


def _search() -> LlvmChoice:
    """Newest usable library of the first location that has one: the Python environment, the system."""
    newest_old, loader_folders = 0, map(glob.escape, filter(None, os.environ.get("LD_LIBRARY_PATH", "").split(":")))
    for reason, folders in (
        ("found in the Python environment", _python_folders()),
        ("newest of the system", [*loader_folders, *_SYSTEM_FOLDERS]),
    ):
        versions = [(_known_version(path), path) for path in _libraries(folders)]
        version, path = max(versions, default=(0, ""))
        if version >= lowest_version():
            return LlvmChoice(path, version, reason)
        newest_old = max(newest_old, version)
    if newest_old:
        return LlvmChoice(None, newest_old, f"no LLVM {lowest_version()} or newer was found")
    return LlvmChoice(None, None, "no LLVM library was found; Dr.Jit searches by its own rules")


def _known_version(path: str) -> int:
    """Major version of a library by its name, or else by the library itself; 0 if it is not an LLVM library."""
    if (version := library_version(path)) is not None:
        return version
    try:
        library = ctypes.CDLL(path)
    except OSError:
        return 0
    if not hasattr(library, "LLVMGetVersion"):
        return 15 if hasattr(library, "LLVMGetGlobalContext") else 0  # `LLVMGetVersion` exists since LLVM 16
    major = ctypes.c_uint()
    library.LLVMGetVersion(ctypes.byref(major), None, None)
    return major.value


def _libraries(patterns: Iterable[str]) -> list[str]:
    paths = (path for folder in patterns for path in glob.glob(f"{folder}/libLLVM[-.]*so*"))
    return [path for path in paths if os.path.isfile(path)]


def _python_folders() -> list[str]:
    prefixes = [sys.prefix, sys.base_prefix, site.getuserbase(), *filter(None, sys.path)]
    # Wheels have libraries two folders above their modules, or directly below them with `pip install --target`.
    above = [os.path.dirname(os.path.dirname(folder)) for folder in sys.path if folder.endswith("-packages")]
    return [glob.escape(folder) for folder in dict.fromkeys([*(f"{prefix}/lib" for prefix in prefixes), *above])]
