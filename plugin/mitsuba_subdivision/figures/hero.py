"""A mannequin: limit surface and control cage."""

from __future__ import annotations

from pathlib import Path

from ..images.exr import write_exr
from .output import FigureOptions, save_picture
from .staging import in_8_bits, load_stage, render

# The picture stands alone: it is wider than those that share a figure, by this factor, and 8 : 5.
WIDER = 2.25
HEIGHT = 0.625


def draw_hero(options: FigureOptions) -> list[Path]:
    """Render the scene `human`: a figure's limit surface beside its cage.

    Returns
    -------
    list of Path
        The files written.
    """
    width = round(WIDER * options.resolution)
    scene = load_stage("human", width=width, height=round(HEIGHT * width))
    options.report("mannequin")
    pixels = render(scene, options, "mannequin")[..., :3]
    written = options.paths("hero", "png")
    for path in written:
        save_picture(in_8_bits(pixels), path)
    for path in options.paths("hero", "exr"):
        write_exr(path, pixels, {"spp": options.spp, "cage": "human.obj, (c) 2010 Tobias Rittig"})
        written.append(path)
    return written
