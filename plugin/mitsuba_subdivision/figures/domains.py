"""The nested parameter domains of the regular children, and their images around an extraordinary point."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import ListedColormap
from numpy.typing import NDArray

from ..schemes import scheme_named
from ..schemes.domain import ParameterDomain
from .characteristic import CharacteristicMap, outline, patch_of_valence
from .output import FigureOptions, hide_frame, panels, write_plot

LEVELS = 6
# Size of labels at level 0 in points, per millimetre of the figure's width; those of other levels are smaller, as
# their domains are. Indices are 0.7 times as large as labels, and 6 points at least.
LABEL_SIZE, LEAST_LABEL = 0.175, 8.6
VALENCE = 5


def sub_domain(domain: ParameterDomain, level: int, child: int) -> NDArray[np.float64]:
    """Corners ``(m, 2)`` of the parameters of child ``child`` of the ``level``-th refinement at (0, 0)."""
    corners = domain.children[child].inverse()(domain.corners)
    for _ in range(level):
        corners = domain.children[0].inverse()(corners)
    return np.asarray(corners, dtype=np.float64)


def draw(options: FigureOptions) -> list[Path]:
    """Draw the domains of the regular children at each level, and their images under the characteristic map."""
    scheme = scheme_named(options.scheme)
    patch = patch_of_valence(scheme, VALENCE)
    characteristic = CharacteristicMap(patch, VALENCE)
    figure, axes = panels(options, 1, 2)
    flat, round_ = axes.flat
    # Light enough at every level for black labels.
    colours = matplotlib.colormaps["YlGnBu"](np.linspace(0.03, 0.75, LEVELS))
    options.report(f"{scheme.name}: {LEVELS} levels, contraction {patch.basis.subdominant:.4f} at valence {VALENCE}")

    for level in range(LEVELS):
        style = {"facecolor": colours[level], "edgecolor": "#2d3a45", "linewidth": max(0.6 * 0.8**level, 0.2)}
        size = options.width * LABEL_SIZE * 0.6**level
        for child in range(1, len(scheme.domain.children)):
            corners = sub_domain(scheme.domain, level, child)
            flat.fill(*corners.T, **style)
            if size > LEAST_LABEL:
                label = rf"$\Omega_{child}^{{{level}}}$"
                flat.text(*corners.mean(axis=0), label, fontsize=size, ha="center", va="center")
            bent = characteristic(outline(corners))
            for sector in range(VALENCE):
                round_.fill(*characteristic.sector(bent, sector).T, **style)
    flat.fill(*sub_domain(scheme.domain, LEVELS - 1, 0).T, facecolor="#d9d9d9", edgecolor="#2d3a45", linewidth=0.2)
    for axis in (flat, round_):
        axis.set_aspect("equal")
        hide_frame(axis)
        axis.plot(0, 0, "o", color="#c8432b", clip_on=False, zorder=5)
        axis.margins(0.01)
    for axis, name in ((flat.xaxis, "u"), (flat.yaxis, "v")):
        axis.set_ticks([0, 0.5, 1], labels=["0", f"${name}$", "1"])
        axis.set_tick_params(length=0)
    flat.set_title("parameters:\neach level × 0.5")
    round_.set_title(f"characteristic map, valence {VALENCE}:\neach level × {patch.basis.subdominant:.3f}")
    scale = matplotlib.cm.ScalarMappable(cmap=ListedColormap(colours))
    scale.set_clim(-0.5, LEVELS - 0.5)
    bar = figure.colorbar(scale, ax=axes, orientation="horizontal", fraction=0.035, pad=0.02, aspect=45)
    bar.set_ticks(range(LEVELS))
    bar.ax.tick_params(length=0)
    bar.set_label("level $n$")
    name = "domains" if options.scheme == "catmull_clark" else f"domains_{options.scheme}"
    return write_plot(options, name, figure)
