"""The dark spot: normals at extraordinary vertices by equations (11), (12) and (13)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..evaluation.equations import AT_EXTRAORDINARY_POINT, Evaluator
from ..regression.probe import normal_angle
from ..surface import LimitSurface
from .figure_scenes import in_8_bits, load_stage, render
from .normal_error import draw as draw_normal_error
from .output import FigureOptions, hide_frame, pyplot, scene_path, write_pixels, write_plot
from .projection import project

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Vertices within this radius of the extraordinary vertex show their normals, as needles of this length.
NEEDLE_RADIUS = 0.3
NEEDLE_LENGTH = 0.07
# Edges of the cage that begin within this radius of the extraordinary vertex are drawn.
EDGE_RADIUS = 0.8
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
    """A scene of one scheme, the ``u = v`` at which its extraordinary point is sampled, and the tessellation rate."""

    scheme: str
    valence: int
    sample_offset: float
    rate: int

    @property
    def scene(self) -> Path:
        return scene_path(f"valence{self.valence}")

    @property
    def cage(self) -> str:
        """File of the cage, relative to the scene's folder."""
        prefix = {"catmull_clark": "valence", "loop": "loop_valence", "doo_sabin": "doo_sabin_face"}[self.scheme]
        return f"cages/{prefix}{self.valence}.obj"

    def surface(self) -> LimitSurface:
        """The scene's surface. The extraordinary point is corner 0 of element 0, and vertex 0 of a tessellation."""
        return LimitSurface(ControlCage.from_file(self.scene.parent / self.cage), self.scheme)


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
    NormalRule("Stam's form, equation (11)", "stam", at_point=False),
    NormalRule("stabilised form, equation (12)", "stabilized", at_point=False),
    NormalRule("normal at the point, equation (13)", "stabilized", at_point=True),
)


@dataclass(frozen=True)
class VertexNormal:
    """The sample at an extraordinary point: level n (None at the point itself), offset |c1|, error in degrees."""

    level: int | None
    offset: float
    error: float


def vertex_normal(row: Row, rule: NormalRule) -> VertexNormal:
    """Error of the normal at the extraordinary point in float32 against float64 at the same parameters."""
    surface = row.surface()
    uv = np.full((1, 2), rule.sample_offset(row))
    single = surface.evaluate(0, uv, evaluator=rule.evaluator, dtype=np.float32)
    double = surface.evaluate(0, uv)
    level = None if single.level[0] == AT_EXTRAORDINARY_POINT else int(single.level[0])
    limit = surface.evaluate(0, np.zeros((1, 2))).p[0]
    return VertexNormal(level, float(np.linalg.norm(limit)), float(normal_angle(single.n[0], double.n[0])))


def draw(options: FigureOptions) -> list[Path]:
    """Render valences 3 and 5 with vertex normals by (11), (12) and (13), and plot normal error against level.

    Only the arithmetic of (11) in float32 darkens the first column: scene, light, tessellation and positions are the
    same in all columns. The plot is drawn for Catmull-Clark only.
    """
    plt = pyplot()
    rows = [row for row in ROWS if row.scheme == options.scheme]
    figure, axes = plt.subplots(len(rows), len(RULES), figsize=(9.6, 7.2))
    panels, records = [], []
    for row, row_axes in zip(rows, axes, strict=True):
        for rule, axis in zip(RULES, row_axes, strict=True):
            vertex = vertex_normal(row, rule)
            pixels, overlay = _render(row, rule, options)
            location, error = _caption(row, rule, vertex)
            options.report(f"valence {row.valence}, {rule.title}: {location}; {error}")
            _draw_panel(axis, pixels, overlay, f"{location.replace('c1', 'c$_1$')}\n{error}")
            panels.append(pixels)
            records.append({"valence": row.valence, "rule": rule.title, **vars(vertex)})
        row_axes[0].set_ylabel(f"valence {row.valence}", fontsize=11)
    for axis, rule in zip(axes[0], RULES, strict=True):
        axis.set_title(rule.title, fontsize=10)
    figure.tight_layout(h_pad=1.2)
    name = "artifact" if options.scheme == "catmull_clark" else f"artifact_{options.scheme}"
    written = write_plot(options, name, figure, "png", dpi=100)
    strips = [np.concatenate(panels[i : i + len(RULES)], axis=1) for i in range(0, len(panels), len(RULES))]
    metadata = {"pictures": records, "spp": options.spp, "variant": mi.variant()}
    written += write_pixels(options, name, np.concatenate(strips), metadata)
    return written + (draw_normal_error(options) if options.scheme == "catmull_clark" else [])


