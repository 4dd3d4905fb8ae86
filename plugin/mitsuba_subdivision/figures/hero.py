"""A human figure: limit surface and control cage."""

from __future__ import annotations

from pathlib import Path

from .figure_scenes import in_8_bits, load_stage, render
from .output import FigureOptions, save_png, write_pixels

# The image stands alone: it is wider than images that share a figure, by this factor, and 8 : 5.
WIDER = 2.25
HEIGHT = 0.625


def draw(options: FigureOptions) -> list[Path]:
    """Render the scene `human`: the limit surface of a human figure beside its cage."""
    width = round(WIDER * options.resolution)
    scene = load_stage("human", width=width, height=round(HEIGHT * width))
    options.report("mannequin")
    pixels = render(scene, options, "mannequin")[..., :3]
    written = options.paths("hero", "png")
    for path in written:
        save_png(in_8_bits(pixels), path)
    metadata = {"spp": options.spp, "cage": "human.obj, (c) 2010 Tobias Rittig"}
    return written + write_pixels(options, "hero", pixels, metadata)
