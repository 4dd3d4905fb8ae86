"""The environment of a render: the versions and the processor that decide its last bits."""

from __future__ import annotations

import platform
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from ..llvm import llvm_problem, loaded_version

# Fields that distinguish processors of one name on x86, and that identify those of ARM, which have no name.
_NUMBERS = ("cpu family", "model", "CPU implementer", "CPU architecture", "CPU variant", "CPU part")


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
    found = _first_of(information.read_text(encoding="utf-8", errors="replace")) if information.is_file() else ""
    return found or platform.processor() or platform.machine()


def _first_of(information: str) -> str:
    """The first processor of Linux's list, by its name and numbers.

    The name is not enough: virtual machines call processors of several generations "AMD EPYC".
    """
    lines = [line.split(":", 1) for line in information.split("\n\n", 1)[0].splitlines() if ":" in line]
    values = {name.strip(): value.strip() for name, value in lines}
    numbers = [f"{name} {values[name]}" for name in _NUMBERS if name in values]
    return ", ".join([*([values["model name"]] if "model name" in values else []), *numbers])
