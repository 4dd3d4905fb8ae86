"""Normals at extraordinary vertices by equations (11), (12) and (13): rendered, plotted and magnified."""

from __future__ import annotations

from decimal import Decimal, localcontext
from pathlib import Path
from typing import Any, Literal

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar  # type: ignore[import-untyped]
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .. import example_file
from ..cage import ControlCage, extraordinary
from ..evaluation.equations import AT_EXTRAORDINARY_POINT, Evaluator
from ..mesh.one_ring import RingTable, one_ring
from ..mitsuba_mesh import points_at
from ..regression.tiers import normal_angle
from ..schemes import FloatArray, scheme_named
from ..surface import LimitSurface
from ..tessellation.vertex_table import Tessellation
from . import staging
from .cages import edge_curves
from .characteristic import patch_of_valence
from .output import BETWEEN, SERIES, FigureError, FigureOptions, label_powers, panels, scientific, show, write_figure
from .peers import osd_peer, osd_samples

# Radius around the extraordinary vertex in which vertices show normals, and length of these needles.
NEEDLE_RADIUS, NEEDLE_LENGTH = 0.3, 0.07
EDGE_RADIUS = 0.8  # Radius around the extraordinary vertex in which edges of the cage are drawn
LOST = 2.0**-23 / 3  # lambda_2^n at the sample of a user's cage: eps |c1| / lambda_2^n is 30
DISTANCE = 10  # From the origin to the extraordinary point
CLAY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.72, 0.66, 0.58]}}
TURNS = Rotation.random(20, random_state=19).as_matrix()  # Rotations of the figures' own cages
# u = v of the sample at the extraordinary point, and tessellation rate, by scheme and valence. At |c1| = 10 and about
# these u = v, float32 loses the normal: its error is about eps |c1| / lambda_2^n, where the subdominant eigenvalues are
# 0.41 and 0.55 (Catmull-Clark), 0.25 and 0.45 (Loop), 0.5 (Doo-Sabin). For smaller ones, samples of the same u and v
# are closer to the point. The rates make triangles there about equally large.
ROWS = {
    ("catmull_clark", 3): (1e-6, 3), ("catmull_clark", 5): (1e-8, 4),
    ("loop", 3): (1e-4, 2), ("loop", 5): (1e-7, 4),
    ("doo_sabin", 3): (1e-7, 4), ("doo_sabin", 5): (1e-7, 4),
}  # fmt: skip
# Title, evaluator, and whether samples lie beside the extraordinary point; all in float32.
RULES: tuple[tuple[str, Evaluator, bool], ...] = (
    ("Stam's form (11)", "stam", True),
    ("stabilised (12)", "stabilized", True),
    ("at the point (13)", "stabilized", False),
)


def surface_of(scheme: str, valence: int) -> LimitSurface:
    """The surface of a scene. Its extraordinary point is corner 0 of element 0, and vertex 0 of a tessellation."""
    prefix = {"catmull_clark": "valence", "loop": "loop_valence", "doo_sabin": "doo_sabin_face"}[scheme]
    return LimitSurface(ControlCage.from_file(example_file(f"cages/{prefix}{valence}.obj")), scheme)


def vertex_normal(surface: LimitSurface, evaluator: Evaluator, offset: float) -> tuple[int | None, float, float]:
    """Level (None at the point itself), |c1|, and error of the float32 normal in degrees at ``u = v = offset``."""
    uv = np.full((1, 2), offset)
    single = surface.evaluate(0, uv, evaluator=evaluator, dtype=np.float32)
    double = surface.evaluate(0, uv)
    level = None if single.level[0] == AT_EXTRAORDINARY_POINT else int(single.level[0])
    limit = surface.evaluate(0, np.zeros((1, 2))).p[0]
    return level, float(np.linalg.norm(limit)), float(normal_angle(single.n[0], double.n[0]))


def turned(cage: ControlCage) -> list[ControlCage]:
    """The cage in several rotations. Unrotated, zeros of its symmetry may hide errors."""
    return [cage.with_positions(cage.positions @ turn.T) for turn in TURNS]


