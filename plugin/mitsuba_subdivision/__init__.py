"""Exact subdivision surfaces for Mitsuba 3.

Importing this package registers the shape ``subdivision`` in every variant, before or after ``mitsuba.set_variant``.
"""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

from .llvm import select_llvm

select_llvm()  # Before Mitsuba loads Dr.Jit, which uses the first LLVM library that it finds

from .shapes import register, register_variant  # noqa: E402, F401 - see above

register()

__version__ = "0.1.0"

# Modules of the public names, which the stub imports for type checkers. They are imported on first use, so that a scene
# without subdivision surfaces does not wait for them.
_MODULES = {
    imported.name: "." * line.level + (line.module or imported.name)
    for line in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(line, ast.ImportFrom)
    for imported in line.names
}
# Star imports omit the module `fit`.
__all__ = sorted({*_MODULES, "example_file"} - {"fit"})  # noqa: PLE0605 - the stub names them


def example_file(name: str) -> str:
    """Path of a file in the folder ``scenes``, in the installed package or in the source tree.

    Parameters
    ----------
    name : str
        Path in that folder, such as "cages/rook.obj", "rook.xml" or "export_cage.py".

    Returns
    -------
    str
        Path for the shape's parameter ``filename``.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    """
    package = Path(__file__).resolve().parent
    candidates = [package / "scenes", package.parents[1] / "scenes"]
    for folder in candidates:
        if (folder / name).is_file():
            return str(folder / name)
    folders = " nor in ".join(f'"{folder}"' for folder in candidates)
    raise FileNotFoundError(f'there is no example "{name}", neither in {folders}')


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(_MODULES[name], __name__)
    globals()[name] = module if name == "fit" else getattr(module, name)
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