def _caption(row: Row, rule: NormalRule, vertex: VertexNormal) -> tuple[str, str]:
    """Label with the sample location of the vertex and the error of its normal."""
    location = (
        "u = v = 0" if vertex.level is None else f"u = v = {rule.sample_offset(row):.0e}, level n = {vertex.level}"
    )
    if vertex.error >= 0.1:
        size = f"{vertex.error:.1f}°"
    else:
        size = f"{vertex.error:.0e}°" if vertex.error >= NEGLIGIBLE else f"below {NEGLIGIBLE:.0e}°"
    return f"{location}, |c1| = {vertex.offset:.1f}", f"normal error at the vertex {size}"


@dataclass(frozen=True, eq=False)
class Overlay:
    """Lines over an image, in pixels.

    Attributes
    ----------
    needles : (n, 2, 2)
        Both ends of the normals near the extraordinary vertex; that vertex's own comes first.
    edges : (m, points, 2)
        The cage's edges on the limit surface.
    """

    needles: NDArray[np.float64]
    edges: NDArray[np.float64]


def _render(row: Row, rule: NormalRule, options: FigureOptions) -> tuple[NDArray[np.float32], Overlay]:
    offset, resolution = rule.sample_offset(row), options.resolution
    scene = load_stage(
        row.scene.stem,
        cage=row.cage,
        scheme=row.scheme,
        resolution=resolution,
        rate=row.rate,
        evaluator=rule.evaluator,
        sample_offset=repr(offset),
    )
    pixels = render(scene, options, f"valence {row.valence}, {rule.title}")[..., :3]
    surface = row.surface()
    tessellation = surface.tessellate(row.rate, rule.evaluator, np.float32, offset)
    distance = np.linalg.norm(tessellation.positions - tessellation.positions[0], axis=1)
    near = np.flatnonzero(distance < NEEDLE_RADIUS)
    start = tessellation.positions[near].astype(np.float64)
    needles = np.stack([start, start + NEEDLE_LENGTH * tessellation.normals[near]], axis=1)
    sensor = scene.sensors()[0]
    return pixels, Overlay(
        project(sensor, needles, resolution), project(sensor, _edges(surface, tessellation.positions), resolution)
    )


def _edges(surface: LimitSurface, corners: NDArray[np.floating]) -> NDArray[np.float64]:
    """Curves between the elements near the extraordinary point: ``(m, 17, 3)``.

    Parameters
    ----------
    corners : (n, 3)
        Limit points of the elements' corners, the extraordinary point first.
    """
    elements = surface.patches.elements
    along = np.stack([np.linspace(0, 1, 17), np.zeros(17)], axis=1)
    distance = np.linalg.norm(corners[elements.face_vertices] - corners[0], axis=1)
    begins = np.flatnonzero(distance < EDGE_RADIUS)
    element = elements.face[begins]
    corner = begins - elements.face_offsets[element]
    # Elements that are a part of a face end in the middle of an edge.
    samples = surface.evaluate(np.repeat(element, 17), np.tile(along, (len(element), 1)), np.repeat(corner, 17))
    return samples.p.reshape(-1, 17, 3).astype(np.float64, copy=False)


def _draw_panel(axis: Axes, pixels: NDArray[np.float32], overlay: Overlay, caption: str) -> None:
    from matplotlib.collections import LineCollection

    axis.imshow(in_8_bits(pixels), interpolation="lanczos")
    axis.set_xlim(0, pixels.shape[1])
    axis.set_ylim(pixels.shape[0], 0)
    own, *others = overlay.needles
    axis.add_collection(LineCollection(list(overlay.edges), colors="#40362a", linewidths=0.5, alpha=0.35))
    axis.add_collection(LineCollection(others, colors="#1c4f72", linewidths=0.9, capstyle="round"))
    axis.add_collection(LineCollection([own], colors="#d8452a", linewidths=2.2, capstyle="round"))
    hide_frame(axis)
    axis.set_xlabel(caption, fontsize=8.5)
