"""A neutral studio around a model: camera, lights and backdrop, turntables, and the command ``render``."""

from .denoising import render_denoised
from .scene import studio_scene
from .studio_entries import studio

__all__ = ["render_denoised", "studio", "studio_scene"]
