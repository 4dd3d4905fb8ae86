"""Gaussian and mean curvature around extraordinary vertices, where those of Catmull-Clark surfaces do not converge."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.patches import Circle
from numpy.typing import NDArray

from ..cage.named_cages import extraordinary
from ..schemes import scheme_named
from ..surface import LimitSurface
from .characteristic import patch_of_valence
from .output import SERIES, FigureOptions, hide_frame, label_powers, panels, write_figure
from .staging import grid_points
from .user_cage import around_vertices, frame

VALENCES = (3, 5, 8)
# The ball of `extraordinary` is bent by z += BEND (x^2 - y^2): principal curvatures of about 1 - 2 BEND and 1 + 2 BEND.
# Without the bend, the symmetry of the ball would make the leading terms at the vertex vanish.
BEND = 0.35
# Radius of the discs, in the tangent plane.
RADIUS = 0.21
# Curvature beyond LIMIT is drawn in the last colour. Colours are linear up to LINEAR, then logarithmic.
LIMIT, LINEAR = 8.0, 1.0
# Lines of equal curvature, up to the border between both signs.
NEGATIVE = (-2, -0.5, 0)
LEVELS = np.arange(0, 41)
# Samples of each level for the plot: near the middles of the three regular children, off their diagonals.
DIRECTIONS = np.array([(1.0, 0.3), (0.8, 0.7), (0.35, 1.0)])


def bent_ball(valence: int) -> LimitSurface:
    """The surface of the figure. Vertex 0 has the valence, and elements 0 to ``valence - 1`` lie around it."""
    cage = extraordinary(valence)
    x, y, z = cage.positions.T
    return LimitSurface(cage.with_positions(np.stack([x, y, z + BEND * (x**2 - y**2)], axis=1)))


def growth(valence: int) -> float:
    """Factor by which curvature grows from level to level near the point: ``|lambda_4| / lambda_2^2``."""
    patch = patch_of_valence(scheme_named("catmull_clark"), valence)
    return float(patch.basis.moduli[3] / patch.basis.subdominant**2)


def curvature_map(surface: LimitSurface, valence: int, count: int) -> NDArray[np.floating]:
    """Sample the elements around vertex 0, more densely towards it.

    Returns x and y in the tangent plane, Gaussian and mean curvature, of a grid in each element, (4, valence, n, n);
    mean curvature is positive where the surface bends inward, as on a ball.
    """
    # From a thousandth of the element on. The point itself has no curvature, or one of no interest.
    uv = grid_points(np.concatenate([[0], np.geomspace(1e-3, 1, count)]))
    uv[0] = 1e-4
    points, gaussian, mean = _curvatures(surface, uv, valence)
    x, y, _ = (points - surface.evaluate(0, [[0, 0]]).p[0]).T
    return np.stack([x, y, gaussian, -mean]).reshape(4, valence, count + 1, count + 1)


def _curvatures(surface: LimitSurface, uv: NDArray[np.float64], valence: int) -> tuple[NDArray[np.floating], ...]:
    """Points, Gaussian and mean curvature at parameters in each of the first elements."""
    samples = surface.evaluate(np.arange(valence)[:, None], uv, derivatives=2)
    return samples.p, np.asarray(samples.gaussian_curvature), np.asarray(samples.mean_curvature)


def largest_by_level(surface: LimitSurface, valence: int) -> NDArray[np.float64]:
    """Largest absolute principal curvature of a few samples on each level: ``(levels,)``."""
    uv = (np.ldexp(1.0, -LEVELS)[:, None, None] * DIRECTIONS).reshape(-1, 2)
    _, gaussian, mean = _curvatures(surface, uv, valence)
    principal = np.abs(mean) + np.sqrt(np.maximum(mean**2 - gaussian, 0))
    return np.asarray(principal.reshape(valence, len(LEVELS), -1).max(axis=(0, 2)))


def draw(options: FigureOptions) -> list[Path]:
    """Draw maps of Gaussian and mean curvature at valences 3, 5 and 8, and its growth from level to level."""
    surfaces = {valence: bent_ball(valence) for valence in VALENCES}
    if options.cage:
        cages = around_vertices(options.cage, len(VALENCES), frame(bent_ball(5)))
        surfaces = {valence: LimitSurface(cage) for valence, cage in cages.items()}
    figure, axes = panels(options, 3, len(surfaces), sharey="row")
    norm = SymLogNorm(LINEAR, vmin=-LIMIT, vmax=LIMIT)
    for (valence, surface), column in zip(surfaces.items(), axes.T, strict=True):
        grids, rate = curvature_map(surface, valence, max(options.resolution // 4, 8)), growth(valence)
        measured = largest_by_level(surface, valence)
        options.report(f"valence {valence}: {rate:.4f} per level; largest at level {LEVELS[-1]} {measured[-1]:.3g}")
        for axis, values in zip(column, grids[2:], strict=False):
            shown = _draw_disc(axis, zip(*grids[:2], values, strict=True), norm)
        plot = column[-1]
        plot.semilogy(LEVELS, measured, "o", markersize=2, color=SERIES[1][0], label="surface")
        plot.semilogy(LEVELS, measured[-1] * rate ** (LEVELS - LEVELS[-1]), color=SERIES[0][0], label="(|λ₄|/λ₂²)ⁿ")
        column[0].set_title(f"valence {valence}")
        plot.set(xlabel=f"level $n$\n|λ₄|/λ₂² = {rate:.3f}", ylim=(0.3, 1e6), box_aspect=0.75)
        plot.grid()
        label_powers(plot.yaxis)
    for axis, name in zip(axes[:, 0], ("Gaussian", "mean"), strict=False):
        axis.set_ylabel(name)
    bar = figure.colorbar(shown, ax=axes[:2], fraction=0.03, pad=0.01, extend="both", shrink=0.8)
    ticks = [-LIMIT, -2, 0, 2, LIMIT]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.minorticks_off()
    bar.set_label("curvature")
    axes[2, 0].set_ylabel("largest curvature")
    figure.legend(*plot.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return write_figure(options, "curvature", figure)


def _draw_disc(axis: Axes, grids: Iterable[tuple[NDArray[np.floating], ...]], norm: Any) -> Any:
    """Draw values at x and y in a disc around the vertex; returns the last grid drawn, for the colour bar."""
    disc = Circle((0, 0), RADIUS, facecolor="none", edgecolor="black", linewidth=0.5)
    axis.add_patch(disc)
    for x, y, value in grids:
        shown = axis.pcolormesh(x, y, value, norm=norm, cmap="RdBu_r", shading="gouraud", rasterized=True)
        shown.set_clip_path(disc)
        (edge,) = axis.plot(x[0], y[0], color="black", linewidth=0.3, alpha=0.6)
        edge.set_clip_path(disc)
        # In grey, both ends of the colours are dark: lines of negative curvature are dashed.
        axis.contour(x, y, value, levels=NEGATIVE, colors="black", linewidths=0.4).set_clip_path(disc)
    axis.set(aspect="equal", xlim=(-1.02 * RADIUS, 1.02 * RADIUS), ylim=(-1.02 * RADIUS, 1.02 * RADIUS))
    hide_frame(axis)
    return shown
