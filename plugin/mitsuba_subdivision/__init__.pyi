"""The public names for type checkers, and the table by which `__init__.py` imports them."""

from mitsuba_usd import usd_scene as usd_scene

from . import fit as fit
from .cage import Attribute as Attribute, CageError as CageError, CageWarning as CageWarning, ControlCage as ControlCage
from .device_arrays import upload as upload
from .evaluation.element import limit_stencil as limit_stencil
from .evaluation.scheme_laws import check_scheme as check_scheme
from .files.joined_cage import joined_cage as joined_cage
from .patches.area_samples import AreaSamples as AreaSamples
from .patches.closest_points import ClosestPoints as ClosestPoints
from .patches.patch_samples import StencilMatrices as StencilMatrices
from .patches.polynomial_pieces import ElementBounds as ElementBounds
from .refinement.cage_refinement import CageRefinement as CageRefinement
from .schemes import SchemeError as SchemeError, register_scheme as register_scheme
from .shapes import register as register, register_variant as register_variant
from .shapes.derivatives import loss_of_views as loss_of_views
from .shapes.parameters import pixel_error_for as pixel_error_for
from .studio import render_denoised as render_denoised, studio_scene as studio_scene, weigh_lights as weigh_lights
from .surface import LimitSurface as LimitSurface, SurfaceSamples as SurfaceSamples
from .tessellation.vertex_table import Tessellation as Tessellation, VertexMatrices as VertexMatrices

__version__: str

def example_file(name: str) -> str: ...
