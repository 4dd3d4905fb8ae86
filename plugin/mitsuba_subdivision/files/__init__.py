"""Readers and writers of files: OBJ, PLY and USD. Public names are parts of the reader of USD meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..deferred import deferred

if TYPE_CHECKING:
    from .usd_primvars import PrimvarChoice
    from .usd_reader import MeshReader, reversed_order
    from .usd_skinning import Skinning
    from .usd_stage import open_stage, require_usd, usd_errors_at, usd_messages_of
    from .usd_values import HIDDEN_PURPOSES, local_to_world, require_types, time_of, value_at

__all__ = [
    "HIDDEN_PURPOSES",
    "MeshReader",
    "PrimvarChoice",
    "Skinning",
    "local_to_world",
    "open_stage",
    "require_types",
    "require_usd",
    "reversed_order",
    "time_of",
    "usd_errors_at",
    "usd_messages_of",
    "value_at",
]

# Cages of other formats do not wait for these.
__getattr__ = deferred(
    __name__,
    {
        "HIDDEN_PURPOSES": "usd_values",
        "MeshReader": "usd_reader",
        "PrimvarChoice": "usd_primvars",
        "Skinning": "usd_skinning",
        "local_to_world": "usd_values",
        "open_stage": "usd_stage",
        "require_types": "usd_values",
        "require_usd": "usd_stage",
        "reversed_order": "usd_reader",
        "time_of": "usd_values",
        "usd_errors_at": "usd_stage",
        "usd_messages_of": "usd_stage",
        "value_at": "usd_values",
    },
)
