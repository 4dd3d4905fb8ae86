"""Readers and writers of OBJ, PLY and USD files. Public names are parts of the reader of USD meshes."""

from .usd_reader import MeshReader
from .usd_skinning import Skinning
from .usd_stage import (
    HIDDEN_PURPOSES,
    listed,
    local_to_world,
    open_stage,
    require_types,
    require_usd,
    time_of,
    usd_errors_at,
    usd_messages_of,
    value_at,
)

__all__ = [
    "HIDDEN_PURPOSES", "MeshReader", "Skinning", "listed", "local_to_world", "open_stage", "require_types",
    "require_usd", "time_of", "usd_errors_at", "usd_messages_of", "value_at",
]  # fmt: skip
