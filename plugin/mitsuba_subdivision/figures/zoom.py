"""The surface at an extraordinary vertex, magnified up to a million times, by equations (11) and (12) in float32.

Where the program `osd_peer` is found, OpenSubdiv's surface is drawn too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..images.exr import write_exr
from ..surface import LimitSurface
from .characteristic import patch_of_valence
from .normal_error import EQUATIONS, offset_cage
from .output import FigureOptions, pyplot, save_figure
from .peers import osd_peer, osd_samples
from .projection import project
from .staging import in_8_bits, load_stage, make_mesh, render, staged

VALENCE = 5
OFFSET = 10
MAGNIFICATIONS = (1, 100, 10_000, 1_000_000)
EVALUATORS = ("stam", "stabilized")
# As deep as OpenSubdiv's patch tables can isolate extraordinary vertices.
OPENSUBDIV, OPENSUBDIV_LEVEL = "opensubdiv", 10
LABELS = {**EQUATIONS, OPENSUBDIV: f"OpenSubdiv, level {OPENSUBDIV_LEVEL}"}
# Half the width of the picture at magnification 1: the elements at the point just fill it. The cage has the radius 1.
HALF_WIDTH = 0.19
BAR = 0.1
LINE_POINTS = 33


@dataclass(frozen=True, eq=False)
class View:
    """The surface around the extraordinary point, seen along its normal.

    Attributes
    ----------
    surface : LimitSurface
        Its cage has vertex 0 as the extraordinary one, with elements 0 to ``valence - 1`` around it.
    point : (3,)
        The limit point.
    frame : (3, 3)
        Columns: two directions in the tangent plane, and the normal.
    """

    surface: LimitSurface
    point: NDArray[np.float64]
    frame: NDArray[np.float64]

    @classmethod
    def of(cls, cage: ControlCage) -> View:
        surface = LimitSurface(cage)
        at = surface.evaluate(0, np.zeros((1, 2)))
        normal = at.n[0]
        along = at.dp_du[0] - (at.dp_du[0] @ normal) * normal
        along /= np.linalg.norm(along)
        return cls(surface, at.p[0], np.stack([along, np.cross(normal, along), normal], axis=1))

    def place(self, points: NDArray[np.float64], magnification: float) -> NDArray[np.float64]:
        """Points on the stage, where the picture reaches from -1 to 1."""
        return (points - self.point) @ self.frame * (magnification / HALF_WIDTH)


def draw_zoom(options: FigureOptions) -> list[Path]:
    """Render the neighbourhood of a vertex of valence 5 at four magnifications, with normals by (11) and by (12).

    The surface is sampled afresh for every picture. Its normals are evaluated in float32; where the samples lie in the
    picture comes from float64, since at the distance of the cage a float32 cannot tell the last pictures' points apart.
    OpenSubdiv's normals come from its patch tables (Far), where its program is found.

    Returns
    -------
    list of Path
        The files written.
    """
    plt = pyplot()
    from matplotlib.collections import LineCollection

    view = View.of(offset_cage(VALENCE, OFFSET))
    stage = load_stage("zoom", resolution=options.resolution)
    rows = (EVALUATORS[0], OPENSUBDIV, EVALUATORS[1]) if osd_peer() else EVALUATORS
    figure, axes = plt.subplots(
        len(rows), len(MAGNIFICATIONS), figsize=(11.2, 3.1 * len(rows)), layout="constrained", squeeze=False
    )
    pictures, records = [], []
    for magnification, column in zip(MAGNIFICATIONS, axes.T, strict=True):
        extent = parameter_extent(magnification)
        sampled = _sample(view, magnification, max(options.resolution // 2, 8))
        lines = project(stage.sensors()[0], _level_lines(view, magnification), options.resolution)
        for evaluator, axis in zip(rows, column, strict=True):
            scene, error = _magnified(stage, view, sampled, evaluator)
            name = f"{LABELS[evaluator]}, x {magnification}"
            options.report(f"{name}: median normal error {error:.1e} degrees")
            pixels = render(scene, options, name)
            axis.imshow(in_8_bits(pixels), interpolation="lanczos")
            axis.add_collection(LineCollection(lines, colors="black", linewidths=0.5, alpha=0.4))
            axis.set_xlim(0, options.resolution)
            axis.set_ylim(options.resolution, 0)
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_xlabel(f"median normal error {_degrees(error)}", fontsize=9.5)
            _draw_bar(axis, magnification, options.resolution)
            pictures.append(pixels)
            records.append({"evaluator": evaluator, "magnification": magnification, "error": error})
        power = int(np.log10(magnification))
        title = "$\\times$ 1" if power == 0 else f"$\\times$ $10^{power}$"
        column[0].set_title(f"{title},  $u, v < {_power(extent)}$", fontsize=11)
    for axis, evaluator in zip(axes[:, 0], rows, strict=True):
        axis.set_ylabel(f"{LABELS[evaluator]}, float32", fontsize=11)
    written = options.paths("zoom", "png", "pdf")
    for path in written:
        save_figure(figure, path, dpi=110)
    plt.close(figure)
    for path in options.paths("zoom", "exr"):
        strips = [np.concatenate(pictures[i :: len(rows)], axis=1) for i in range(len(rows))]
        write_exr(path, np.concatenate(strips), {"pictures": records, "offset": OFFSET, "spp": options.spp})
        written.append(path)
    return written


def parameter_extent(magnification: float) -> float:
    """Largest u and v of an element's part that fills the picture: distances go with ``u ** -log2(lambda_2)``."""
    patch = patch_of_valence(LimitSurface(offset_cage(VALENCE, OFFSET)).scheme, VALENCE)
    return float(magnification ** (1 / np.log2(patch.basis.subdominant)))


