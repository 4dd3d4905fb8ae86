"""The limit surface of a control cage."""

from .limit_surface import TEXCOORDS, LimitSurface, SurfaceSamples

__all__ = ["TEXCOORDS", "LimitSurface", "SurfaceSamples"]
