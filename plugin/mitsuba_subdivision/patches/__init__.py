"""Patches: every element of a cage grouped by the shape of its neighbourhood, and evaluation anywhere on them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..deferred import deferred

if TYPE_CHECKING:
    from .area_samples import AreaSamples, SamplingCells, surface_areas, uniform_locations
    from .channel import Channel, ChannelLayout, contracts_alike
    from .closest_points import ClosestPoints, ClosestPointSearch
    from .energies import energy_matrix, gradients, hessians
    from .patch_samples import PatchSampler, StencilMatrices, stencil_matrices
    from .patch_table import PatchClass, PatchTable
    from .piece_table import PieceTable
    from .polynomial_pieces import ElementBounds, SurfacePieces

__all__ = [
    "AreaSamples",
    "Channel",
    "ChannelLayout",
    "ClosestPointSearch",
    "ClosestPoints",
    "ElementBounds",
    "PatchClass",
    "PatchSampler",
    "PatchTable",
    "PieceTable",
    "SamplingCells",
    "StencilMatrices",
    "SurfacePieces",
    "contracts_alike",
    "energy_matrix",
    "gradients",
    "hessians",
    "stencil_matrices",
    "surface_areas",
    "uniform_locations",
]

__getattr__ = deferred(
    __name__,
    {
        "area_samples": ("AreaSamples", "SamplingCells", "surface_areas", "uniform_locations"),
        "channel": ("Channel", "ChannelLayout", "contracts_alike"),
        "closest_points": ("ClosestPointSearch", "ClosestPoints"),
        "energies": ("energy_matrix", "gradients", "hessians"),
        "patch_samples": ("PatchSampler", "StencilMatrices", "stencil_matrices"),
        "patch_table": ("PatchClass", "PatchTable"),
        "piece_table": ("PieceTable",),
        "polynomial_pieces": ("ElementBounds", "SurfacePieces"),
    },
)
