"""A chess piece whose creases are ignored, as sharp as its file says, or infinitely sharp."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from ..cage import ControlCage
from ..variants import SceneNode
from .figure_scenes import in_8_bits, load_stage, make_mesh, paint, render, staged
from .output import FigureOptions, pyplot, scene_path, write_pixels, write_plot

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TITLES = {
    "smooth": ("smooth", "tags ignored"),
    "own": ("semi-sharp", "the cage's own tags"),
    "infinite": ("infinitely sharp", "every crease"),
}
CAGE_TITLE = ("control cage", "sharpness of its creases")
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
LABELS = {1: "1.2\u20132", 3: "3\u20134", INFINITE: "∞"}
TITLE_SIZE, TEXT_SIZE, LEGEND_SIZE = 14, 12.5, 11.5


def draw(options: FigureOptions) -> list[Path]:
    """Render a cage, and its Catmull-Clark surface without creases, with the cage's own, and with all of them sharp."""
    plt = pyplot()
    cage = ControlCage.from_file(scene_path("creases").parent / "cages/rook.obj")
    stage = load_stage("creases", width=options.resolution, height=round(HEIGHT * options.resolution))
    scenes = {CAGE_TITLE: staged(stage, **_cage_shapes(cage))}
    for name, title in TITLES.items():
        shape = {"type": "subdivision", **_tagged(cage, name).as_properties(mi), "tessellation_rate": RATE}
        scenes[title] = staged(stage, shape=mi.load_dict({**shape, "bsdf": MATERIAL}))
    figure, axes = plt.subplots(1, len(scenes), figsize=(12.2, 12.2 / len(scenes) * HEIGHT + 0.75))
    panels = []
    for (title, scene), axis in zip(scenes.items(), axes, strict=True):
        options.report(", ".join(title))
        pixels = render(scene, options, title[0])[..., :3]
        panels.append(pixels)
        axis.imshow(in_8_bits(pixels), interpolation="lanczos")
        axis.set_title(title[0], fontsize=TITLE_SIZE, fontweight="bold")
        if title != CAGE_TITLE:
            axis.text(0.5, -0.02, title[1], fontsize=TEXT_SIZE, ha="center", va="top", transform=axis.transAxes)
        axis.set_axis_off()
    _draw_legend(axes[0])
    # Matplotlib's layout leaves no room for texts outside of axes without frames.
    figure.subplots_adjust(left=0.005, right=0.995, top=0.935, bottom=0.075, wspace=0.02)
    written = write_plot(options, "creases", figure, "png", dpi=110)
    metadata = {"pictures": [CAGE_TITLE[0], *TITLES], "spp": options.spp}
    return written + write_pixels(options, "creases", np.concatenate(panels, axis=1), metadata)


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
    topology, sharpness = cage.topology, cage.tags.edges
    # The sharpest edge comes last: a vertex keeps the joint of that edge.
    for half_edge in sorted(topology.edge_half_edge, key=lambda half_edge: sharpness[half_edge]):
        ends = topology.face_vertices[[half_edge, topology.next[half_edge]]]
        p0, p1 = cage.positions[ends].tolist()
        colour, radius = EDGES[max(least for least in EDGES if least <= sharpness[half_edge])]
        rod = {"radius": radius, "bsdf": paint(colour)}
        shapes[f"edge{half_edge}"] = {"type": "cylinder", "p0": p0, "p1": p1, **rod}
        shapes |= {
            f"joint{end}": {"type": "sphere", "center": at, **rod} for end, at in zip(ends, (p0, p1), strict=True)
        }
    return shapes


def _draw_legend(axis: Axes) -> None:
    """Draw the colours of sharpness below the cage."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=EDGES[least][0], linewidth=3.5, label=text) for least, text in LABELS.items()]
    handles.insert(0, Line2D([], [], linestyle="none", label="sharpness"))
    axis.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        ncols=len(handles),
        fontsize=LEGEND_SIZE,
        frameon=False,
        handlelength=0.9,
        handletextpad=0.3,
        columnspacing=0.9,
        borderaxespad=0.1,
    )
