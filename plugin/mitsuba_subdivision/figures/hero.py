"""A human figure: limit surface and control cage."""

from __future__ import annotations

from pathlib import Path

from .figure_scenes import draw_picture, load_stage, picture_size, render
from .output import FigureOptions


def draw(options: FigureOptions) -> list[Path]:
    """Render the scene `human`: the limit surface of a human figure beside its cage."""
    width, height = picture_size(options)
    scene = load_stage("human", width=width, height=height)
    options.report("mannequin")
    pixels = render(scene, options, "mannequin")[..., :3]
    return draw_picture(options, "hero", pixels, {"spp": options.spp, "cage": "human.obj, (c) 2010 Tobias Rittig"})
