"""One cage under the three schemes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .output import FigureOptions, pyplot, write_pixels, write_plot
from .staging import in_8_bits, load_stage, render

TITLES = {"catmull_clark": "Catmull-Clark", "doo_sabin": "Doo-Sabin", "loop": "Loop"}


def draw(options: FigureOptions) -> list[Path]:
    """Render one cage of triangles, with its edges, under Catmull-Clark, Doo-Sabin and Loop side by side."""
    plt = pyplot()
    figure, axes = plt.subplots(1, len(TITLES), figsize=(9.6, 3.45))
    panels = []
    for (scheme, title), axis in zip(TITLES.items(), axes, strict=True):
        options.report(title)
        scene = load_stage("schemes", scheme=scheme, resolution=options.resolution)
        pixels = render(scene, options, title)[..., :3]
        panels.append(pixels)
        axis.imshow(in_8_bits(pixels), interpolation="lanczos")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    # Matplotlib's layout leaves no room for titles above axes without frames.
    figure.tight_layout(pad=0.4, rect=(0, 0, 1, 0.94))
    written = write_plot(options, "schemes", figure, "png", dpi=130)
    metadata = {"schemes": list(TITLES), "spp": options.spp}
    return written + write_pixels(options, "schemes", np.concatenate(panels, axis=1), metadata)
