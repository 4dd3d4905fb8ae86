"""Patches: every element of a cage grouped by the shape of its neighbourhood, and evaluation anywhere on them."""

from .channel import Channel, LinearChannel, SubdividedChannel, channel_of
from .patch_samples import evaluate_patches
from .patch_table import PatchClass, PatchTable
from .piece_table import PieceTable, control_rows

__all__ = [
    "Channel",
    "LinearChannel",
    "PatchClass",
    "PatchTable",
    "PieceTable",
    "SubdividedChannel",
    "channel_of",
    "control_rows",
    "evaluate_patches",
]
