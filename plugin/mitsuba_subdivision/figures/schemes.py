"""One cage under the three schemes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..images.exr import write_exr
from .output import FigureOptions, pyplot, save_figure
from .staging import in_8_bits, load_stage, render

TITLES = {"catmull_clark": "Catmull-Clark", "doo_sabin": "Doo-Sabin", "loop": "Loop"}


def draw_schemes(options: FigureOptions) -> list[Path]:
    """Render one cage of triangles, with its edges, under Catmull-Clark, Doo-Sabin and Loop side by side.

    Returns
    -------
    list of Path
        The files written.
    """
    plt = pyplot()
    figure, axes = plt.subplots(1, len(TITLES), figsize=(9.6, 3.45))
    pictures = []
    for (scheme, title), axis in zip(TITLES.items(), axes, strict=True):
        options.report(f"{title}")
        scene = load_stage("schemes", scheme=scheme, resolution=options.resolution)
        pixels = render(scene, options, title)[..., :3]
        pictures.append(pixels)
        axis.imshow(in_8_bits(pixels), interpolation="lanczos")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    # The layout leaves no room for titles above axes without frames.
    figure.tight_layout(pad=0.4, rect=(0, 0, 1, 0.94))
    written = options.paths("schemes", "png")
    for path in written:
        save_figure(figure, path, dpi=130)
    plt.close(figure)
    for path in options.paths("schemes", "exr"):
        write_exr(path, np.concatenate(pictures, axis=1), {"schemes": list(TITLES), "spp": options.spp})
        written.append(path)
    return written
