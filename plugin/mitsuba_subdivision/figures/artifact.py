"""The dark spot: normals at extraordinary vertices by equations (11), (12) and (13)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from .. import example_file
from ..cage import ControlCage
from ..evaluation.equations import AT_EXTRAORDINARY_POINT, Evaluator
from ..regression.tiers import normal_angle
from ..schemes import scheme_named
from ..surface import LimitSurface
from .cages import edge_curves
from .characteristic import patch_of_valence
from .output import FigureError, FigureOptions, panels, scientific, show, write_figure
from .own_cage import around_vertices, frame
from .staging import in_8_bits, load_stage, project, render, staged

# Vertices within this radius of the extraordinary vertex show their normals, as needles of this length.
NEEDLE_RADIUS = 0.3
NEEDLE_LENGTH = 0.07
# Edges of the cage that begin within this radius of the extraordinary vertex are drawn.
EDGE_RADIUS = 0.8
# What lambda_2^n is at the sample of a cage of a user: eps |c1| / lambda_2^n is 30.
LOST = 2.0**-23 / 3
# Captions show smaller errors, in degrees, as "below" this: normals of symmetric cages can be right to all digits.
NEGLIGIBLE = 1e-8


@dataclass(frozen=True)
class NormalRule:
    """Methods for the normal at the extraordinary point, all in float32."""

    title: str
    evaluator: Evaluator
    at_point: bool

    def sample_offset(self, row: Row) -> float:
        return 0.0 if self.at_point else row.sample_offset


@dataclass(frozen=True)
class Row:
    """A scene of one scheme, the ``u = v`` at which its extraordinary point is sampled, and the tessellation rate.

    A cage of a user takes the place of the scene's own.
    """

    scheme: str
    valence: int
    sample_offset: float
    rate: int
    own: ControlCage | None = None

    def surface(self) -> LimitSurface:
        """The scene's surface. The extraordinary point is corner 0 of element 0, and vertex 0 of a tessellation."""
        prefix = {"catmull_clark": "valence", "loop": "loop_valence", "doo_sabin": "doo_sabin_face"}[self.scheme]
        name = f"cages/{prefix}{self.valence}.obj"
        return LimitSurface(self.own or ControlCage.from_file(example_file(name)), self.scheme)


# At |c1| = 10 and about these u = v, float32 loses the normal: its error is about eps |c1| / lambda_2^n, where the
# subdominant eigenvalues are 0.41 and 0.55 (Catmull-Clark), 0.25 and 0.45 (Loop), 0.5 (Doo-Sabin). The smaller these
# are, the closer to the point lie samples of the same u and v. The rates make the triangles there about equally large.
ROWS = (
    Row("catmull_clark", 3, 1e-6, 3),
    Row("catmull_clark", 5, 1e-8, 4),
    Row("loop", 3, 1e-4, 2),
    Row("loop", 5, 1e-7, 4),
    Row("doo_sabin", 3, 1e-7, 4),
    Row("doo_sabin", 5, 1e-7, 4),
)
RULES = (
    NormalRule("Stam's form (11)", "stam", at_point=False),
    NormalRule("stabilised (12)", "stabilized", at_point=False),
    NormalRule("at the point (13)", "stabilized", at_point=True),
)


def vertex_normal(row: Row, rule: NormalRule) -> tuple[int | None, float, float]:
    """Sample of float32 at an extraordinary point, against float64 at the same parameters.

    Returns its level n, None at the point itself; the offset |c1|; and the error of its normal in degrees.
    """
    surface = row.surface()
    uv = np.full((1, 2), rule.sample_offset(row))
    single = surface.evaluate(0, uv, evaluator=rule.evaluator, dtype=np.float32)
    double = surface.evaluate(0, uv)
    level = None if single.level[0] == AT_EXTRAORDINARY_POINT else int(single.level[0])
    limit = surface.evaluate(0, np.zeros((1, 2))).p[0]
    return level, float(np.linalg.norm(limit)), float(normal_angle(single.n[0], double.n[0]))


