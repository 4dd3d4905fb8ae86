"""A face as a patch tree: its leaves, and the matrix that makes their polynomials of its control points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import PowerNorm

from ..cage.structure import edges_of
from ..evaluation.element import element_stencils
from ..evaluation.irregular_patch import level_domains, level_rows
from ..evaluation.patch_tree import patch_tree
from ..evaluation.polynomials import regular_bernstein
from ..evaluation.tree_arrays import PIECE_LEVELS
from ..mesh.connectivity import Topology
from ..mesh.one_ring import one_ring
from ..mesh.signature import Fan, Signature
from ..schemes import scheme_named
from ..schemes.domain import AffineMap, FloatArray
from .characteristic import outline
from .output import FigureOptions, hide_frame, panels, write_plot

# Faces around the corners of the face: two of them are extraordinary.
VALENCES = (3, 4, 5, 4)
# Regular leaves, and those of each level around an extraordinary vertex; what is below is grey.
COLOURS = ("#fcfcd0", "#b9dfa8", "#63b7b3", "#2a7fb0")
# Of the springs along the face's edges that hold its corners, against those of other edges.
SLACK = 0.15
REST, EDGE, LINE = "#8d97a1", "#b6bec6", "#2d3a45"


def draw(options: FigureOptions) -> list[Path]:
    """Draw a face with two extraordinary vertices, its leaves, and the Bernstein coefficients of these as weights."""
    scheme = scheme_named("catmull_clark")
    signature = Signature("face", tuple(Fan((4,) * valence) for valence in VALENCES))
    tree, form, ring = patch_tree(scheme, signature), regular_bernstein(scheme), one_ring(signature)
    # From the parameters of each leaf to those of the face; the level, 0 for regular leaves; rows of weights.
    leaves: list[tuple[AffineMap, int, FloatArray]] = [
        (AffineMap(*domain), 0, rows)
        for *domain, rows in zip(*tree.regular_domains, tree.coefficients(form.of_controls), strict=True)
    ]
    rests = []
    for tip in tree.tips:
        outward = tip.domain.inverse()
        for level in range(PIECE_LEVELS):
            rows = level_rows(tip.irregular_patch, level) @ tip.coordinates
            domains = level_domains(tip.irregular_patch, level)
            leaves += [(outward @ domain, level + 1, own) for domain, own in zip(domains, rows, strict=True)]
        rests.append(outward @ AffineMap(np.eye(2) * 2.0**-PIECE_LEVELS, np.zeros(2)))
    options.report(
        f"{ring.vertex_count} control points, {len(leaves)} leaves of {len(form.basis.indices)} coefficients"
    )

    flat = _in_the_plane(ring.topology)

    def at(uv: FloatArray) -> FloatArray:
        return np.asarray(element_stencils(scheme, signature, uv)[0] @ flat)

    figure, ((face, matrix),) = panels(options, 1, 2)
    face.add_collection(LineCollection(list(flat[edges_of(ring.topology)]), colors=EDGE, linewidths=0.6))
    face.plot(*flat.T, "o", color="black", markersize=3, zorder=4)
    style = {"edgecolor": LINE, "linewidth": 0.4, "zorder": 2}
    around = outline(scheme.domain.corners)
    for domain, colour in [(domain, COLOURS[level]) for domain, level, _ in leaves] + [(rest, REST) for rest in rests]:
        face.fill(*at(np.clip(domain(around), 0, 1)).T, facecolor=colour, **style)
    face.plot(*at(np.stack([rest.offset for rest in rests])).T, "o", color="#c8432b", markersize=4, zorder=5)
    face.set_aspect("equal")
    hide_frame(face)
    face.set(
        title="a face and its one-ring,\nleaves of its patch tree",
        xlabel=f"$K$ = {ring.vertex_count} control points\ngrey: (10) and (12); red: (13)",
    )

    weights = np.concatenate([rows for *_, rows in leaves])
    # Small weights are seen, too.
    matrix.imshow(weights, aspect="auto", cmap="Greys", norm=PowerNorm(0.5, 0, 1), interpolation="nearest")
    size = len(form.basis.indices)
    for number, (_, level, _) in enumerate(leaves):
        strip = {"xmin": -0.06, "xmax": -0.01, "clip_on": False, "linewidth": 0.2, "edgecolor": LINE}
        matrix.axhspan(size * number - 0.5, size * (number + 1) - 0.5, facecolor=COLOURS[level], **strip)
        matrix.axhline(size * number - 0.5, color=LINE, linewidth=0.2)
    matrix.set(
        xticks=[],
        yticks=[],
        title="coefficients of all leaves =\nmatrix × control points",
        xlabel=f"$K$ = {ring.vertex_count} control points\n{len(leaves)} leaves, {size} coefficients each",
    )
    return write_plot(options, "tree", figure)


def _in_the_plane(topology: Topology) -> FloatArray:
    """Control points of a one-ring in the plane: the border on a circle, each other one amid its neighbours."""
    t = topology
    laplacian = np.zeros((t.vertex_count, t.vertex_count))
    start, end = t.face_vertices, t.face_vertices[t.next]
    laplacian[start, end] = laplacian[end, start] = -1
    # The face is drawn large.
    corners = t.face_vertices[: t.face_sizes[0]]
    laplacian[np.ix_(corners, corners)] *= SLACK
    np.fill_diagonal(laplacian, -laplacian.sum(axis=1))
    # Around the border, which begins at any of its half-edges.
    following = dict(zip(start[t.twin < 0].tolist(), end[t.twin < 0].tolist(), strict=True))
    border = [next(iter(following))]
    while (vertex := following[border[-1]]) != border[0]:
        border.append(vertex)
    angle = 2 * np.pi * np.arange(len(border)) / len(border)
    found = np.zeros((t.vertex_count, 2))
    found[border] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inner = np.setdiff1d(np.arange(t.vertex_count), border)
    found[inner] = np.linalg.solve(laplacian[np.ix_(inner, inner)], -laplacian[np.ix_(inner, border)] @ found[border])
    return found
