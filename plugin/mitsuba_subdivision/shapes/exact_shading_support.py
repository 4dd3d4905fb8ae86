"""Decides whether ``shading="auto"`` selects exact shading in a variant."""

from __future__ import annotations

from functools import cache

import drjit as dr

from ..variants import Variant
from .mitsuba_3_9_hook.interaction_hook import hook_problem, interaction_hook


def exact_shading_problem(variant: Variant) -> str | None:
    """Reason for which ``shading="auto"`` selects interpolated vertex normals; None if it selects exact shading.

    Parameters
    ----------
    variant : module
        Such as ``mitsuba.llvm_ad_rgb``.
    """
    if not dr.is_jit_v(variant.Float):
        return "exact shading needs a variant of llvm or cuda"
    problem = hook_problem() or _trial_problem(variant)
    return problem and f"exact shading {problem}"


@cache
def _trial_problem(variant: Variant) -> str | None:
    # Derived in Python like the shapes, because a C++ class has another table of virtual functions.
    class Example(variant.Mesh):
        """Mesh derived in Python."""

    try:
        interaction_hook(variant, Example("example", vertex_count=3, face_count=1))
    except RuntimeError as error:
        return str(error)
    return None
