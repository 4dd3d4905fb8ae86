"""Patches: every element of a cage grouped by the shape of its neighbourhood, and evaluation anywhere on them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..deferred import deferred

if TYPE_CHECKING:
    from .area_samples import AreaSamples, SamplingCells, SurfaceAreas, uniform_locations
    from .channel import Channel, ChannelLayout, LinearChannel, PatchSampler, SubdividedChannel, contracts_alike
    from .closest_points import ClosestPoints, ClosestPointSearch
    from .energies import energy_matrix, gradients, hessians
    from .patch_table import PatchClass, PatchTable
    from .piece_table import PieceTable
    from .polynomial_pieces import ElementBounds, SurfacePieces
    from .stencil_matrices import StencilMatrices, sample_matrices

__all__ = [
    "AreaSamples",
    "Channel",
    "ChannelLayout",
    "ClosestPointSearch",
    "ClosestPoints",
    "ElementBounds",
    "LinearChannel",
    "PatchClass",
    "PatchSampler",
    "PatchTable",
    "PieceTable",
    "SamplingCells",
    "StencilMatrices",
    "SubdividedChannel",
    "SurfaceAreas",
    "SurfacePieces",
    "contracts_alike",
    "energy_matrix",
    "gradients",
    "hessians",
    "sample_matrices",
    "uniform_locations",
]

__getattr__ = deferred(
    __name__,
    {
        "area_samples": ("AreaSamples", "SamplingCells", "SurfaceAreas", "uniform_locations"),
        "channel": (
            "Channel",
            "ChannelLayout",
            "LinearChannel",
            "PatchSampler",
            "SubdividedChannel",
            "contracts_alike",
        ),
        "closest_points": ("ClosestPointSearch", "ClosestPoints"),
        "energies": ("energy_matrix", "gradients", "hessians"),
        "patch_table": ("PatchClass", "PatchTable"),
        "piece_table": ("PieceTable",),
        "polynomial_pieces": ("ElementBounds", "SurfacePieces"),
        "stencil_matrices": ("StencilMatrices", "sample_matrices"),
    },
)
