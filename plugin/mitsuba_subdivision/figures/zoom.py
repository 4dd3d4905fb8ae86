"""The surface at an extraordinary vertex, magnified up to a million times, with normals in float32.

The normals come from Stam's form (11), from the stabilised form (12), and from OpenSubdiv, where the program `osd_peer`
is found.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar  # type: ignore[import-untyped]
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..cage.named_cages import extraordinary
from ..evaluation.equations import Evaluator
from ..regression.tiers import normal_angle
from ..schemes import scheme_named
from ..schemes.domain import FloatArray
from ..surface import LimitSurface
from .characteristic import patch_of_valence
from .normal_error import EQUATIONS, offset_cage
from .output import FigureError, FigureOptions, label_powers, panels, scientific, write_figure
from .peers import osd_peer, osd_samples
from .staging import grid_points, grid_triangles, in_8_bits, load_stage, make_mesh, project, render, staged
from .user_cage import frame

VALENCE = 5
OFFSET = 10
MAGNIFICATIONS = (1, 100, 10_000, 1_000_000)
Method = Evaluator | Literal["opensubdiv"]
EVALUATORS: tuple[Evaluator, Evaluator] = ("stam", "stabilized")
# The deepest level at which OpenSubdiv's patch tables can isolate extraordinary vertices.
OPENSUBDIV: Literal["opensubdiv"] = "opensubdiv"
OPENSUBDIV_LEVEL = 10
LABELS: dict[str, str] = {
    **{str(evaluator): EQUATIONS[evaluator] for evaluator in EVALUATORS},
    OPENSUBDIV: f"OpenSubdiv\nlevel {OPENSUBDIV_LEVEL}",
}
# Half the width of the image at magnification 1: the elements at the point just fill it. The cage has the radius 1.
HALF_WIDTH = 0.19
BAR = 0.1
# Range of the colours in degrees. Below the least error, float32 cannot tell most unit vectors from the exact ones.
LEAST_ERROR, MOST_ERROR = 1e-6, 100
COLOURS, ERROR_SCALE = "YlOrRd", LogNorm(LEAST_ERROR, MOST_ERROR, clip=True)
LINE_POINTS = 33
CLAY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.72, 0.66, 0.58]}}


def on_stage(surface: LimitSurface, points: NDArray[np.floating], magnification: float) -> NDArray[np.float64]:
    """Points on the stage, seen along the normal of vertex 0, where the image reaches from -1 to 1."""
    point, axes, _ = frame(surface)
    return (points - point) @ axes * (magnification / HALF_WIDTH)


def draw(options: FigureOptions) -> list[Path]:
    """Draw the neighbourhood of a vertex of valence 5 at four magnifications, with normals by (11) and by (12).

    The left half of each panel is rendered. In the right half, colour shows the angle between the normals and the exact
    normals: most of these angles are too small for a visible change of shade.

    The surface is sampled anew for every panel. Its normals are evaluated in float32. The positions of the samples come
    from float64: this far from the origin, float32 cannot tell the points of the last panels apart. OpenSubdiv's
    normals come from its patch tables (Far), where its program is found.
    """
    surface = LimitSurface(offset_cage(extraordinary(VALENCE), OFFSET))
    stage, resolution = load_stage("zoom", resolution=options.resolution), options.resolution
    sensor, count = stage.sensors()[0], max(resolution // 2, 8)
    triangles = grid_triangles(count, VALENCE)
    rows = (EVALUATORS[0], OPENSUBDIV, EVALUATORS[1]) if osd_peer() else EVALUATORS
    figure, axes = panels(options, len(rows), len(MAGNIFICATIONS))
    rendered, records = [], []
    for magnification, column in zip(MAGNIFICATIONS, axes.T, strict=True):
        uv, positions, exact = sample(surface, magnification, count)
        # Of all elements' samples, the one that is nearest to the centre of each pixel, ``(height, width)``.
        points = positions.reshape(-1, 3)
        centres = grid_points(np.arange(resolution) + 0.5).reshape(resolution, -1, 2)
        nearest = np.asarray(cKDTree(project(sensor, points, resolution)).query(centres)[1])
        lines = project(sensor, _level_lines(surface, magnification), resolution)
        for evaluator, axis in zip(rows, column, strict=True):
            normals, errors, median = normals_by(surface, uv, positions, exact, evaluator)
            mesh = make_mesh(points, triangles, CLAY, normals=(normals @ frame(surface)[1]).reshape(-1, 3))
            name = f"{LABELS[evaluator]}, x {magnification}".replace("\n", ", ")
            options.report(f"{name}: median normal error {median:.1e} degrees")
            rendered.append(render(staged(stage, mesh=mesh), options, name))
            _draw_halves(axis, rendered[-1], errors.ravel()[nearest], lines)
            axis.set_xlabel(_degrees(median))
            # The length of the scale bar is one on the surface, whose cage has the radius 1.
            length = BAR / HALF_WIDTH / 2 * resolution
            bar = AnchoredSizeBar(axis.transData, length, scientific(BAR / magnification), "lower left", pad=0.2, sep=2)
            bar.patch.set(alpha=0.85, linewidth=0)
            axis.add_artist(bar)
            records.append({"evaluator": evaluator, "magnification": magnification, "error": median})
        column[0].set_title(f"× {scientific(magnification)}\nu, v < {scientific(parameter_extent(magnification))}")
    for axis, evaluator in zip(axes[:, 0], rows, strict=True):
        axis.set_ylabel(LABELS[evaluator])
    scale = ScalarMappable(ERROR_SCALE, COLOURS)
    colours = figure.colorbar(scale, ax=axes, fraction=0.03, pad=0.01, aspect=45, extend="both")
    colours.set_label("error of the normal in degrees; medians below panels")
    label_powers(colours.ax.yaxis)
    strips = [pixels for i in range(len(rows)) for pixels in rendered[i :: len(rows)]]
    count = len(MAGNIFICATIONS)
    return write_figure(options, "zoom", figure, strips, per_row=count, pictures=records, offset=OFFSET)


def parameter_extent(magnification: float) -> float:
    """Largest u and v that a panel shows: distances from the point are proportional to ``u ** -log2(lambda_2)``."""
    patch = patch_of_valence(scheme_named("catmull_clark"), VALENCE)
    return float(magnification ** (1 / np.log2(patch.basis.subdominant)))


def sample(surface: LimitSurface, magnification: float, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sample a grid of ``count`` segments along each side in every element at the point, as far as a panel shows.

    Returns parameters ``(s, 2)``, the same in each element; and positions on the stage and normals of exact arithmetic,
    ``(valence, s, 3)`` each.
    """
    uv = grid_points(np.linspace(0, 1, count + 1))
    # Stam's form has no value at the point itself.
    uv[0] = 0.1 / count
    uv *= parameter_extent(magnification)
    exact = surface.evaluate(np.arange(VALENCE)[:, None], uv)
    shape = VALENCE, len(uv), 3
    return uv, on_stage(surface, exact.p, magnification).reshape(shape), exact.n.reshape(shape)


