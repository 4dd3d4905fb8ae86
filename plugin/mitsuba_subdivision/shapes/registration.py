"""Registration of the plugins of this package for every variant of Mitsuba.

A plugin is registered for one variant, and must be a class of that variant: with another one's class Mitsuba silently
builds a scene without shapes.
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
# In every variant, Mitsuba looks up the kind of a plugin in this variant. It needs the kind because `load_dict` merges
# equal objects unless they are shapes.
QUERY_VARIANT = "scalar_rgb"

_registered: dict[str, type] = {}
# Re-entrant, as making the class may itself switch variants in another module's callback.
_lock = threading.RLock()


def register() -> None:
    """Register the plugins for every variant: for loaded ones now, for others when they are first set. Idempotent."""
    mi.detail.add_variant_callback(_on_variant_change)
    current = mi.variant()
    if current is None:
        _register_loaded_variants()
    else:
        _on_variant_change(None, current)


def register_variant(variant: ModuleType | str) -> type:
    """Register the plugins for a variant, and for the one in which Mitsuba looks up plugin kinds. Idempotent.

    `register` does this for every variant that is set. Call it for a variant that is used without being set, as by
    ``mi.parser.instantiate``.

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
        If Mitsuba has no such variant, none is set, or it is something else.
    """
    variant_module(variant)
    name = variant_name(variant)
    with _lock, paused_collection():
        for needed in (QUERY_VARIANT, name):
            if needed not in _registered:
                from .subdivision_shape import make_subdivision

                module = getattr(mi, needed)
                shape = make_subdivision(module)
                module.register_shape(PLUGIN_NAME, shape)
                _registered[needed] = shape
        return _registered[name]


def _on_variant_change(_old: str | None, new: str) -> None:
    if new.startswith("llvm"):
        warn_if_unusable()
    _register_loaded_variants()


def _register_loaded_variants() -> None:
    for variant in mi.variants():
        # A variant is loaded when it is first set or first used by name; loading all of them would take seconds.
        if f"mitsuba.{variant}" in sys.modules:
            register_variant(variant)
