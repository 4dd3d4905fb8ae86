"""Figures around an extraordinary point: refinement, domains and polynomials of a patch; curvature of surfaces."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, PowerNorm, SymLogNorm
from matplotlib.patches import Circle
from numpy.typing import NDArray

from ..cage.named_cages import extraordinary
from ..evaluation.element import element_stencils
from ..evaluation.irregular_patch import PIECE_LEVELS, IrregularPatch, level_domains, level_rows
from ..evaluation.patch_tree import irregular_patch, isolated_signature, patch_tree
from ..evaluation.polynomials import polynomial_basis
from ..mesh.connectivity import Topology
from ..mesh.one_ring import one_ring
from ..mesh.signature import Fan, Signature
from ..schemes import FloatArray, ParameterDomain, ParameterMap, Scheme, scheme_named
from ..surface import LimitSurface
from .output import SERIES, FigureOptions, hide_frame, label_powers, panels, write_figure
from .staging import around_vertices, frame, grid_points

SIDE_POINTS = 24  # Points along each side of a polygon, which the map bends
VALENCE, LEVELS = 5, 6
# Size of labels at level 0 in points per millimetre of the figure's width. Indices have 0.7 times the size.
LABEL_SIZE, LEAST_LABEL = 0.175, 8.6
# The irregular child is grey, as in the figure `subdivision`; all four differ in greyscale.
CHILD_COLOURS = ("#747b84", "#fcebbc", "#e39360", "#b3d3e0")
CONTROL_EDGE, NEW_EDGE = "#8d97a1", "#3f5b6b"
DECIMALS = 9  # Precision for equal stencils: their entries are fractions of small integers
VALENCES = (3, 4, 5, 4)  # Of the corners of the face of `tree`; two are extraordinary
# Colours of regular leaves and of leaves at each level around an extraordinary vertex; grey for deeper levels.
LEAF_COLOURS, REST = ("#fcfcd0", "#b9dfa8", "#63b7b3", "#2a7fb0"), "#8d97a1"
SLACK = 0.15  # Stiffness of springs along the edges of the face of `tree`, relative to other edges
LINE = "#2d3a45"


def patch_of_valence(scheme: Scheme, valence: int) -> IrregularPatch:
    """The patch with one extraordinary point, at (0, 0), amid regular faces and vertices."""
    if (patch := irregular_patch(scheme, isolated_signature(scheme, valence))) is None:
        raise ValueError(f"valence {valence} is regular; expected an extraordinary one")
    return patch


def characteristic_points(patch: IrregularPatch, valence: int) -> FloatArray:
    """Control points ``(K, 2)`` of the characteristic map; edges at (0, 0) are a regular star that begins along x."""
    points, turn = patch.basis.vectors[:, 1:3], 2 * np.pi / valence
    begin, end = on_patch(patch.scheme, patch.signature, points, patch.scheme.domain.corners[[1, -1]])
    star = np.array([(1, 0), (np.cos(turn), np.sin(turn))]).T
    return np.asarray(points @ (star @ np.linalg.inv(np.stack([begin, end], axis=1))).T)


def on_patch(scheme: Scheme, signature: Signature, points: FloatArray, uv: FloatArray) -> FloatArray:
    """Points of a signature's patch at parameters ``(s, 2)``, for control points in the plane."""
    return np.asarray(element_stencils(scheme, signature, uv)[0] @ points, dtype=np.float64)


def sector(points: FloatArray, index: int, valence: int) -> FloatArray:
    """Rotate points of the first patch around an extraordinary point at (0, 0) into the ``index``-th one."""
    turned = points @ (1, 1j) * np.exp(2j * np.pi * index / valence)
    return np.stack([turned.real, turned.imag], axis=1)


