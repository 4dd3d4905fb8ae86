"""The environment of a render: the versions and the processor that decide its last bits."""

from __future__ import annotations

import platform
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from ..llvm import llvm_problem, loaded_version


def environment(variant: str) -> dict[str, str]:
    """Versions of libraries, and the processor, that renders in a variant depend on.

    The version of this package is left out: its changes are what the tests are for.
    """
    modules = {"mitsuba": mi, "drjit": dr, "numpy": np, "scipy": scipy}
    found = {name: module.__version__ for name, module in modules.items()} | {"processor": _processor()}
    if variant.startswith("llvm"):
        found["llvm"] = str(loaded_version())
    return found


def variant_problem(variant: str) -> str | None:
    """Why a variant cannot run here, None if it can."""
    if variant not in mi.variants():
        return f'unknown variant "{variant}"; expected one of {", ".join(mi.variants())}'
    if variant.startswith("llvm"):
        return llvm_problem()
    if variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        return f"variant {variant} needs an NVIDIA GPU, and Dr.Jit finds none"
    return None


def _processor() -> str:
    # Code for another processor may add in another order. On Linux, `platform` does not know the model.
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
