"""A neutral studio around a model: camera, lights and backdrop, turntables, and the command ``render``."""

from .scene import model_scene, studio_scene
from .stage import studio

__all__ = ["model_scene", "studio", "studio_scene"]
