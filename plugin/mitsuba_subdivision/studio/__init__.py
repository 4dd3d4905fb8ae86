"""A neutral studio around a model: camera, lights and backdrop, turntables, frames, and scenes saved as XML."""

from ..regression.scene import LoadedScene
from ..tessellation import HIGHEST_RATE
from ..tessellation.memory import available_memory
from .animation import SceneSource, StillPicture, load_quietly, set_parameters
from .cage_scenes import frame_table, studio_scene
from .picture import (
    ERRORS,
    MOST_SEGMENTS,
    MOST_TRIANGLES,
    highest_rate,
    outline_for,
    pixels_of_copies,
    render_denoised,
    segments_for,
    set_light_weights,
    shading_for,
    triangles_for,
    weigh_lights,
)
from .studio_entries import (
    AOVS,
    DEFAULT_SIZE,
    DEFAULT_SPP,
    DEFAULT_VIEW,
    ENVIRONMENT,
    STUDIO,
    Look,
    View,
    enlargement,
    finished,
    sampler,
    studio,
)

__all__ = [
    "AOVS", "DEFAULT_SIZE", "DEFAULT_SPP", "DEFAULT_VIEW", "ENVIRONMENT", "ERRORS", "HIGHEST_RATE", "MOST_SEGMENTS",
    "MOST_TRIANGLES", "STUDIO", "LoadedScene", "Look", "SceneSource", "StillPicture", "View", "available_memory",
    "enlargement", "finished", "frame_table", "highest_rate", "load_quietly", "outline_for", "pixels_of_copies",
    "render_denoised", "sampler", "segments_for", "set_light_weights", "set_parameters", "shading_for", "studio",
    "studio_scene", "triangles_for", "weigh_lights",
]  # fmt: skip