def draw(options: FigureOptions) -> list[Path]:
    """Render valences 3 and 5 with vertex normals by (11), (12) and (13).

    Only the arithmetic of (11) in float32 darkens the first column: scene, light, tessellation and positions are the
    same in all columns.
    """
    rows = [row for row in ROWS if row.scheme == options.scheme]
    if options.cage:
        rows = _own_rows(options.cage, options.scheme)
    figure, axes = panels(options, len(rows), len(RULES))
    rendered, records = [], []
    for row, row_axes in zip(rows, axes, strict=True):
        for rule, axis in zip(RULES, row_axes, strict=True):
            level, offset, error = vertex_normal(row, rule)
            location, caption = _caption(rule.sample_offset(row), level, error)
            options.report(f"valence {row.valence}, {rule.title}: {location}; {caption}")
            rendered.append(_draw_panel(axis, row, rule, options, f"{location}\n{caption}"))
            record = {"valence": row.valence, "rule": rule.title, "level": level, "offset": offset, "error": error}
            records.append(record)
        row_axes[0].set_ylabel(f"valence {row.valence}, |c₁| = {offset:.1f}")
    for axis, rule in zip(axes[0], RULES, strict=True):
        axis.set_title(rule.title)
    name = options.name_for_scheme("artifact")
    variant = mi.variant()
    return write_figure(options, name, figure, rendered, per_row=len(RULES), pictures=records, variant=variant)


def _own_rows(path: Path, scheme: str) -> list[Row]:
    """Rows of a user's cage, moved to where the scene of valence 5 has its vertex."""
    if scheme != "catmull_clark":
        raise FigureError(f"--cage together with --scheme {scheme}; expected catmull_clark")
    like = ROWS[1]
    rows = []
    for valence, cage in around_vertices(path, 2, frame(like.surface())).items():
        # Where Stam's form has lost the normal, as above.
        subdominant = patch_of_valence(scheme_named(like.scheme), valence).basis.subdominant
        level = np.log(LOST) / np.log(subdominant)
        rows.append(Row(like.scheme, valence, float(f"{0.5**level:.0e}"), like.rate, cage))
    return rows


def _caption(sample_offset: float, level: int | None, error: float) -> tuple[str, str]:
    """Label with the sample location of the vertex and the error of its normal."""
    location = "u = v = 0" if level is None else f"u = v = {scientific(sample_offset)}, n = {level}"
    if error >= 0.1:
        return location, f"error {error:.1f}°"
    return location, f"error {'below ' * (error < NEGLIGIBLE)}{scientific(max(error, NEGLIGIBLE))}°"


def _draw_panel(axis: Axes, row: Row, rule: NormalRule, options: FigureOptions, caption: str) -> NDArray[np.float32]:
    """Render the surface, and draw it with normals near the extraordinary vertex and with edges; returns the pixels."""
    offset, resolution = rule.sample_offset(row), options.resolution
    surface, stage = row.surface(), load_stage(f"valence{5 if row.own else row.valence}", resolution=resolution)
    shape = {
        "type": "subdivision",
        **surface.cage.as_properties(mi),
        "scheme": row.scheme,
        "tessellation_rate": row.rate,
        "evaluator": rule.evaluator,
        "sample_offset": offset,
        "bsdf": next(shape.bsdf() for shape in stage.shapes() if not shape.is_emitter()),
    }
    scene = staged(stage, [shape for shape in stage.shapes() if shape.is_emitter()], surface=mi.load_dict(shape))
    pixels = render(scene, options, f"valence {row.valence}, {rule.title}")[..., :3]
    tessellation = surface.tessellate(row.rate, rule.evaluator, np.float32, offset)
    distance = np.linalg.norm(tessellation.positions - tessellation.positions[0], axis=1)
    near = np.flatnonzero(distance < NEEDLE_RADIUS)
    start = tessellation.positions[near].astype(np.float64)
    needles = np.stack([start, start + NEEDLE_LENGTH * tessellation.normals[near]], axis=1)
    edges = edge_curves(surface, np.arange(surface.patches.elements.half_edge_count), 16)
    edges = edges[np.linalg.norm(edges[:, 0] - edges[0, 0], axis=1) < EDGE_RADIUS]
    show(axis, in_8_bits(pixels), caption=caption)
    axis.set(xlim=(0, pixels.shape[1]), ylim=(pixels.shape[0], 0))
    sensor = scene.sensors()[0]
    # The needle of the extraordinary vertex comes first.
    first, *others = project(sensor, needles, resolution)
    curves = list(project(sensor, edges, resolution))
    axis.add_collection(LineCollection(curves, colors="#40362a", linewidths=0.3, alpha=0.4))
    axis.add_collection(LineCollection(others, colors="#1c4f72", linewidths=0.6, capstyle="round"))
    axis.add_collection(LineCollection([first], colors="#d8452a", linewidths=1.5, capstyle="round"))
    return pixels
