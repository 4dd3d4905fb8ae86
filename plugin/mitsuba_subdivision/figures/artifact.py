"""The dark spot: normals at extraordinary vertices by equations (11), (12) and (13)."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from .. import example_file
from ..cage import ControlCage
from ..evaluation.equations import AT_EXTRAORDINARY_POINT, Evaluator
from ..regression.tiers import normal_angle
from ..schemes import scheme_named
from ..surface import LimitSurface
from ..tessellation.vertex_table import Tessellation
from .cages import edge_curves
from .characteristic import patch_of_valence
from .output import FigureError, FigureOptions, panels, scientific, show, write_figure
from .staging import in_8_bits, load_stage, project, render, staged
from .user_cage import around_vertices, frame

# Vertices within this radius of the extraordinary vertex show their normals, as needles of this length.
NEEDLE_RADIUS = 0.3
NEEDLE_LENGTH = 0.07
# Edges of the cage that begin within this radius of the extraordinary vertex are drawn.
EDGE_RADIUS = 0.8
# What lambda_2^n is at the sample of a cage of a user: eps |c1| / lambda_2^n is 30.
LOST = 2.0**-23 / 3
# Captions show smaller errors, in degrees, as "below" this: normals of symmetric cages can be right to all digits.
NEGLIGIBLE = 1e-8


# By scheme and valence: the u = v at which the extraordinary point is sampled, and the tessellation rate. At |c1| = 10
# and about these u = v, float32 loses the normal: its error is about eps |c1| / lambda_2^n, where the subdominant
# eigenvalues are 0.41 and 0.55 (Catmull-Clark), 0.25 and 0.45 (Loop), 0.5 (Doo-Sabin). The smaller these are, the
# closer to the point lie samples of the same u and v. The rates make the triangles there about equally large.
ROWS = {
    ("catmull_clark", 3): (1e-6, 3),
    ("catmull_clark", 5): (1e-8, 4),
    ("loop", 3): (1e-4, 2),
    ("loop", 5): (1e-7, 4),
    ("doo_sabin", 3): (1e-7, 4),
    ("doo_sabin", 5): (1e-7, 4),
}
# Title, evaluator, and whether samples lie beside the extraordinary point rather than at it; all in float32.
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
    """Sample of float32 at ``u = v = offset`` beside an extraordinary point, against float64 there.

    Returns its level n, None at the point itself; the distance |c1| of the point from the origin; and the error of its
    normal in degrees.
    """
    uv = np.full((1, 2), offset)
    single = surface.evaluate(0, uv, evaluator=evaluator, dtype=np.float32)
    double = surface.evaluate(0, uv)
    level = None if single.level[0] == AT_EXTRAORDINARY_POINT else int(single.level[0])
    limit = surface.evaluate(0, np.zeros((1, 2))).p[0]
    return level, float(np.linalg.norm(limit)), float(normal_angle(single.n[0], double.n[0]))


def draw(options: FigureOptions) -> list[Path]:
    """Render valences 3 and 5 with vertex normals by (11), (12) and (13).

    Only the arithmetic of (11) in float32 darkens the first column: scene, light, tessellation and positions are the
    same in all columns.
    """
    if options.cage:
        rows = _rows_of_user(options.cage, options.scheme)
    else:
        of_scheme = [(valence, *sampling) for (scheme, valence), sampling in ROWS.items() if scheme == options.scheme]
        rows = [(valence, surface_of(options.scheme, valence), offset, rate) for valence, offset, rate in of_scheme]
    figure, axes = panels(options, len(rows), len(RULES))
    rendered, records = [], []
    for (valence, surface, beside, rate), row_axes in zip(rows, axes, strict=True):
        stage = load_stage(f"valence{5 if options.cage else valence}", resolution=options.resolution)
        for (title, evaluator, is_beside), axis in zip(RULES, row_axes, strict=True):
            offset = beside if is_beside else 0.0
            level, distance, error = vertex_normal(surface, evaluator, offset)
            location, caption = _caption(offset, level, error)
            name = f"valence {valence}, {title}"
            options.report(f"{name}: {location}; {caption}")
            scene = _scene_of(stage, surface, rate, evaluator, offset)
            rendered.append(render(scene, options, name)[..., :3])
            show(axis, in_8_bits(rendered[-1]), caption=f"{location}\n{caption}")
            _draw_lines(axis, scene, surface, surface.tessellate(rate, evaluator, np.float32, offset))
            record = {"valence": valence, "rule": title, "level": level, "offset": distance, "error": error}
            records.append(record)
        row_axes[0].set_ylabel(f"valence {valence}, |c₁| = {distance:.1f}")
    for axis, (title, *_) in zip(axes[0], RULES, strict=True):
        axis.set_title(title)
    name = options.name_for_scheme("artifact")
    variant = mi.variant()
    return write_figure(options, name, figure, rendered, per_row=len(RULES), pictures=records, variant=variant)


def _rows_of_user(path: Path, scheme: str) -> list[tuple[int, LimitSurface, float, int]]:
    """Rows of a user's cage, moved to where the scene of valence 5 has its vertex."""
    if scheme != "catmull_clark":
        raise FigureError(f"--cage together with --scheme {scheme}; expected catmull_clark")
    rows, (_, rate) = [], ROWS[scheme, 5]
    for valence, cage in around_vertices(path, 2, frame(surface_of(scheme, 5))).items():
        # Where Stam's form has lost the normal, as above.
        subdominant = patch_of_valence(scheme_named(scheme), valence).basis.subdominant
        level = np.log(LOST) / np.log(subdominant)
        rows.append((valence, LimitSurface(cage, scheme), float(f"{0.5**level:.0e}"), rate))
    return rows


