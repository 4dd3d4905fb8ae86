"""The nested parameter domains of the regular children, and their images around an extraordinary point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..schemes import scheme_named
from ..schemes.domain import ParameterDomain
from .characteristic import CharacteristicMap, outline, patch_of_valence
from .output import FigureOptions, pyplot, write_plot

LEVELS = 6
# Labels get smaller with their domains; beyond this level they could not be read.
LABELLED = 4
VALENCE = 5


def sub_domain(domain: ParameterDomain, level: int, child: int) -> NDArray[np.float64]:
    """Corners ``(m, 2)`` of the parameters of child ``child`` of the ``level``-th refinement at (0, 0)."""
    corners = domain.children[child].inverse()(domain.corners)
    for _ in range(level):
        corners = domain.children[0].inverse()(corners)
    return np.asarray(corners, dtype=np.float64)


def draw(options: FigureOptions) -> list[Path]:
    """Draw the domains of the regular children at each level, and their images under the characteristic map."""
    plt = pyplot()
    scheme = scheme_named(options.scheme)
    patch = patch_of_valence(scheme, VALENCE)
    characteristic = CharacteristicMap(patch, VALENCE)
    figure, (flat, round_) = plt.subplots(1, 2, figsize=(9.6, 5.5), layout="constrained")
    # Light enough at every level for black labels.
    colours = plt.get_cmap("YlGnBu")(np.linspace(0.06, 0.62, LEVELS))
    options.report(f"{scheme.name}: {LEVELS} levels, contraction {patch.basis.subdominant:.4f} at valence {VALENCE}")

    for level in range(LEVELS):
        style = {"facecolor": colours[level], "edgecolor": "#2d3a45", "linewidth": max(1.3 * 0.8**level, 0.35)}
        for child in range(1, len(scheme.domain.children)):
            corners = sub_domain(scheme.domain, level, child)
            flat.fill(*corners.T, **style)
            if level < LABELLED:
                flat.text(
                    *corners.mean(axis=0), rf"$\Omega_{child}^{{{level}}}$", fontsize=26 * 0.6**level, ha="center",
                    va="center",
                )  # fmt: skip
            bent = characteristic(outline(corners))
            for sector in range(VALENCE):
                round_.fill(*characteristic.sector(bent, sector).T, **style)
    for rest, axis in ((scheme.domain.corners, flat), (None, round_)):
        axis.set_aspect("equal")
        axis.set_axis_off()
        if rest is None:
            axis.plot(0, 0, "o", color="#c8432b", markersize=3.5)
            continue
        innermost = sub_domain(scheme.domain, LEVELS - 1, 0)
        axis.fill(*innermost.T, facecolor="#d9d9d9", edgecolor="#2d3a45", linewidth=0.35)
        axis.plot(0, 0, "o", color="#c8432b", markersize=5, clip_on=False, zorder=5)
        for position, text, align in (((0.5, -0.045), "u", "center"), ((-0.045, 0.5), "v", "center")):
            axis.text(*position, f"${text}$", fontsize=13, ha=align, va="center")
        for end in (0, 1):
            axis.text(end, -0.045, f"{end}", ha="center", va="center")
            axis.text(-0.035, end, f"{end}", ha="center", va="center")
        axis.set_xlim(-0.09, 1.02)
        axis.set_ylim(-0.09, 1.02)
    flat.set_title(r"parameters: each level $\times$ 0.5", fontsize=11)
    round_.set_title(
        rf"characteristic map, valence {VALENCE}: each level $\times$ {patch.basis.subdominant:.3f}",
        fontsize=11,
    )
    scale = plt.cm.ScalarMappable(cmap=_steps(colours))
    scale.set_clim(-0.5, LEVELS - 0.5)
    bar = figure.colorbar(scale, ax=[flat, round_], orientation="horizontal", fraction=0.035, pad=0.02, aspect=45)
    bar.set_ticks(range(LEVELS))
    bar.ax.tick_params(length=0)
    bar.set_label("level $n$")
    # Matplotlib's layout leaves no room for titles above axes without frames.
    figure.get_layout_engine().set(rect=(0, 0, 1, 0.97))
    name = "domains" if options.scheme == "catmull_clark" else f"domains_{options.scheme}"
    return write_plot(options, name, figure, "png", "pdf")


def _steps(colours: NDArray[np.float64]) -> Any:
    """A colour map of a few discrete colours."""
    from matplotlib.colors import ListedColormap

    return ListedColormap(colours)
