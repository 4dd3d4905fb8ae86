"""Exact subdivision surfaces for Mitsuba 3.

Importing this package registers the shape ``subdivision`` in every variant, before or after ``mitsuba.set_variant``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from .llvm import select_llvm

# Before Mitsuba loads Dr.Jit, which takes the first LLVM library it meets.
select_llvm()

from .shapes import register, register_variant  # noqa: E402 - see above

register()

__version__ = "0.1.0"

if TYPE_CHECKING:
    from mitsuba_usd import usd_scene

    from . import fit as fit
    from .cage import Attribute, CageError, CageWarning, ControlCage
    from .device_arrays import upload
    from .evaluation.element import limit_stencil
    from .evaluation.scheme_laws import check_scheme
    from .patches.area_samples import AreaSamples
    from .patches.closest_points import ClosestPoints
    from .patches.patch_samples import StencilMatrices
    from .patches.polynomial_pieces import ElementBounds
    from .refinement.cage_refinement import CageRefinement
    from .schemes import SchemeError
    from .shapes.derivatives import loss_of_views
    from .shapes.parameters import pixel_error_for
    from .studio import render_denoised, studio_scene, weigh_lights
    from .surface import LimitSurface, SurfaceSamples
    from .tessellation.vertex_table import Tessellation, VertexMatrices

__all__ = [
    "AreaSamples",
    "Attribute",
    "CageError",
    "CageRefinement",
    "CageWarning",
    "ClosestPoints",
    "ControlCage",
    "ElementBounds",
    "LimitSurface",
    "SchemeError",
    "StencilMatrices",
    "SurfaceSamples",
    "Tessellation",
    "VertexMatrices",
    "check_scheme",
    "example_file",
    "limit_stencil",
    "loss_of_views",
    "pixel_error_for",
    "register",
    "register_scheme",
    "register_variant",
    "render_denoised",
    "studio_scene",
    "upload",
    "usd_scene",
    "weigh_lights",
]

# Imported when first used, so that a scene without subdivision surfaces does not wait for them.
_NAMES = {
    ".cage": ("Attribute", "CageError", "CageWarning", "ControlCage"),
    ".device_arrays": ("upload",),
    ".evaluation.element": ("limit_stencil",),
    ".evaluation.scheme_laws": ("check_scheme",),
    ".patches.area_samples": ("AreaSamples",),
    ".patches.closest_points": ("ClosestPoints",),
    ".patches.patch_samples": ("StencilMatrices",),
    ".patches.polynomial_pieces": ("ElementBounds",),
    ".refinement.cage_refinement": ("CageRefinement",),
    ".schemes": ("SchemeError", "register_scheme"),
    ".shapes.derivatives": ("loss_of_views",),
    ".shapes.parameters": ("pixel_error_for",),
    ".studio": ("render_denoised", "studio_scene", "weigh_lights"),
    ".surface": ("LimitSurface", "SurfaceSamples"),
    ".tessellation.vertex_table": ("Tessellation", "VertexMatrices"),
    "mitsuba_usd": ("usd_scene",),
}


def example_file(name: str) -> str:
    """Path of a file in the folder ``scenes``, in the installed package or in the source tree.

    Parameters
    ----------
    name : str
        Path in that folder, such as "cages/rook.obj", "rook.xml" or "export_cage.py".

    Returns
    -------
    str
        As the shape's parameter ``filename`` takes it.

    Raises
    ------
    FileNotFoundError
        If there is none.
    """
    from pathlib import Path

    package = Path(__file__).resolve().parent
    candidates = [package / "scenes", package.parents[1] / "scenes"]
    for folder in candidates:
        if (folder / name).is_file():
            return str(folder / name)
    folders = " nor in ".join(f'"{folder}"' for folder in candidates)
    raise FileNotFoundError(f'there is no example "{name}", neither in {folders}')


def __getattr__(name: str) -> object:
    if name == "fit":
        return importlib.import_module(".fit", __name__)
    for module, names in _NAMES.items():
        if name in names:
            globals()[name] = getattr(importlib.import_module(module, __name__), name)
            return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
