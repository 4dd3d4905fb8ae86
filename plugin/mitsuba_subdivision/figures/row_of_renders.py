"""Renders of one scene with different parameters, side by side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .figure_scenes import in_8_bits, load_stage, render
from .output import FigureOptions, pyplot, write_pixels, write_plot


def draw_row(
    options: FigureOptions, name: str, panels: Mapping[str, Mapping[str, Any]], metadata: dict[str, Any]
) -> list[Path]:
    """Render a scene once for each panel.

    Parameters
    ----------
    options : FigureOptions
    name : str
        Of the scene and of the figure.
    panels : mapping of str to mapping
        By their titles, the parameters of the scene.
    metadata : dict
        For the figure's pixels, besides the samples.
    """
    plt = pyplot()
    figure, axes = plt.subplots(1, len(panels), figsize=(9.6, 3.45))
    rendered = []
    for (title, parameters), axis in zip(panels.items(), axes, strict=True):
        options.report(title)
        scene = load_stage(name, **parameters, resolution=options.resolution)
        pixels = render(scene, options, title)[..., :3]
        rendered.append(pixels)
        axis.imshow(in_8_bits(pixels), interpolation="lanczos")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    # Matplotlib's layout leaves no room for titles above axes without frames.
    figure.tight_layout(pad=0.4, rect=(0, 0, 1, 0.94))
    written = write_plot(options, name, figure, "png", dpi=130)
    return written + write_pixels(options, name, np.concatenate(rendered, axis=1), {**metadata, "spp": options.spp})