def _caption(sample_offset: float, level: int | None, error: float) -> tuple[str, str]:
    """Label with the sample location of the vertex and the error of its normal."""
    location = "u = v = 0" if level is None else f"u = v = {scientific(sample_offset)}, n = {level}"
    if error >= 0.1:
        return location, f"error {error:.1f}°"
    return location, f"error {'below ' * (error < NEGLIGIBLE)}{scientific(max(error, NEGLIGIBLE))}°"


def _scene_of(stage: mi.Scene, surface: LimitSurface, rate: int, evaluator: Evaluator, offset: float) -> mi.Scene:
    """The scene, with a surface in place of its own."""
    emitters = [shape for shape in stage.shapes() if shape.is_emitter()]
    shape = {
        "type": "subdivision",
        **surface.cage.as_properties(mi),
        "scheme": surface.scheme.name,
        "tessellation_rate": rate,
        "evaluator": evaluator,
        "sample_offset": offset,
        "bsdf": next(shape.bsdf() for shape in stage.shapes() if not shape.is_emitter()),
    }
    return staged(stage, emitters, surface=mi.load_dict(shape))


def _draw_lines(axis: Axes, scene: mi.Scene, surface: LimitSurface, tessellation: Tessellation) -> None:
    """Draw normals near the extraordinary vertex, and edges of the cage on the surface."""
    distance = np.linalg.norm(tessellation.positions - tessellation.positions[0], axis=1)
    near = np.flatnonzero(distance < NEEDLE_RADIUS)
    start = tessellation.positions[near].astype(np.float64)
    needles = np.stack([start, start + NEEDLE_LENGTH * tessellation.normals[near]], axis=1)
    edges = edge_curves(surface, np.arange(surface.patches.elements.half_edge_count), 16)
    edges = edges[np.linalg.norm(edges[:, 0] - edges[0, 0], axis=1) < EDGE_RADIUS]
    sensor = scene.sensors()[0]
    width, height = sensor.film().crop_size()
    axis.set(xlim=(0, width), ylim=(height, 0))
    # The needle of the extraordinary vertex comes first.
    first, *others = project(sensor, needles, width)
    curves = list(project(sensor, edges, width))
    axis.add_collection(LineCollection(curves, colors="#40362a", linewidths=0.3, alpha=0.4))
    axis.add_collection(LineCollection(others, colors="#1c4f72", linewidths=0.6, capstyle="round"))
    axis.add_collection(LineCollection([first], colors="#d8452a", linewidths=1.5, capstyle="round"))
