"""Figures of Catmull-Clark cages beside their limit surfaces: refinements of a cage, and creases of a chess piece."""

from __future__ import annotations

import itertools
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from .. import example_file
from ..cage import ControlCage
from ..evaluation.patch_tree import lattice_stencils
from ..mesh.connectivity import Topology
from ..surface import LimitSurface
from ..variants import SceneNode
from . import staging
from .output import FigureError, FigureOptions, panels, rows_of, show, write_figure

LEVELS = 4
RADIUS = 1.9  # Of the ball that fills the picture, for cages of users
REGULAR, IRREGULAR = (0.9, 0.9, 0.89), (0.22, 0.24, 0.27)
# Segments of an edge of level 0, for visibility tests at their ends; each next level has half as many.
EDGE_SEGMENTS = 24
RATE = 6  # Segments per edge of a patch of the last level, for areas and renders of the limit surface


def draw_subdivision(options: FigureOptions) -> list[Path]:
    """Draw a cage of 3-, 4-, 5- and 6-gons at levels 0 to 3, with irregular patches in grey, and its limit surface."""
    stage = staging.load_stage("subdivision", resolution=options.resolution)
    cages = [ControlCage.from_file(example_file("cages/propeller.obj"))]
    if options.cage:
        cages = [staging.in_ball(staging.read(options.cage), RADIUS)]
    while len(cages) < LEVELS:
        cages.append(cages[-1].refined())
    counts = {extraordinary_count(cage.topology) for cage in cages}
    if len(counts) != 1:
        raise FigureError(f"{sorted(counts)} extraordinary points at several levels; expected as many at each")
    # Title, caption and scene of each panel, and lines and points on its surface.
    drawn = []
    for level, cage in enumerate(cages):
        limit = LimitSurface(cage)
        regular = regular_elements(limit)
        share = area_share(limit, regular)
        t = cage.topology
        ends = cage.positions[t.face_vertices[[t.edge_half_edge, t.next[t.edge_half_edge]]]]
        along = np.linspace(0, 1, (EDGE_SEGMENTS >> level) + 1)[None, :, None]
        lines = (1 - along) * ends[0][:, None] + along * ends[1][:, None]
        points = np.concatenate([cage.positions[_is_extraordinary(t)], _centres(cage)[t.face_sizes != 4]])
        caption = f"{100 * share:.{0 if share in (0, 1) else 1}f} % regular"
        scene = staging.staged(stage, mesh=_polyhedron(cage, regular))
        drawn.append((f"level {level}", caption, scene, lines, 0.55 - 0.12 * level, points))
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(REGULAR)}}
    scene = staging.staged(stage, surface=staging.limit_surface(limit.cage, RATE, bsdf))
    lines = edge_curves(limit, t.edge_half_edge, EDGE_SEGMENTS >> (LEVELS - 1))
    points = edge_curves(limit, t.vertex_half_edge[_is_extraordinary(t)], 1)[:, 0]
    drawn.append(("limit surface", f"regular but for {counts.pop()} points", scene, lines, 0.17, points))

    figure, axes = panels(options, *rows_of(options, len(drawn)))
    for axis in axes.flat[len(drawn) :]:
        axis.set_axis_off()
    rendered, resolution = [], options.resolution
    for axis, (title, caption, scene, lines, width, points) in zip(axes.flat, drawn, strict=False):
        rendered.append(staging.render(scene, options, title))
        show(axis, staging.on_white(rendered[-1]), title, caption)
        runs = staging.visible_runs(scene, lines)
        axis.add_collection(LineCollection(runs, colors="#14181c", linewidths=width, capstyle="round"))
        seen = staging.project(scene.sensors()[0], points[staging.visible(scene, points)])
        axis.plot(*seen.T, "o", color="#d1432b", markersize=2, markeredgecolor="white", markeredgewidth=0.2)
        # The part of the square image that the surface fills.
        axis.set(xlim=(0, resolution), ylim=(0.84 * resolution, 0.13 * resolution))
    return write_figure(options, "subdivision", figure, rendered, cage="propeller.obj", levels=LEVELS)


def extraordinary_count(topology: Topology) -> int:
    """Number of inner vertices of valences other than 4 and of faces other than quads, which refinement keeps."""
    return int(_is_extraordinary(topology).sum() + (topology.face_sizes != 4).sum())


def regular_elements(surface: LimitSurface) -> NDArray[np.bool_]:
    """``(n_f,)`` whether the limit surface over each face is one bicubic patch."""
    patches = surface.patches
    regular = np.zeros(surface.cage.face_count, dtype=bool)
    for group in patches.classes:
        if lattice_stencils(surface.scheme, group.signature) is not None:
            regular[patches.elements.face[group.corners]] = True
    return regular


def area_share(surface: LimitSurface, elements: NDArray[np.bool_]) -> float:
    """Share of some elements in the area of the limit surface."""
    triangles = surface.tessellate(RATE)
    a, b, c = triangles.positions[triangles.triangles].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return float(area[elements[triangles.element]].sum() / area.sum())


