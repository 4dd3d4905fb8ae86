"""The limit surface of a control cage."""

from .limit_surface import TEXCOORDS, LimitSurface, limit_stencil
from .samples import SurfaceSamples

__all__ = ["TEXCOORDS", "LimitSurface", "SurfaceSamples", "limit_stencil"]
