"""From a cage to patches grouped by class."""

from .patch_table import PatchGroup, PatchTable

__all__ = ["PatchGroup", "PatchTable"]
