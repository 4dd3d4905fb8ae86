"""Registration of the plugins of this package for every variant of Mitsuba.

A plugin is registered for one variant, and must be a class of this variant: with a class of another variant, Mitsuba
silently builds a scene without shapes.
"""

from __future__ import annotations

import sys
import threading
from types import ModuleType

import mitsuba as mi

from ..llvm import warn_if_unusable
from ..variants import variant_module, variant_name
from .device_state import paused_collection

PLUGIN_NAME = "subdivision"
# Variant in which Mitsuba looks up the kind of a plugin, whatever variant is set. `load_dict` needs the kind, as it
# merges equal objects unless they are shapes.
QUERY_VARIANT = "scalar_rgb"

_registered: dict[str, type] = {}
# Re-entrant, because creating the class may switch variants in a callback of another module.
_lock = threading.RLock()


def register() -> None:
    """Register the plugins for loaded variants now, and for others when they are first set. Idempotent."""
    mi.detail.add_variant_callback(_on_variant_change)
    _on_variant_change(None, mi.variant())


def register_variant(variant: ModuleType | str) -> type:
    """Register the plugins for a variant, and for the variant in which Mitsuba looks up plugin kinds. Idempotent.

    `register` suffices for variants that are set. Call this function for a variant that is used without being set, as
    by ``mi.parser.instantiate``.

    Parameters
    ----------
    variant : module or str
        ``mitsuba`` with a variant set, a variant such as ``mitsuba.llvm_ad_rgb``, or its name, "llvm_ad_rgb".

    Returns
    -------
    type
        The variant's shape class.

    Raises
    ------
    ValueError
        If Mitsuba has no such variant, no variant is set, or the argument is no variant.
    """
    variant_module(variant)
    name = variant_name(variant)
    with _lock, paused_collection():
        for variant_to_register in (QUERY_VARIANT, name):
            if variant_to_register not in _registered:
                from .foreground import FOREGROUND, make_foreground
                from .subdivision_shape import make_subdivision
                from .tangent_normals import make_tangent_normals

                module = getattr(mi, variant_to_register)
                shape = make_subdivision(module)
                module.register_shape(PLUGIN_NAME, shape)
                module.register_integrator(FOREGROUND, make_foreground(module))
                module.register_texture("tangent_normals", make_tangent_normals(module))
                _registered[variant_to_register] = shape
        return _registered[name]


def _on_variant_change(_old: str | None, new: str | None) -> None:
    if new is not None and new.startswith("llvm"):
        warn_if_unusable()
    for variant in mi.variants():
        # Variants are loaded when they are first set or accessed; loading all of them would take seconds.
        if f"mitsuba.{variant}" in sys.modules:
            register_variant(variant)
