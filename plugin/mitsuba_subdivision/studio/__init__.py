"""A neutral studio around a model: camera, lights and backdrop, turntables, and the command ``render``."""

from .scene import studio_scene
from .stage import studio

__all__ = ["studio", "studio_scene"]
