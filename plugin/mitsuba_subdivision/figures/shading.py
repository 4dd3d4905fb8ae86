"""Brushed metal with normals of vertices, and with those of the surface at every hit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .output import FigureOptions, pyplot, write_pixels, write_plot
from .staging import in_8_bits, load_stage, render

PANELS = (("vertex", 2), ("vertex", 8), ("exact", 2))
TITLES = {"vertex": "normals of vertices", "exact": "exact at every hit"}


def draw(options: FigureOptions) -> list[Path]:
    """Render one scene by both kinds of shading, side by side."""
    plt = pyplot()
    figure, axes = plt.subplots(1, len(PANELS), figsize=(9.6, 3.45))
    panels = []
    for (shading, rate), axis in zip(PANELS, axes, strict=True):
        title = f"{TITLES[shading]}, {rate} segments per edge"
        options.report(title)
        scene = load_stage("shading", shading=shading, rate=rate, resolution=options.resolution)
        pixels = render(scene, options, title)[..., :3]
        panels.append(pixels)
        axis.imshow(in_8_bits(pixels), interpolation="lanczos")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    # Matplotlib's layout leaves no room for titles above axes without frames.
    figure.tight_layout(pad=0.4, rect=(0, 0, 1, 0.94))
    written = write_plot(options, "shading", figure, "png", dpi=130)
    metadata = {"shading": [shading for shading, _ in PANELS], "rate": [rate for _, rate in PANELS], "spp": options.spp}
    return written + write_pixels(options, "shading", np.concatenate(panels, axis=1), metadata)