def of_user(path: Path, scheme: str, most: int) -> dict[str, list[ControlCage]]:
    """A user's cage for each of its vertices, unrotated, with edges at the vertex as long as the figures' own."""
    if scheme != "catmull_clark":
        raise FigureError(f"--cage together with --scheme {scheme}; expected catmull_clark")
    length = staging.frame(surface_of(scheme, 5))[2]
    return {
        name: [cage.with_positions(cage.positions * (length / staging.frame(LimitSurface(cage))[2]))]
        for name, cage in staging.around_vertices(path, most).items()
    }


def error_at_vertex(surface: LimitSurface, rate: int, evaluator: Evaluator, offset: float) -> float:
    """Error in degrees of the rendered normal of vertex 0."""
    normal = surface.tessellate(rate, evaluator, np.float32, offset).normals[0]
    return float(normal_angle(normal, surface.evaluate(0, np.full((1, 2), offset)).n[0]))


def draw_artifact(options: FigureOptions) -> list[Path]:
    """Render valences 3 and 5 with vertex normals by (11), (12) and (13), the only difference of the columns."""
    scheme, (_, rate) = options.scheme, ROWS[options.scheme, 5]
    rows = {f"valence {n}": (turned(surface_of(scheme, n).cage), *ROWS[scheme, n]) for n in VALENCES}
    if options.cage:
        own = of_user(options.cage, scheme, len(VALENCES))
        rows = {name: (cages, _lost_at(cages[0]), rate) for name, cages in own.items()}
    figure, axes = panels(options, len(rows), len(RULES))
    stage, place = staging.load_stage("artifact", resolution=options.resolution), staging.frame(surface_of(scheme, 5))
    rendered, records = [], []
    for (name, (cages, beside, rate)), row_axes in zip(rows.items(), axes, strict=True):
        surfaces = [LimitSurface(offset_cage(cage, DISTANCE, scheme), scheme) for cage in cages]
        surfaces.sort(key=lambda surface: error_at_vertex(surface, rate, "stam", beside))
        # Errors of this cage, which its transform moves to the camera.
        shown = surfaces[len(surfaces) // 2]
        to_world = staging.motion(here := staging.frame(shown), (*place[:2], here[2]))
        common = {"scheme": scheme, "to_world": mi.ScalarTransform4f(to_world.tolist())}
        for (title, evaluator, is_beside), axis in zip(RULES, row_axes, strict=True):
            offset = beside if is_beside else 0.0
            level, *_ = vertex_normal(shown, evaluator, offset)
            errors = [error_at_vertex(surface, rate, evaluator, offset) for surface in surfaces]
            error = errors[len(surfaces) // 2]
            location = "u = v = 0" if level is None else f"u = v = {scientific(offset)}, n = {level}"
            of_all = f"; in {len(errors)} turns up to {_degrees(max(errors))}" if len(errors) > 1 else ""
            sampling = {**common, "evaluator": evaluator, "sample_offset": offset}
            scene = staging.staged(stage, surface=staging.limit_surface(shown.cage, rate, CLAY, **sampling))
            rendered.append(staging.render(scene, options, f"{name}, {title}"))
            show(axis, staging.on_white(rendered[-1]), caption=f"{location}\nerror {_degrees(error)}{of_all}")
            axis.set_title(title if name == next(iter(rows)) else "")
            triangles = shown.tessellate(rate, evaluator, np.float32, offset)
            _draw_lines(axis, stage.sensors()[0], shown, triangles, to_world)
            records.append({"vertex": name, "rule": title, "level": level, "error": error})
        row_axes[0].set_ylabel(f"{name}, |c₁| = {DISTANCE}")
    cage = "extraordinary vertices of the folder cages, turned at random"
    return write_figure(options, "artifact", figure, rendered, cage=cage, per_row=len(RULES), pictures=records)


def _lost_at(cage: ControlCage) -> float:
    """The u = v at which Stam's form loses the normal, at |c1| = 10 as in `ROWS`."""
    patch = patch_of_valence(scheme_named("catmull_clark"), int(cage.topology.vertex_face_count[0]))
    return float(f"{0.5 ** (np.log(LOST) / np.log(patch.basis.subdominant)):.0e}")


def _draw_lines(axis: Axes, sensor: mi.Sensor, surface: LimitSurface, mesh: Tessellation, to_world: FloatArray) -> None:
    near = np.flatnonzero(np.linalg.norm(mesh.positions - mesh.positions[0], axis=1) < NEEDLE_RADIUS)
    start = mesh.positions[near].astype(np.float64)
    needles = np.stack([start, start + NEEDLE_LENGTH * mesh.normals[near]], axis=1)
    edges = edge_curves(surface, np.arange(surface.patches.elements.half_edge_count), 16)
    edges = edges[np.linalg.norm(edges[:, 0] - edges[0, 0], axis=1) < EDGE_RADIUS]
    width, height = sensor.film().crop_size()
    axis.set(xlim=(0, width), ylim=(height, 0))
    needles, edges = (staging.project(sensor, points_at(points, to_world)) for points in (needles, edges))
    first, *others = needles  # The first needle is that of the extraordinary vertex
    axis.add_collection(LineCollection(list(edges), colors="#40362a", linewidths=0.3, alpha=0.4))
    axis.add_collection(LineCollection(others, colors="#1c4f72", linewidths=0.6, capstyle="round"))
    axis.add_collection(LineCollection([first], colors="#d8452a", linewidths=1.5, capstyle="round"))


# Panels and levels of the figure `error`.
VALENCES, OFFSETS = (3, 5), (0, 1, 100)
LEVELS = np.arange(61)
# Parameter directions of the samples of a level: one in each regular child, and one between two of them.
DIRECTIONS = np.array([(1.0, 0.25), (0.75, 0.75), (0.25, 0.75), (1.0, 0.5)])
# Digits of the exact arithmetic: differences at level 60, about 0.41^60 = 1e-23, keep at least twenty digits.
DIGITS = 60
EQUATIONS: dict[Evaluator, str] = {"stam": "(11) Stam", "stabilized": "(12) stabilised", "limit": "(13) limit"}
PRECISIONS = {np.float32: "-", np.float64: "--"}
MARKED = 10  # Levels between the markers of a line


def draw_error(options: FigureOptions) -> list[Path]:
    """Plot the angle between computed and exact normals at every level."""
    cages = {f"valence {valence}": turned(extraordinary(valence)) for valence in VALENCES}
    if options.cage:
        cages = of_user(options.cage, options.scheme, len(VALENCES))
    figure, axes = panels(options, len(cages), len(OFFSETS), sharex=True, sharey=True)
    numbers: list[tuple[object, ...]] = [("vertex", "c1", "normal", "level", "error in degrees")]
    for row, (name, in_turns) in zip(axes, cages.items(), strict=True):
        for axis, offset in zip(row, OFFSETS, strict=True):
            numbers += [(name, offset, *line) for line in _draw_panel(axis, in_turns, offset)]
        row[0].set_ylabel(f"{name}\nerror (degrees)")
    for top, bottom, offset in zip(axes[0], axes[-1], OFFSETS, strict=True):
        top.set_title(f"|c₁| = {offset}")
        bottom.set_xlabel("level $n$")
    columns, handles = 4 if options.width > BETWEEN else 2, axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=columns)
    cage = f"{len(TURNS)} turns of extraordinary(3) and (5)"
    return write_figure(options, "error", figure, cage=cage, numbers=numbers)


def _draw_panel(axis: Axes, cages: list[ControlCage], offset: float) -> list[tuple[object, ...]]:
    """Plot the largest errors over rotated cages; returns name, level and error of each point."""
    numbers: list[tuple[object, ...]] = []
    rounded, unrounded = ([offset_cage(cage, offset, dtype=dtype) for cage in cages] for dtype in PRECISIONS)
    exact = [exact_normals(cage) for cage in rounded]

    def plot(cages: list[ControlCage], evaluator: Evaluator, dtype: Any, style: str, label: str, **look: Any) -> None:
        errors = [normal_errors(cage, n, evaluator, dtype) for cage, n in zip(cages, exact, strict=True)]
        largest = np.max(errors, axis=0)
        axis.semilogy(LEVELS, np.maximum(largest, 1e-15), style, label=label, **look)
        numbers.extend((label, level, error) for level, error in zip(LEVELS.tolist(), largest.tolist(), strict=True))

    for i, ((evaluator, label), (colour, marker)) in enumerate(zip(EQUATIONS.items(), SERIES, strict=True)):
        for dtype, style in PRECISIONS.items():
            marked = (MARKED * i // len(EQUATIONS), MARKED)
            look = {"color": colour, "marker": marker, "markevery": marked, "mfc": colour if style == "-" else "white"}
            plot(rounded, evaluator, dtype, style, f"{label}, {dtype.__name__}", **look)
    plot(unrounded, "stabilized", np.float64, ":", "rounding the cage to float32", color="0.5")
    axis.set(box_aspect=1, xlim=(LEVELS[0], LEVELS[-1]), yticks=10.0 ** np.arange(-15, 4, 6), ylim=(1e-15, 1e3))
    label_powers(axis.yaxis)
    axis.grid()
    return numbers


def offset_cage(cage: ControlCage, offset: float, scheme: str | None = None, dtype: Any = np.float32) -> ControlCage:
    """A cage, moved until the limit point of vertex 0 has this distance from the origin, and rounded."""
    limit = LimitSurface(cage, scheme).evaluate(0, [[0.0, 0.0]]).p[0]
    direction = np.array([0.48, 0.6, 0.64])  # A direction along no axis, neither normal nor tangential to the surface
    moved = cage.positions - limit + offset * direction
    return cage.with_positions(moved.astype(dtype).astype(np.float64))  # All evaluators start from the same numbers


def normal_errors(cage: ControlCage, exact: FloatArray, evaluator: Evaluator, dtype: Any) -> FloatArray:
    """Largest error of computed normals in degrees over the samples of each level: ``(levels,)``."""
    uv = (np.ldexp(1.0, -LEVELS)[:, None, None] * DIRECTIONS).reshape(-1, 2)
    normals = LimitSurface(cage).evaluate(0, uv, evaluator=evaluator, dtype=dtype).n.astype(np.float64)
    # Parallel or zero derivatives give no normal, which counts as the largest error.
    return np.nan_to_num(normal_angle(normals, exact), nan=180).reshape(len(LEVELS), -1).max(axis=1)


def exact_normals(cage: ControlCage) -> NDArray[np.float64]:
    """Exact normals of the samples of all levels at vertex 0, by ``A^n C`` with 60 digits: ``(levels * 4, 3)``."""
    scheme = scheme_named("catmull_clark")
    patch = patch_of_valence(scheme, int(cage.topology.vertex_face_count[0]))
    # Vertex 0 is the first corner of face 0.
    controls = RingTable(cage.topology, [one_ring(patch.signature)], np.array([0]), np.array([1])).vertices
    with localcontext() as context:
        context.prec = DIGITS
        matrix, *children = (_exactly(table, 1) for table in (patch.matrix, *patch.children))
        points = _exactly(cage.positions[controls])
        tangents = []
        for direction in DIRECTIONS:
            in_children = [child(direction) for child in scheme.domain.children[1:]]
            child = int(np.argmax([scheme.domain.inside(local) for local in in_children]))
            basis = _exactly(scheme.regular_basis(in_children[child][None], 1)[1:, 0], 0)
            tangents.append(_exactly(basis @ children[child], 0))
        along_u, along_v = np.stack(tangents, axis=1)
        normals = []
        for _ in LEVELS:
            normal = np.cross(along_u @ points, along_v @ points)
            normals.append(normal / np.sqrt((normal**2).sum(axis=1, keepdims=True)))
            points = matrix @ points
    return np.concatenate(normals).astype(np.float64)


def _exactly(table: NDArray, row_sum: int | None = None) -> NDArray[np.object_]:
    """Decimals of a table. The first entry of a row corrects its sum, as rounding would add up over the levels."""
    exact = np.vectorize(Decimal, otypes=[object])(table)
    if row_sum is not None:
        exact[:, 0] += row_sum - exact.sum(axis=1)
    return exact


# The figure `zoom` shows normals by (11), by (12), and by OpenSubdiv if `osd_peer` is found.
ZOOM_VALENCE, ZOOM_OFFSET = 5, 10
MAGNIFICATIONS = (1, 100, 10_000, 1_000_000)
OPENSUBDIV_LEVEL = 10  # Patch tables cannot isolate extraordinary vertices at deeper levels
Method = Evaluator | Literal["opensubdiv"]
METHODS: dict[Method, str] = {
    "stam": EQUATIONS["stam"],
    "opensubdiv": f"OpenSubdiv\nlevel {OPENSUBDIV_LEVEL}",
    "stabilized": EQUATIONS["stabilized"],
}
# Half the width of the image at magnification 1, filled by the elements at the point. The cage has the radius 1.
HALF_WIDTH, BAR = 0.19, 0.1
# Range of the colours in degrees. Errors below it are rounding of unit vectors in float32.
LEAST_ERROR, MOST_ERROR = 1e-6, 100
COLOURS, ERROR_SCALE = "magma_r", LogNorm(LEAST_ERROR, MOST_ERROR, clip=True)
LINE_POINTS = 33


def on_stage(surface: LimitSurface, points: NDArray[np.floating], magnification: float) -> NDArray[np.float64]:
    """Points on the stage, seen along the normal of vertex 0; the image covers -1 to 1."""
    point, axes, _ = staging.frame(surface)
    return (points - point) @ axes * (magnification / HALF_WIDTH)


def draw_zoom(options: FigureOptions) -> list[Path]:
    """Draw a vertex of valence 5 at four magnifications: renders, and errors of normals."""
    surface = LimitSurface(offset_cage(turned(extraordinary(ZOOM_VALENCE))[0], ZOOM_OFFSET))
    stage, resolution = staging.load_stage("zoom", resolution=options.resolution), options.resolution
    sensor, count = stage.sensors()[0], max(resolution // 2, 8)
    triangles = staging.grid_triangles(count, ZOOM_VALENCE)
    rows = [method for method in METHODS if method != "opensubdiv" or osd_peer()]
    figure, axes = panels(options, len(rows), len(MAGNIFICATIONS))
    rendered, records = [], []
    for magnification, column in zip(MAGNIFICATIONS, axes.T, strict=True):
        samples = panel_samples(surface, magnification, count)
        # Index of the nearest sample to the centre of each pixel, ``(height, width)``
        points = samples[1].reshape(-1, 3)
        centres = staging.grid_points(np.arange(resolution) + 0.5).reshape(resolution, -1, 2)
        nearest = np.asarray(cKDTree(staging.project(sensor, points)).query(centres)[1])
        lines = staging.project(sensor, _level_lines(surface, magnification))
        for method, axis in zip(rows, column, strict=True):
            normals, errors, median = normals_by(surface, samples, method)
            on_mesh = (normals @ staging.frame(surface)[1]).reshape(-1, 3)
            mesh = staging.make_mesh(points, triangles, CLAY, vertex_normals=on_mesh)
            name = f"{METHODS[method]}, x {magnification}".replace("\n", ", ")
            rendered.append(staging.render(staging.staged(stage, mesh=mesh), options, name))
            _draw_halves(axis, rendered[-1], errors.ravel()[nearest], lines)
            axis.set_xlabel(_degrees(median))
            # The scale bar is a length on the surface, whose cage has the radius 1.
            length = BAR / HALF_WIDTH / 2 * resolution
            bar = AnchoredSizeBar(axis.transData, length, scientific(BAR / magnification), "lower left", pad=0.2, sep=2)
            bar.patch.set(alpha=0.85, linewidth=0)
            axis.add_artist(bar)
            records.append({"evaluator": method, "magnification": magnification, "error": median})
        column[0].set_title(f"× {scientific(magnification)}\nu, v < {scientific(parameter_extent(magnification))}")
    for axis, method in zip(axes[:, 0], rows, strict=True):
        axis.set_ylabel(METHODS[method])
    scale = ScalarMappable(ERROR_SCALE, COLOURS)
    colours = figure.colorbar(scale, ax=axes, fraction=0.03, pad=0.01, aspect=45, extend="both")
    colours.set_label("error of the normal in degrees; medians below panels")
    label_powers(colours.ax.yaxis)
    strips = [pixels for i in range(len(rows)) for pixels in rendered[i :: len(rows)]]
    count, cage = len(MAGNIFICATIONS), f"extraordinary({ZOOM_VALENCE}), turned, {ZOOM_OFFSET} from the origin"
    return write_figure(options, "zoom", figure, strips, cage=cage, per_row=count, pictures=records)


def parameter_extent(magnification: float) -> float:
    """Largest u and v in a panel: distances from the point are proportional to ``u ** -log2(lambda_2)``."""
    patch = patch_of_valence(scheme_named("catmull_clark"), ZOOM_VALENCE)
    return float(magnification ** (1 / np.log2(patch.basis.subdominant)))


def panel_samples(surface: LimitSurface, magnification: float, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Samples of a grid of ``count`` segments along each side in a panel's part of every element at the point.

    Returns parameters ``(s, 2)``; positions on the stage and normals ``(valence, s, 3)``, too close for float32.
    """
    uv = staging.grid_points(np.linspace(0, 1, count + 1))
    uv[0] = 0.1 / count  # Stam's form has no value at the point itself
    uv *= parameter_extent(magnification)
    exact = surface.evaluate(np.arange(ZOOM_VALENCE)[:, None], uv)
    points, normals = (v.reshape(ZOOM_VALENCE, -1, 3) for v in (on_stage(surface, exact.p, magnification), exact.n))
    return uv, points, normals


def normals_by(surface: LimitSurface, samples: tuple[FloatArray, ...], method: Method) -> tuple[Any, Any, float]:
    """Normals in float32 at `panel_samples`, their errors in degrees, and the median of these in the image."""
    (uv, positions, exact), elements = samples, np.arange(ZOOM_VALENCE)[:, None]
    if method != "opensubdiv":
        normals = surface.evaluate(elements, uv, evaluator=method, dtype=np.float32).n.astype(np.float64)
    elif program := osd_peer():
        normals = osd_samples(program, surface.cage, elements, uv, "far", OPENSUBDIV_LEVEL)[1]
    else:
        raise FigureError("the program osd_peer is gone; expected it where it was found before")
    normals = np.nan_to_num(normals).reshape(exact.shape)
    # Parallel or zero derivatives give no normal, which counts as the largest error.
    angle = np.where(normals.any(axis=-1), normal_angle(normals, exact), 180)
    inside = np.abs(positions[..., :2]).max(axis=-1) < 1
    return normals, angle, float(np.median(angle[inside]))


def _level_lines(surface: LimitSurface, magnification: float) -> NDArray[np.float64]:
    """Edges of the elements at the point and of their children, on the stage: ``(lines, points, 3)``."""
    along = np.linspace(0, 1, LINE_POINTS)
    line = np.stack([np.ones_like(along), along], axis=1)
    extent = parameter_extent(magnification)
    # Lines u = 1/2^n and v = 1/2^n of the levels n that the image resolves.
    first = int(np.floor(-np.log2(extent))) - 1
    sides = 2.0 ** -np.arange(max(first, 0), first + 7)[:, None, None]
    axis = np.stack([along, np.zeros_like(along)], axis=1) * extent
    curves = np.concatenate([sides * line, sides * line[:, ::-1], axis[None]]).reshape(-1, 2)
    points = surface.evaluate(np.arange(ZOOM_VALENCE)[:, None], curves).p
    return on_stage(surface, points, magnification).reshape(-1, LINE_POINTS, 3)


def _draw_halves(axis: Axes, pixels: NDArray[np.float32], errors: FloatArray, lines: FloatArray) -> None:
    height, width = errors.shape
    axis.imshow(staging.in_8_bits(pixels), interpolation="lanczos")
    right = (width // 2, width, height, 0)
    axis.imshow(errors[:, width // 2 :], cmap=COLOURS, norm=ERROR_SCALE, interpolation="nearest", extent=right)
    axis.add_collection(LineCollection(list(lines), colors="black", linewidths=0.3, alpha=0.6))
    axis.axvline(width / 2, color="white")
    axis.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])


def _degrees(error: float) -> str:
    if error < LEAST_ERROR:
        return f"< {scientific(LEAST_ERROR)}°"
    return f"{scientific(error)}°" if error < 0.01 else f"{error:.1g}°" if error < 1 else f"{error:.0f}°"
