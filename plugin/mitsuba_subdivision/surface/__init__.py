"""The limit surface of a control cage."""

from ..evaluation.element import SurfaceSamples
from .limit_surface import TEXCOORDS, LimitSurface

__all__ = ["TEXCOORDS", "LimitSurface", "SurfaceSamples"]