@dataclass(frozen=True, eq=False)
class _Samples:
    """Parameters in every element at the point, and where exact arithmetic puts them on the stage, with what normals.

    Attributes
    ----------
    uv : (s, 2)
        The same in each element.
    triangles : (m, 3)
    places, normals : (valence, s, 3)
    """

    uv: NDArray[np.float64]
    triangles: NDArray[np.int64]
    places: NDArray[np.float64]
    normals: NDArray[np.float64]


def _sample(view: View, magnification: float, count: int) -> _Samples:
    u, v = np.meshgrid(np.linspace(0, 1, count + 1), np.linspace(0, 1, count + 1))
    # The point itself has no value in Stam's form.
    u[0, 0] = v[0, 0] = 0.1 / count
    uv = np.stack([u.ravel(), v.ravel()], axis=1) * parameter_extent(magnification)
    corner = np.arange(u.size).reshape(u.shape)
    quads = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]], axis=-1).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    exact = [view.surface.evaluate(element, uv) for element in range(VALENCE)]
    places = np.stack([view.place(found.p, magnification) for found in exact])
    return _Samples(uv, triangles, places, np.stack([found.n for found in exact]))


def _magnified(stage, view: View, samples: _Samples, evaluator: str):
    """The scene with the magnified surface, and the median error of its normals inside the picture, in degrees."""
    normals = np.stack([_normals(view.surface, element, samples.uv, evaluator) for element in range(VALENCE)])
    sine = np.linalg.norm(np.cross(normals, samples.normals), axis=-1)
    angle = np.degrees(np.arctan2(sine, (normals * samples.normals).sum(axis=-1)))
    # Parallel or vanishing derivatives give no normal: as wrong as can be.
    angle = np.where(np.isnan(angle), 180, angle)
    inside = np.abs(samples.places[..., :2]).max(axis=-1) < 1
    first = (len(samples.uv) * np.arange(VALENCE))[:, None, None]
    mesh = make_mesh(
        samples.places.reshape(-1, 3),
        (samples.triangles + first).reshape(-1, 3),
        {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.72, 0.66, 0.58]}},
        normals=(np.nan_to_num(normals) @ view.frame).reshape(-1, 3),
    )
    return staged(stage, mesh=mesh), float(np.median(angle[inside]))


def _normals(surface: LimitSurface, element: int, uv: NDArray[np.float64], evaluator: str) -> NDArray[np.float64]:
    """Normals from float32 arithmetic by one of our evaluators or OpenSubdiv: ``(s, 3)``."""
    if evaluator == OPENSUBDIV:
        return osd_samples(osd_peer(), surface.cage, element, uv, "far", OPENSUBDIV_LEVEL)[1]
    return surface.evaluate(element, uv, evaluator=evaluator, dtype=np.float32).n.astype(np.float64)


def _level_lines(view: View, magnification: float) -> NDArray[np.float64]:
    """Edges of the elements at the point, and of their parts at each level: ``(lines, points, 3)`` on the stage."""
    along = np.linspace(0, 1, LINE_POINTS)
    one, nought = np.ones_like(along), np.zeros_like(along)
    # Half-way lines of every level that the picture resolves.
    first = int(np.floor(-np.log2(parameter_extent(magnification)))) - 1
    curves = []
    for level in range(max(first, 0), first + 7):
        size = 2.0**-level
        curves += [np.stack([one, along], axis=1) * size, np.stack([along, one], axis=1) * size]
    curves.append(np.stack([along, nought], axis=1) * parameter_extent(magnification))
    uv = np.concatenate(curves)
    lines = [view.place(view.surface.evaluate(element, uv).p, magnification) for element in range(VALENCE)]
    return np.concatenate(lines).reshape(-1, LINE_POINTS, 3)


def _draw_bar(axis, magnification: float, resolution: int) -> None:
    """Scale bar: a length on the surface, whose cage has the radius 1."""
    from matplotlib.patches import Rectangle

    length = BAR / HALF_WIDTH / 2 * resolution
    left, bottom = 0.05 * resolution, 0.945 * resolution
    pad = 0.025 * resolution
    box = (left - pad, bottom - 3.2 * pad), length + 2 * pad, 4.2 * pad
    axis.add_patch(Rectangle(*box, facecolor="white", alpha=0.85, linewidth=0))
    axis.plot([left, left + length], [bottom, bottom], color="black", linewidth=2, solid_capstyle="butt")
    axis.text(left + length / 2, bottom - 0.6 * pad, f"${_power(BAR / magnification)}$", ha="center", fontsize=9)


def _degrees(error: float) -> str:
    return f"{error:.0f}°" if error >= 1 else f"${_power(error)}$°"


def _power(value: float) -> str:
    """One digit and a power of ten, for matplotlib's formulas."""
    digit, power = f"{value:.0e}".split("e")
    if int(power) == 0:
        return digit
    return rf"10^{{{int(power)}}}" if digit == "1" else rf"{digit} \times 10^{{{int(power)}}}"