def outline(corners: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points along the sides of a polygon ``(m, 2)``, `SIDE_POINTS` on each."""
    return np.linspace(corners, np.roll(corners, -1, axis=0), SIDE_POINTS, endpoint=False, axis=1).reshape(-1, 2)


def sub_domain(domain: ParameterDomain, level: int, child: int) -> NDArray[np.float64]:
    """Corners ``(m, 2)`` of the parameters of a child of the ``level``-th refinement at (0, 0)."""
    outward = domain.children[child].inverse()
    for _ in range(level):
        outward = domain.children[0].inverse() @ outward
    return np.asarray(outward(domain.corners), dtype=np.float64)


def draw_domains(options: FigureOptions) -> list[Path]:
    """Draw the domains of the regular children at each level, and their images under the characteristic map."""
    scheme = scheme_named(options.scheme)
    patch = patch_of_valence(scheme, VALENCE)
    image = partial(on_patch, scheme, patch.signature, characteristic_points(patch, VALENCE))
    figure, axes = panels(options, 1, 2)
    flat, round_ = axes.flat
    # Light enough for black labels at every level.
    colours = matplotlib.colormaps["YlGnBu"](np.linspace(0.03, 0.75, LEVELS))

    for level in range(LEVELS):
        style = {"facecolor": colours[level], "edgecolor": LINE, "linewidth": max(0.6 * 0.8**level, 0.2)}
        size = options.width * LABEL_SIZE * 0.6**level
        for child in range(1, len(scheme.domain.children)):
            corners = sub_domain(scheme.domain, level, child)
            flat.fill(*corners.T, **style)
            if size > LEAST_LABEL:
                label = rf"$\Omega_{child}^{{{level}}}$"
                flat.text(*corners.mean(axis=0), label, fontsize=size, ha="center", va="center")
            for i in range(VALENCE):
                round_.fill(*sector(image(outline(corners)), i, VALENCE).T, **style)
    flat.fill(*sub_domain(scheme.domain, LEVELS - 1, 0).T, facecolor="#d9d9d9", edgecolor=LINE, linewidth=0.2)
    for axis in (flat, round_):
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
    return write_figure(options, "domains", figure, cage="none")


def refinement_step(patch: IrregularPatch, valence: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Control points ``(K, 2)`` of the characteristic map and ``(M, 2)`` of its children, and ends of their edges."""
    old = characteristic_points(patch, valence)
    stencils = np.unique(np.concatenate([patch.matrix, *patch.children]).round(DECIMALS), axis=0)
    ring = one_ring(patch.signature).topology
    refinement = patch.scheme.refine(ring)
    # Refined points without such a stencil belong to neighbouring patches.
    distance = np.abs(refinement.stencils.matrix.toarray()[:, None] - stencils).max(axis=2)
    needed = (distance < 10.0**-DECIMALS).any(axis=1)
    edges = refinement.topology.edge_ends
    new_edges = refinement.apply(old)[edges[needed[edges].all(axis=1)]]
    return old, stencils @ old, old[ring.edge_ends], new_edges


def draw_refinement(options: FigureOptions) -> list[Path]:
    """Draw the control points of a patch of valence 5 before and after one refinement."""
    patch = patch_of_valence(scheme_named("catmull_clark"), VALENCE)
    old, new, old_edges, new_edges = refinement_step(patch, VALENCE)
    image, domain = partial(on_patch, patch.scheme, patch.signature, old), patch.scheme.domain
    figure, ((before, after),) = panels(options, 1, 2)
    for axis in (before, after):
        axis.add_collection(LineCollection(list(old_edges), colors=CONTROL_EDGE, linewidths=0.6, zorder=1))
        axis.plot(*old.T, "o", color="black", markersize=4, zorder=4)
        hide_frame(axis)
    style = {"edgecolor": "#30363c", "linewidth": 0.7, "zorder": 2}
    label = {"fontsize": 9, "ha": "center", "va": "center", "zorder": 6}
    whole = image(outline(domain.corners))
    before.fill(*whole.T, facecolor=CHILD_COLOURS[0], **style)
    before.text(*whole.mean(axis=0), r"$\Omega$", **label)
    for k, colour in enumerate(CHILD_COLOURS):
        child = image(outline(sub_domain(domain, 0, k)))
        after.fill(*child.T, facecolor=colour, **style)
        after.text(*child.mean(axis=0), rf"$\Omega_{k}$", **label)
    after.add_collection(LineCollection(list(new_edges), colors=NEW_EDGE, linewidths=0.5, zorder=3))
    after.plot(*new.T, "o", mfc="white", mec="black", mew=0.6, markersize=3, zorder=5)
    before.set(title=f"a patch of valence {VALENCE}", xlabel=f"$K$ = {len(old)} control points")
    after.set(title="one refinement", xlabel=f"$M$ = {len(new)} new control points")
    return write_figure(options, "refinement", figure, cage="none")


def draw_tree(options: FigureOptions) -> list[Path]:
    """Draw a face with two extraordinary vertices, its leaves, and the weights of their Bernstein coefficients."""
    scheme = scheme_named("catmull_clark")
    signature = Signature("face", tuple(Fan((4,) * valence) for valence in VALENCES))
    tree, form, ring = patch_tree(scheme, signature), polynomial_basis(scheme), one_ring(signature)
    # Map from the parameters of each leaf to the face's; level, 0 for regular leaves; rows of weights
    leaves: list[tuple[ParameterMap, int, FloatArray]] = [
        (ParameterMap(*domain), 0, rows)
        for *domain, rows in zip(*tree.regular_domains, tree.coefficients(form.of_controls), strict=True)
    ]
    rests = []
    for tip in tree.tips:
        outward = tip.domain.inverse()
        for level in range(PIECE_LEVELS):
            rows = level_rows(tip.irregular_patch, level) @ tip.coordinates
            domains = level_domains(tip.irregular_patch, level)
            leaves += [(outward @ domain, level + 1, leaf) for domain, leaf in zip(domains, rows, strict=True)]
        rests.append(outward @ ParameterMap(np.eye(2) * 2.0**-PIECE_LEVELS, np.zeros(2)))
    count, size = ring.vertex_count, len(form.bernstein.indices)
    flat = _in_the_plane(ring.topology)
    image = partial(on_patch, scheme, signature, flat)
    figure, ((face, matrix),) = panels(options, 1, 2)
    face.add_collection(LineCollection(list(flat[ring.topology.edge_ends]), colors="#b6bec6", linewidths=0.6))
    face.plot(*flat.T, "o", color="black", markersize=3, zorder=4)
    around = outline(scheme.domain.corners)
    coloured = [(domain, LEAF_COLOURS[level]) for domain, level, _ in leaves] + [(rest, REST) for rest in rests]
    for domain, colour in coloured:
        face.fill(*image(np.clip(domain(around), 0, 1)).T, facecolor=colour, edgecolor=LINE, linewidth=0.4, zorder=2)
    face.plot(*image(np.stack([rest.offset for rest in rests])).T, "o", color="#c8432b", markersize=4, zorder=5)
    hide_frame(face)
    colours = f"$K$ = {count} control points\ngrey: (10) and (12); red: (13)"
    face.set(title="a face and its one-ring,\nleaves of its patch tree", xlabel=colours)
    weights = np.concatenate([rows for *_, rows in leaves])
    # Small weights are visible, too.
    matrix.imshow(weights, aspect="auto", cmap="Greys", norm=PowerNorm(0.5, 0, 1), interpolation="nearest")
    for number, (_, level, _) in enumerate(leaves):
        strip = {"xmin": -0.06, "xmax": -0.01, "clip_on": False, "linewidth": 0.2, "edgecolor": LINE}
        matrix.axhspan(size * number - 0.5, size * (number + 1) - 0.5, facecolor=LEAF_COLOURS[level], **strip)
        matrix.axhline(size * number - 0.5, color=LINE, linewidth=0.2)
    counts = f"$K$ = {count} control points\n{len(leaves)} leaves, {size} coefficients each"
    matrix.set(xticks=[], yticks=[], title="coefficients of all leaves =\nmatrix × control points", xlabel=counts)
    return write_figure(options, "tree", figure, cage="none")


def _in_the_plane(topology: Topology) -> FloatArray:
    """Control points of a one-ring in the plane: the border on a circle, other points amid their neighbours."""
    t = topology
    laplacian = t.laplacian().toarray()
    np.fill_diagonal(laplacian, 0)
    corners = t.face_vertices[: t.face_sizes[0]]  # Makes the face large
    laplacian[np.ix_(corners, corners)] *= SLACK
    np.fill_diagonal(laplacian, -laplacian.sum(axis=1))
    # Around the border, from any of its half-edges.
    start, end = t.face_vertices[t.twin < 0], t.face_vertices[t.next[t.twin < 0]]
    following = dict(zip(start.tolist(), end.tolist(), strict=True))
    border = [next(iter(following))]
    while (vertex := following[border[-1]]) != border[0]:
        border.append(vertex)
    angle = np.linspace(0, 2 * np.pi, len(border), endpoint=False)
    points = np.zeros((t.vertex_count, 2))
    points[border] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inner = np.setdiff1d(np.arange(t.vertex_count), border)
    points[inner] = np.linalg.solve(laplacian[np.ix_(inner, inner)], -laplacian[np.ix_(inner, border)] @ points[border])
    return points


CURVATURE_VALENCES = (3, 5, 8)  # Of the figure `curvature`
# The ball of `extraordinary` is bent by z += BEND (x^2 - y^2): principal curvatures of about 1 - 2 BEND and 1 + 2 BEND.
# Without the bend, the leading terms at the vertex would vanish by symmetry.
BEND = 0.35
# Radius of the discs in the tangent plane, relative to the largest disc in the elements at the vertex. Within MIDDLE of
# it, where curvature may be unbounded, values do not affect colours, and there are no lines.
RADIUS, MIDDLE = 0.95, 0.1
LINEAR = 0.2  # Colours are linear up to this part of the largest curvature, then logarithmic
# Lines of curvature relative to the largest, and a border of both signs just below zero, for flat surfaces without.
NEGATIVE = (-1 / 4, -1 / 16, -1e-3)
FLAT = 1e-9  # Curvature below this, in reciprocals of the disc's radius, is a rounding error
DEPTHS = np.arange(0, 41)
# Samples of each level for the plot: near the middles of the three regular children, but off their diagonals.
DIRECTIONS = np.array([(1.0, 0.3), (0.8, 0.7), (0.35, 1.0)])


def bent_ball(valence: int) -> LimitSurface:
    """The surface of the figure, with the valence at vertex 0 and elements 0 to ``valence - 1`` around it."""
    cage = extraordinary(valence)
    x, y, z = cage.positions.T
    return LimitSurface(cage.with_positions(np.stack([x, y, z + BEND * (x**2 - y**2)], axis=1)))


def growth(valence: int) -> float:
    """Growth of curvature per level near the point: ``|lambda_4| / lambda_2^2``."""
    patch = patch_of_valence(scheme_named("catmull_clark"), valence)
    return float(patch.basis.moduli[3] / patch.basis.subdominant**2)


def curvature_map(surface: LimitSurface, valence: int, count: int) -> NDArray[np.floating]:
    """Coordinates x and y in the tangent plane, Gaussian and mean curvature around vertex 0, ``(4, valence, n, n)``."""
    # From a thousandth of the element on, as the point itself has no useful curvature.
    uv = grid_points(np.concatenate([[0], np.geomspace(1e-3, 1, count)]))
    uv[0] = 1e-4
    samples = surface.evaluate(np.arange(valence)[:, None], uv, derivatives=2)
    point, axes, _ = frame(surface)
    x, y, _ = ((samples.p - point) @ axes).T
    # Positive where the surface bends inward, like a ball.
    gaussian, mean = np.asarray(samples.gaussian_curvature), np.asarray(samples.mean_curvature)
    return np.stack([x, y, gaussian, -mean]).reshape(4, valence, count + 1, count + 1)


def largest_by_level(surface: LimitSurface, valence: int) -> NDArray[np.float64]:
    """Largest absolute principal curvature of a few samples on each level: ``(levels,)``."""
    uv = (np.ldexp(1.0, -DEPTHS)[:, None, None] * DIRECTIONS).reshape(-1, 2)
    samples = surface.evaluate(np.arange(valence)[:, None], uv, derivatives=2)
    gaussian, mean = np.asarray(samples.gaussian_curvature), np.asarray(samples.mean_curvature)
    principal = np.abs(mean) + np.sqrt(np.maximum(mean**2 - gaussian, 0))
    return np.asarray(principal.reshape(valence, len(DEPTHS), -1).max(axis=(0, 2)))


def draw_curvature(options: FigureOptions) -> list[Path]:
    """Draw a row for each vertex: maps of Gaussian and mean curvature, and growth of curvature by level."""
    surfaces = {f"valence {valence}": bent_ball(valence) for valence in CURVATURE_VALENCES}
    if options.cage:
        cages = around_vertices(options.cage, len(CURVATURE_VALENCES))
        surfaces = {name: LimitSurface(cage) for name, cage in cages.items()}
    figure, axes = panels(options, len(surfaces), 3)
    numbers: list[tuple[object, ...]] = [("vertex", "level", "largest curvature", "by eigenvalues")]
    for (name, surface), (*discs, plot) in zip(surfaces.items(), axes, strict=True):
        valence = int(surface.cage.topology.vertex_face_count[0])
        x, y, *maps = curvature_map(surface, valence, max(options.resolution // 4, 8))
        away = np.hypot(x, y)
        radius = RADIUS * float(min(away[:, -1].min(), away[..., -1].min()))
        for axis, values, power in zip(discs, maps, (2, 1), strict=True):
            is_shown = (away > MIDDLE * radius) & (away < radius)
            largest = max(float(np.abs(values[is_shown]).max()), FLAT / radius**power)
            _draw_disc(axis, (x, y, values), float(f"{1.5 * largest:.0e}"), radius)
        discs[0].set(ylabel=name, xlabel=f"diameter {2 * radius:.2g} units")
        measured, rate = np.maximum(largest_by_level(surface, valence), FLAT / radius), growth(valence)
        grown = measured[-1] * rate ** (DEPTHS - DEPTHS[-1])
        plot.semilogy(DEPTHS, measured, "o", markersize=2, color=SERIES[1][0], label="surface")
        plot.semilogy(DEPTHS, grown, color=SERIES[0][0], label="(|λ₄|/λ₂²)ⁿ")
        plot.set(xlabel=f"level $n$, |λ₄|/λ₂² = {rate:.3f}", box_aspect=1)
        plot.grid()
        label_powers(plot.yaxis)
        numbers += [(name, *line) for line in zip(DEPTHS.tolist(), measured.tolist(), grown.tolist(), strict=True)]
    least, most = (np.log10(end([line[-2:] for line in numbers[1:]])) for end in (np.min, np.max))
    for plot in axes[:, 2]:
        plot.set_ylim(10 ** np.floor(least), 10 ** np.ceil(most))
        plot.minorticks_off()
    for axis, title in zip(axes[0], ("Gaussian", "mean", "largest"), strict=True):
        axis.set_title(f"{title} curvature\n1/unit{'²' * (title == 'Gaussian')}")
    axes[0, 2].legend(loc="upper left")
    cage = f"extraordinary(n), bent by z += {BEND} (x^2 - y^2)"
    return write_figure(options, "curvature", figure, cage=cage, numbers=numbers)


def _draw_disc(axis: Axes, grids: tuple[NDArray[np.floating], ...], largest: float, radius: float) -> None:
    """Draw values at x and y around the vertex in a disc, with a bar of their colours."""
    disc = Circle((0, 0), radius, facecolor="none", edgecolor="black", linewidth=0.5)
    axis.add_patch(disc)
    norm = SymLogNorm(LINEAR * largest, vmin=-largest, vmax=largest)
    for x, y, value in zip(*grids, strict=True):
        shown = axis.pcolormesh(x, y, value, norm=norm, cmap="PuOr_r", shading="gouraud", rasterized=True)
        shown.set_clip_path(disc)
        axis.plot(x[0], y[0], color="black", linewidth=0.3, alpha=0.6, clip_path=disc)
        # In greyscale, both ends of the colours are dark, so lines of negative curvature are dashed.
        lined = np.where(np.hypot(x, y) < MIDDLE * radius, np.nan, value)
        levels = largest * np.array(NEGATIVE)
        lines = axis.contour(x, y, lined, levels, colors="black", linewidths=0.4, linestyles=("--", "--", "-"))
        lines.set_clip_path(disc)
    axis.set(xlim=(-1.02 * radius, 1.02 * radius), ylim=(-1.02 * radius, 1.02 * radius))
    hide_frame(axis)
    ticks = [largest * part for part in (-1, -LINEAR, 0, LINEAR, 1)]
    bar = axis.figure.colorbar(shown, ax=axis, fraction=0.05, pad=0.02, aspect=25, extend="both")
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.minorticks_off()
