"""Variants of Mitsuba, given as its module with a variant set, the module of a variant, or a variant's name."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

from .llvm import best_variant, llvm_problem, loaded_version, require_llvm

# The module of a variant, such as mitsuba.llvm_ad_rgb. For mypy, a class in a `ModuleType` is no base class.
Variant: TypeAlias = Any
SceneNode = dict[str, Any]  # A scene or its entry, for `mi.load_dict`
OPENEXR_THREADS = 2  # Mitsuba's OpenEXR files need one thread that waits and one that works
EXPECTED = 'the module mitsuba with a variant set, a variant such as mitsuba.llvm_ad_rgb, or its name, "llvm_ad_rgb"'


def variant_module(mi: ModuleType | str) -> ModuleType:
    """Module of a variant in one of the forms of `EXPECTED`; raises ValueError for any other value."""
    import mitsuba

    name = variant_name(mi)
    if problem := _unknown(name):
        raise ValueError(problem)
    return getattr(mitsuba, name)


def _unknown(name: str) -> str | None:
    from mitsuba import variants

    return None if name in variants() else f'unknown variant "{name}"; expected one of {", ".join(variants())}'


def variant_problem(name: str) -> str | None:
    """Reason why a variant cannot run here, None if it can."""
    import drjit as dr

    if problem := _unknown(name):
        return problem
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        return f"variant {name} needs an NVIDIA GPU, and Dr.Jit finds none"
    return llvm_problem() if name.startswith("llvm") else None


def chosen_variant(name: str | None) -> str:
    """The variant of this name, or else the best. Raises ValueError or RuntimeError if it cannot run here."""
    if name is None:
        return best_variant()
    if name.startswith("llvm"):
        require_llvm()
    if problem := variant_problem(name):
        raise ValueError(problem)
    return name


def set_variant(name: str | None) -> None:
    """Set a variant of Mitsuba, or else the best, in a process of this package, for instance a command.

    On a machine with one core, Dr.Jit starts another thread: with one thread, Mitsuba 3.9 never finishes reading or
    writing OpenEXR files. Errors are those of `chosen_variant`.
    """
    import drjit as dr
    import mitsuba

    mitsuba.set_variant(chosen_variant(name))
    dr.set_thread_count(max(dr.thread_count(), OPENEXR_THREADS))


@contextmanager
def threads_set(count: int | None) -> Iterator[None]:
    """Compute with this number of threads for a while. With one, files cannot be read or written: see `set_variant`."""
    import drjit as dr

    before = dr.thread_count()
    dr.set_thread_count(count or before)
    try:
        yield
    finally:
        dr.set_thread_count(before)


@contextmanager
def variant_set(mi: ModuleType | str) -> Iterator[ModuleType]:
    """Set a variant for a while, and yield ``mitsuba``; arguments and errors are those of `variant_module`."""
    import mitsuba

    variant_module(mi)
    before, name = mitsuba.variant(), variant_name(mi)
    if name.startswith("llvm"):
        require_llvm()
    if before != name:
        mitsuba.set_variant(name)
    try:
        yield mitsuba
    finally:
        if before not in (None, name):
            mitsuba.set_variant(before)


def variant_name(mi: ModuleType | str) -> str:
    """Name of a variant, such as "llvm_ad_rgb"; like `variant_module`, but names are not checked."""
    if isinstance(mi, str):
        return mi
    mitsuba = sys.modules.get("mitsuba")
    if mitsuba is not None and mi is mitsuba:
        if mitsuba.variant() is None:
            raise ValueError(f"the module mitsuba, and no variant is set; expected {EXPECTED}")
        return str(mitsuba.variant())
    for name in mitsuba.variants() if mitsuba is not None and isinstance(mi, ModuleType) else []:
        if mi is sys.modules.get(f"mitsuba.{name}"):
            return str(name)
    raise ValueError(f"{mi!r}; expected {EXPECTED}")


# Fields that distinguish x86 processors of one name, and identify ARM processors, which have no name.
_NUMBERS = ("cpu family", "model", "CPU implementer", "CPU architecture", "CPU variant", "CPU part")


def environment(variant: str) -> dict[str, str]:
    """Versions of libraries and the processor, which affect renders in a variant."""
    import drjit
    import mitsuba
    import numpy
    import scipy

    # Without this package, whose changes are what tests of renders test.
    versions = {module.__name__: str(module.__version__) for module in (mitsuba, drjit, numpy, scipy)}
    versions["processor"] = _processor()
    if variant.startswith("llvm"):
        versions["llvm"] = str(loaded_version())
    return versions


def _processor() -> str:
    # Code for another processor may add in another order. On Linux, `platform` lacks the model.
    listed = Path("/proc/cpuinfo")
    name = _first_of(listed.read_text(encoding="utf-8", errors="replace")) if listed.is_file() else ""
    return name or platform.processor() or platform.machine()


def _first_of(information: str) -> str:
    """The first processor of Linux's list, by name and numbers: generations share names such as "AMD EPYC"."""
    lines = [line.split(":", 1) for line in information.split("\n\n", 1)[0].splitlines() if ":" in line]
    values = {name.strip(): value.strip() for name, value in lines}
    names = ["model name", *_NUMBERS]
    return ", ".join(f"{name} {values[name]}".removeprefix("model name ") for name in names if name in values)
