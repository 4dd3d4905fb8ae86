"""The limit surface of a control cage."""

from ..cage.contents import TEXCOORDS
from ..evaluation.element import SurfaceSamples
from .limit_surface import LimitSurface

__all__ = ["TEXCOORDS", "LimitSurface", "SurfaceSamples"]
