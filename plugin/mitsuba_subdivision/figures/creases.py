"""A chess piece whose creases are ignored, as sharp as its file says, or infinitely sharp."""

from __future__ import annotations

import itertools
from pathlib import Path

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from .. import example_file
from ..cage import ControlCage
from ..variants import SceneNode
from .output import FigureError, FigureOptions, panels, rows_of, write_figure
from .own_cage import fitted, read
from .staging import edge_rods, load_stage, make_mesh, paint, render_panels, staged

TITLES = {
    "smooth": "smooth\ntags ignored",
    "own": "semi-sharp\nthe cage's own tags",
    "infinite": "infinitely sharp\nevery crease",
}
CAGE_TITLE = "control cage"
# Height of the images, in widths.
HEIGHT = 1.55
RATE = 24
INFINITE = 10
MATERIAL = {
    "type": "principled",
    "base_color": {"type": "rgb", "value": [0.55, 0.30, 0.13]},
    "roughness": 0.3,
    "specular": 0.5,
    "clearcoat": 0.6,
    "clearcoat_gloss": 0.95,
}
# Colour of the cage's faces in sRGB; colour and radius of its edges, from this sharpness on. The cage is 2.7 high.
PALE = "#e4e4e1"
EDGES = {0: ("#9aa1ab", 0.006), 1: ("#f2a541", 0.014), 3: ("#e0602a", 0.014), INFINITE: ("#a3123f", 0.014)}


def draw(options: FigureOptions) -> list[Path]:
    """Render a cage, and its Catmull-Clark surface without creases, with the cage's own, and with all of them sharp."""
    cage = ControlCage.from_file(example_file("cages/rook.obj"))
    if options.cage:
        cage = fitted(read(options.cage), cage.positions.min(axis=0), cage.positions.max(axis=0))
        if not cage.tags.edges.any():
            raise FigureError(f'"{options.cage}" has no creases; expected a cage with some')
    stage = load_stage("creases", width=options.resolution, height=round(HEIGHT * options.resolution))
    scenes = {CAGE_TITLE: staged(stage, **_cage_shapes(cage))}
    for name, title in TITLES.items():
        shape = {"type": "subdivision", **_tagged(cage, name).as_properties(mi), "tessellation_rate": RATE}
        scenes[title] = staged(stage, shape=mi.load_dict({**shape, "bsdf": MATERIAL}))
    figure, axes = panels(options, *rows_of(options, len(scenes)))
    rendered = render_panels(options, axes, scenes.items())
    _draw_legend(axes[0, 0], cage)
    return write_figure(options, "creases", figure, rendered, pictures=[CAGE_TITLE, *TITLES])


def _tagged(cage: ControlCage, name: str) -> ControlCage:
    """The cage without creases, with its own, or with all of them infinitely sharp, by a name in `TITLES`."""
    if name == "own":
        return cage
    creases = cage.tags.creases(cage.topology)
    creases[:, 2] = 0 if name == "smooth" else INFINITE
    return ControlCage.from_arrays(cage.positions, cage.face_sizes, cage.face_vertices, creases=creases)


def _cage_shapes(cage: ControlCage) -> SceneNode:
    """Shapes of the cage: flat faces, and edges as rods, which are thick and coloured where they are creases."""
    faces = np.split(cage.face_vertices, np.cumsum(cage.face_sizes)[:-1])
    fans = [(face[0], *pair) for face in faces for pair in itertools.pairwise(face[1:])]
    # Each triangle has three vertices of its own, so that no normals are averaged.
    positions = cage.positions[np.array(fans).ravel()]
    shapes: SceneNode = {"faces": make_mesh(positions, np.arange(len(positions)).reshape(-1, 3), paint(PALE))}
    topology, half_edges = cage.topology, cage.topology.edge_half_edge
    ends = np.stack([topology.face_vertices[half_edges], topology.face_vertices[topology.next[half_edges]]], axis=1)
    sharpness = cage.tags.edges[half_edges]
    looks = [EDGES[max(least for least in EDGES if least <= value)] for value in sharpness]
    return shapes | edge_rods(cage, ends, sharpness, looks)


def labels(sharpness: NDArray[np.floating]) -> dict[int, str]:
    """Ranges of the sharpness of creases by their least values in `EDGES`."""
    ends = [*EDGES, np.inf]
    ranges = {}
    for least, end in itertools.pairwise(ends):
        values = np.unique(sharpness[(sharpness >= least) & (sharpness < end) & (sharpness > 0)])
        if len(values):
            ends_of_range = dict.fromkeys(f"{value:g}" for value in values[[0, -1]])
            ranges[int(least)] = "∞" if least == INFINITE else "\u2013".join(ends_of_range)
    return ranges


def _draw_legend(axis: Axes, cage: ControlCage) -> None:
    """Draw the colours of sharpness below the cage."""
    shown = labels(cage.tags.edges)
    handles = [Line2D([], [], color=EDGES[least][0], linewidth=2, label=label) for least, label in shown.items()]
    handles.insert(0, Line2D([], [], linestyle="none", label="sharpness"))
    legend = axis.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        ncols=len(handles),
        handlelength=0.9,
        handletextpad=0.3,
        columnspacing=0.9,
        borderaxespad=0.1,
    )
    # Captions of other panels reserve the room for it.
    legend.set_in_layout(False)
