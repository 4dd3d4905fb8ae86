"""Renders of one scene with different parameters, side by side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .figure_scenes import in_8_bits, load_stage, render
from .output import FigureOptions, panels, show, write_pixels, write_plot


def draw_row(
    options: FigureOptions, name: str, cases: Mapping[str, Mapping[str, Any]], metadata: dict[str, Any]
) -> list[Path]:
    """Render a scene once for each panel.

    Parameters
    ----------
    name : str
        Of the scene and of the figure.
    cases : mapping of str to mapping
        By the title of each panel, the parameters of the scene; a second line of the title stands below the panel.
    metadata : dict
        For the figure's pixels, besides the samples.
    """
    figure, axes = panels(options, 1, len(cases))
    rendered = []
    for (title, parameters), axis in zip(cases.items(), axes.flat, strict=True):
        name_of_part, _, caption = title.partition("\n")
        options.report(title.replace("\n", ", "))
        scene = load_stage(name, **parameters, resolution=options.resolution)
        rendered.append(render(scene, options, name_of_part)[..., :3])
        show(axis, in_8_bits(rendered[-1]), name_of_part, caption)
    pixels = np.concatenate(rendered, axis=1)
    return write_plot(options, name, figure) + write_pixels(options, name, pixels, {**metadata, "spp": options.spp})
