"""Patches: every element of a cage grouped by the shape of its neighbourhood, and evaluation anywhere on them."""

from .area_samples import AreaSamples, uniform_places
from .channel import Channel, LinearChannel, SubdividedChannel, channel_of, contracts_alike
from .closest_points import ClosestPoints, ClosestPointSearch
from .element_bounds import ElementBounds, element_bounds
from .energies import energy_matrix, gradients, hessians
from .patch_samples import evaluate_patches
from .patch_table import PatchClass, PatchTable
from .piece_table import PieceTable, control_rows
from .polynomial_pieces import SurfacePieces
from .sample_places import SamplePlaces
from .stencil_matrices import StencilMatrices, StencilRows, sample_matrices
from .surface_area import SurfaceAreas

__all__ = [
    "AreaSamples",
    "Channel",
    "ClosestPointSearch",
    "ClosestPoints",
    "ElementBounds",
    "LinearChannel",
    "PatchClass",
    "PatchTable",
    "PieceTable",
    "SamplePlaces",
    "StencilMatrices",
    "StencilRows",
    "SubdividedChannel",
    "SurfaceAreas",
    "SurfacePieces",
    "channel_of",
    "contracts_alike",
    "control_rows",
    "element_bounds",
    "energy_matrix",
    "evaluate_patches",
    "gradients",
    "hessians",
    "sample_matrices",
    "uniform_places",
]