def normals_by(
    surface: LimitSurface,
    # As `sample` returns them
    uv: FloatArray,
    positions: FloatArray,
    exact: FloatArray,
    evaluator: Method,
) -> tuple[FloatArray, FloatArray, float]:
    """Normals by one of our evaluators or by OpenSubdiv, both in float32, ``(valence, s, 3)``.

    Returns besides their angles to the exact normals in degrees ``(valence, s)``, and the median of those inside the
    image.
    """
    elements = np.arange(VALENCE)[:, None]
    if evaluator == OPENSUBDIV:
        program = osd_peer()
        if program is None:
            raise FigureError("the program osd_peer is gone; expected it where it was found before")
        normals = osd_samples(program, surface.cage, elements, uv, "far", OPENSUBDIV_LEVEL)[1]
    else:
        normals = surface.evaluate(elements, uv, evaluator=evaluator, dtype=np.float32).n.astype(np.float64)
    normals = np.nan_to_num(normals).reshape(exact.shape)
    # Where derivatives are parallel or vanish, there is no normal. That counts as the largest error.
    angle = np.where(normals.any(axis=-1), normal_angle(normals, exact), 180)
    inside = np.abs(positions[..., :2]).max(axis=-1) < 1
    return normals, angle, float(np.median(angle[inside]))


def _level_lines(surface: LimitSurface, magnification: float) -> NDArray[np.float64]:
    """Edges of the elements at the point and of their children, on the stage: ``(lines, points, 3)``."""
    along = np.linspace(0, 1, LINE_POINTS)
    line = np.stack([np.ones_like(along), along], axis=1)
    extent = parameter_extent(magnification)
    # The lines u = 1/2^n and v = 1/2^n of every level n that the image resolves.
    first = int(np.floor(-np.log2(extent))) - 1
    curves = []
    for level in range(max(first, 0), first + 7):
        curves += [line * 2.0**-level, line[:, ::-1] * 2.0**-level]
    curves.append(np.stack([along, np.zeros_like(along)], axis=1) * extent)
    points = surface.evaluate(np.arange(VALENCE)[:, None], np.concatenate(curves)).p
    return on_stage(surface, points, magnification).reshape(-1, LINE_POINTS, 3)


def _draw_halves(axis: Axes, pixels: NDArray[np.float32], errors: FloatArray, lines: FloatArray) -> None:
    """Draw a rendered image, errors in degrees over its right half, and lines in pixels over both."""
    height, width = errors.shape
    axis.imshow(in_8_bits(pixels), interpolation="lanczos")
    right = (width // 2, width, height, 0)
    axis.imshow(errors[:, width // 2 :], cmap=COLOURS, norm=ERROR_SCALE, interpolation="nearest", extent=right)
    axis.add_collection(LineCollection(list(lines), colors="black", linewidths=0.3, alpha=0.6))
    axis.axvline(width / 2, color="white")
    axis.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])


def _degrees(error: float) -> str:
    if error < LEAST_ERROR:
        return f"< {scientific(LEAST_ERROR)}°"
    return f"{scientific(error)}°" if error < 0.01 else f"{error:.1g}°" if error < 1 else f"{error:.0f}°"