def _polyhedron(cage: ControlCage, regular: NDArray[np.bool_]) -> mi.Mesh:
    t = cage.topology
    # Every face becomes a fan of triangles around its centre, with separate vertices that have its normal.
    corners, centres = cage.positions[t.face_vertices], _centres(cage)
    cross = np.cross(corners - centres[t.face], corners[t.next] - centres[t.face])
    normals = np.add.reduceat(cross, t.face_offsets[:-1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    half_edges = np.arange(t.half_edge_count)
    return staging.make_mesh(
        np.concatenate([corners, centres]),
        np.stack([half_edges, t.next, t.half_edge_count + t.face], axis=1),
        {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "face_color"}},
        vertex_normals=np.concatenate([normals[t.face], normals]),
        face_color=np.where(regular[:, None], REGULAR, IRREGULAR)[t.face],
    )


def _centres(cage: ControlCage) -> NDArray[np.float64]:
    t = cage.topology
    return np.add.reduceat(cage.positions[t.face_vertices], t.face_offsets[:-1]) / t.face_sizes[:, None]


def edge_curves(surface: LimitSurface, half_edges: NDArray[np.integer], segments: int) -> NDArray[np.floating]:
    """Points ``(n, segments + 1, 3)`` on the limit surface along half-edges ``(n,)`` of its `patches.elements`."""
    elements = surface.patches.elements
    along = np.stack([np.linspace(0, 1, segments + 1), np.zeros(segments + 1)], axis=1)
    element = elements.face[half_edges]
    corner = half_edges - elements.face_offsets[element]
    return surface.evaluate(element[:, None], along, corner[:, None]).p.reshape(-1, segments + 1, 3)


def _is_extraordinary(topology: Topology) -> NDArray[np.bool_]:
    """``(n_v,)`` whether an inner vertex has a valence other than 4."""
    return ~np.isin(topology.vertex_face_count, (0, 4)) & ~topology.is_border_vertex


# Panels of the figure `creases`, and their titles.
TITLES = {
    "smooth": "smooth\ntags ignored",
    "own": "semi-sharp\nthe cage's own tags",
    "infinite": "infinitely sharp\nevery crease",
}
CAGE_TITLE = "control cage"
HEIGHT = 1.55  # Relative to the width of a picture
CREASE_RATE, INFINITE = 24, 10
LACQUER = {"roughness": 0.3, "specular": 0.5, "clearcoat": 0.6, "clearcoat_gloss": 0.95}
MATERIAL = {"type": "principled", "base_color": {"type": "rgb", "value": [0.55, 0.30, 0.13]}, **LACQUER}
# Colour of the cage's faces in sRGB; colour and radius of its edges by least sharpness. The cage is 2.7 high.
PALE = "#e4e4e1"
EDGES = {0: ("#9aa1ab", 0.006), 1: ("#f2a541", 0.014), 3: ("#2f8f83", 0.014), INFINITE: ("#5b2a86", 0.014)}


def draw_creases(options: FigureOptions) -> list[Path]:
    """Render a cage, and its Catmull-Clark surfaces without creases, with them, and with infinitely sharp ones."""
    stage = staging.load_stage("creases", width=options.resolution, height=round(HEIGHT * options.resolution))
    cage = ControlCage.from_file(example_file("cages/rook.obj"))
    if options.cage:
        cage = staging.in_view(staging.read(options.cage), stage.sensors()[0])
        if not cage.tags.edges.any():
            raise FigureError(f'"{options.cage}" has no creases; expected a cage with some')
    scenes = {CAGE_TITLE: staging.staged(stage, **_cage_shapes(cage))}
    for name, title in TITLES.items():
        scenes[title] = staging.staged(stage, shape=staging.limit_surface(_tagged(cage, name), CREASE_RATE, MATERIAL))
    figure, axes = panels(options, *rows_of(options, len(scenes)))
    rendered = staging.render_panels(options, axes, scenes.items())
    _draw_legend(axes[0, 0], cage)
    return write_figure(options, "creases", figure, rendered, cage="rook.obj", pictures=[CAGE_TITLE, *TITLES])


def _tagged(cage: ControlCage, name: str) -> ControlCage:
    """The cage without creases, with them, or with infinitely sharp ones, by a name in `TITLES`."""
    if name == "own":
        return cage
    creases = cage.tags.creases(cage.topology)
    creases[:, 2] = 0 if name == "smooth" else INFINITE
    return ControlCage.from_arrays(cage.positions, cage.face_sizes, cage.face_vertices, creases=creases)


def _cage_shapes(cage: ControlCage) -> SceneNode:
    # Each triangle has separate vertices, so that no normals are averaged.
    corners = cage.positions[cage.triangles.ravel()]
    mesh = staging.make_mesh(corners, np.arange(len(corners)).reshape(-1, 3), staging.paint(PALE))
    t, half_edges = cage.topology, cage.topology.edge_half_edge
    ends = t.face_vertices[np.stack([half_edges, t.next[half_edges]], axis=1)]
    sharpness = cage.tags.edges[half_edges]
    looks = [EDGES[max(least for least in EDGES if least <= value)] for value in sharpness]
    return {"faces": mesh, **staging.edge_rods(cage, ends, sharpness, looks)}


def labels(sharpness: NDArray[np.floating]) -> dict[int, str]:
    """Labels of the ranges of sharpness that begin at the values in `EDGES`."""
    ranges = {}
    for least, end in itertools.pairwise([*EDGES, np.inf]):
        values = sharpness[(sharpness >= least) & (sharpness < end) & (sharpness > 0)]
        if len(values):
            ends = dict.fromkeys(f"{value:g}" for value in (values.min(), values.max()))
            ranges[int(least)] = "∞" if least == INFINITE else "\u2013".join(ends)
    return ranges


def _draw_legend(axis: Axes, cage: ControlCage) -> None:
    shown = labels(cage.tags.edges)
    # Squares, as a line before a number looks like a minus sign.
    square = partial(Line2D, [], [], linestyle="none", marker="s", markersize=4)
    handles = [square(color=EDGES[least][0], label=label) for least, label in shown.items()]
    handles.insert(0, Line2D([], [], linestyle="none", label="sharpness"))
    spaces = {"handlelength": 0.9, "handletextpad": 0.3, "columnspacing": 0.9, "borderaxespad": 0.1}
    legend = axis.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0), ncols=len(handles), **spaces)
    legend.set_in_layout(False)  # Other panels' captions reserve its room
