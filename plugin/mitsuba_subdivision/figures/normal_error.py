"""Normal error against level for equations (11), (12) and (13), in float32 and float64."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.named_cages import extraordinary
from ..evaluation.equations import Evaluator
from ..evaluation.patch_tree import irregular_patch
from ..mesh.one_ring import one_ring
from ..mesh.signature import signature_at
from ..regression.tiers import normal_angle
from ..schemes import scheme_named
from ..schemes.domain import FloatArray
from ..surface import LimitSurface
from .output import BETWEEN, SERIES, FigureError, FigureOptions, label_powers, panels, write_figure
from .user_cage import around_vertices, frame

VALENCES = (3, 5)
OFFSETS = (0, 1, 100)
LEVELS = np.arange(61)
# Directions of the samples at each level: one in each regular child, and one on the line between two.
DIRECTIONS = np.array([(1.0, 0.25), (0.75, 0.75), (0.25, 0.75), (1.0, 0.5)])
# Digits of the exact arithmetic: at level 60, differences are of size 0.41^60 = 1e-23, and keep twenty digits and more.
DIGITS = 60
EQUATIONS: dict[Evaluator, str] = {"stam": "(11) Stam", "stabilized": "(12) stabilised", "limit": "(13) limit"}
PRECISIONS = {np.float32: "-", np.float64: "--"}
# Between the markers of a line, in levels.
MARKED = 10


def draw(options: FigureOptions) -> list[Path]:
    """Plot the angle between computed and exact normals at every level.

    The exact normals come from powers of the subdivision matrix in 60-digit arithmetic.
    """
    cages = {valence: extraordinary(valence) for valence in VALENCES}
    if options.cage:
        cages = around_vertices(options.cage, len(VALENCES), frame(LimitSurface(extraordinary(5))))
    figure, axes = panels(options, len(cages), len(OFFSETS), sharex=True, sharey=True)
    for row, (valence, cage) in zip(axes, cages.items(), strict=True):
        for axis, offset in zip(row, OFFSETS, strict=True):
            _draw_panel(axis, offset_cage(cage, offset))
        row[0].set_ylabel(f"valence {valence}\nerror (degrees)")
    for axis, offset in zip(axes[0], OFFSETS, strict=True):
        axis.set_title(f"|c₁| = {offset}")
    for axis in axes[-1]:
        axis.set_xlabel("level $n$")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3 if options.width > BETWEEN else 2)
    return write_figure(options, "normal_error", figure)


def _draw_panel(axis: Axes, cage: ControlCage) -> None:
    exact = exact_normals(cage)
    for i, ((evaluator, label), (colour, marker)) in enumerate(zip(EQUATIONS.items(), SERIES, strict=True)):
        for dtype, style in PRECISIONS.items():
            error = np.maximum(normal_errors(cage, exact, evaluator, dtype), 1e-15)
            marked = (MARKED * i // len(EQUATIONS), MARKED)
            look = {"color": colour, "marker": marker, "markevery": marked, "mfc": colour if style == "-" else "white"}
            axis.semilogy(LEVELS, error, style, **look, label=f"{label}, {dtype.__name__}")
    axis.set(box_aspect=1, xlim=(LEVELS[0], LEVELS[-1]), yticks=10.0 ** np.arange(-15, 4, 6), ylim=(1e-15, 1e3))
    label_powers(axis.yaxis)
    axis.grid()


def offset_cage(cage: ControlCage, offset: float) -> ControlCage:
    """A cage, moved so that the limit point of vertex 0 has this distance from the origin.

    Its coordinates are rounded to float32, so that every evaluator gets the same numbers.
    """
    limit = LimitSurface(cage).evaluate(0, [[0.0, 0.0]]).p[0]
    # A direction that favours no axis, and is neither normal nor tangent to the surface.
    direction = np.array([0.48, 0.6, 0.64])
    moved = cage.positions - limit + offset * direction
    return cage.with_positions(moved.astype(np.float32).astype(np.float64))


def normal_errors(cage: ControlCage, exact: FloatArray, evaluator: Evaluator, dtype: Any) -> FloatArray:
    """Largest angle in degrees between computed and exact normal over the samples of each level: ``(levels,)``."""
    uv = (np.ldexp(1.0, -LEVELS)[:, None, None] * DIRECTIONS).reshape(-1, 2)
    normals = LimitSurface(cage).evaluate(0, uv, evaluator=evaluator, dtype=dtype).n.astype(np.float64)
    # Where derivatives came out parallel or zero, there is no normal. That counts as the largest error.
    exists = np.abs(normals).max(axis=1) > 0
    angle = np.full(len(normals), 180.0)
    angle[exists] = normal_angle(normals[exists], exact[exists])
    return angle.reshape(len(LEVELS), -1).max(axis=1)


def exact_normals(cage: ControlCage) -> NDArray[np.float64]:
    """Normals of the samples of all levels at vertex 0, from ``A^n C`` in 60-digit arithmetic: ``(levels * 4, 3)``."""
    try:
        import mpmath
    except ImportError as error:
        raise FigureError("the exact normals need mpmath: pip install 'mitsuba-subdivision[figures]'") from error
    scheme = scheme_named("catmull_clark")
    # Vertex 0 is the first corner of face 0.
    signature = signature_at(cage.topology, 0, scheme.element)
    controls = one_ring(signature).gather(cage.topology, np.array([0]))[0]
    patch = irregular_patch(scheme, signature)
    if patch is None:
        raise FigureError("vertex 0 is regular; expected an extraordinary vertex")

    with mpmath.workdps(DIGITS):
        # Rows are made to sum to one exactly: otherwise, rounding of the entries would add up over the levels.
        tables = patch.matrix, *patch.children
        matrix, *children = (_rows_to(1, mpmath.matrix(table.tolist())) for table in tables)
        points = mpmath.matrix(cage.positions[controls].tolist())
        tangents = []
        for direction in DIRECTIONS:
            in_children = [child(direction) for child in scheme.domain.children[1:]]
            child = int(np.argmax([scheme.domain.inside(local) for local in in_children]))
            basis = mpmath.matrix(scheme.regular_basis(in_children[child][None], 1)[1:, 0].tolist())
            tangents.append(_rows_to(0, _rows_to(0, basis) * children[child]))
        normals = []
        for _ in LEVELS:
            for rows in tangents:
                (a, b, c), (d, e, f) = (rows * points).tolist()
                normal = b * f - c * e, c * d - a * f, a * e - b * d
                length = mpmath.sqrt(sum(x * x for x in normal))
                normals.append([float(x / length) for x in normal])
            points = matrix * points
    return np.array(normals, dtype=np.float64)


def _rows_to(total: int, matrix: Any) -> Any:
    """Correct the first entry of each row of an mpmath matrix, so that the row sums to a number exactly."""
    for i in range(matrix.rows):
        matrix[i, 0] += total - sum(matrix[i, :])
    return matrix
