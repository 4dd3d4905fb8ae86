"""Kernels without LLVM's optimisations, compiled in a quarter of the time: most kernels of tests run once.

``conftest.py`` imports this before Dr.Jit, and kernels of notebooks run it as a file. Other processes that tests start
compile as those of users do.
"""

import ctypes
import os
import sys
from pathlib import Path

# Users' kernels stay fast. Before the package imports Dr.Jit, which reads it then.
os.environ.setdefault("DRJIT_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "d" / "drjit"))

from mitsuba_subdivision.llvm import select_llvm

# The extra `llvm` brings this version or a newer one. An unknown option would end the process.
LLVM = 19

library = select_llvm()
if library.path and (library.version or 0) >= LLVM:
    # Registers are given without a search as well: compiling takes a fifth less, and long renders a twentieth more.
    options = (b"pytest", b"-opt-bisect-limit=0", b"-opt-bisect-verbose=0", b"-optimize-regalloc=false")
    arguments = (ctypes.c_char_p * len(options))(*options)
    ctypes.CDLL(library.path).LLVMParseCommandLineOptions(len(options), arguments, None)

# `.ci/run` runs some tests again, in which reading beyond an array ends the process.
if os.environ.get("GUARDED_ARRAYS"):
    sys.path.append(str(Path(__file__).parent))
    import guarded_arrays  # noqa: F401
