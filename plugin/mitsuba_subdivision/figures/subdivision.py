"""Subdivision of a Catmull-Clark cage: irregular patches shrink, and the number of extraordinary points stays."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..evaluation.patch_tree import lattice_stencils
from ..mesh.connectivity import Topology
from ..surface import LimitSurface
from .figure_scenes import load_stage, make_mesh, on_white, render, staged
from .output import FigureError, FigureOptions, panels, rows_of, scene_path, show, write_pixels, write_plot
from .own_cage import in_ball, read
from .projection import project, visible, visible_runs

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEVELS = 4
# Of the ball that fills the picture, for cages of users.
RADIUS = 1.9
REGULAR, IRREGULAR = (0.9, 0.9, 0.89), (0.22, 0.24, 0.27)
# Segments of an edge of level 0, whose ends are tested for visibility; an edge of the next level has half as many.
EDGE_SEGMENTS = 24
# Segments per edge of a patch of the last level, for its area and for the render of the limit surface.
RATE = 6


def draw(options: FigureOptions) -> list[Path]:
    """Draw a cage of 3-, 4-, 5- and 6-gons at levels 0 to 3, its irregular patches grey, and its limit surface."""
    stage = load_stage("subdivision", resolution=options.resolution)
    cages = [ControlCage.from_file(scene_path("subdivision").parent / "cages/propeller.obj")]
    if options.cage:
        cages = [in_ball(read(options.cage), RADIUS)]
    while len(cages) < LEVELS:
        cages.append(cages[-1].refined())
    counts = {extraordinary_count(cage.topology) for cage in cages}
    if len(counts) != 1:
        found = f"{sorted(counts)} extraordinary points at levels 0 to {LEVELS - 1}"
        raise FigureError(f"{found}; expected as many at each")
    figure, axes = panels(options, *rows_of(options, LEVELS + 1))
    for axis in axes.flat[LEVELS + 1 :]:
        axis.set_axis_off()
    axes, rendered = axes.flat[: LEVELS + 1], []
    for level, (cage, axis) in enumerate(zip(cages, axes, strict=False)):
        surface = LimitSurface(cage)
        regular = regular_elements(surface)
        share = area_share(surface, regular)
        options.report(f"level {level}: {cage.face_count} faces, {100 * share:.1f} % of the area regular")
        pixels, scene = _render_cage(stage, cage, regular, options, f"level {level}")
        lines, points = _edges(cage, EDGE_SEGMENTS >> level), _extraordinary_points(cage)
        _draw(axis, scene, pixels, lines, points, 0.55 - 0.12 * level, options.resolution)
        axis.set_title(f"level {level}")
        axis.set_xlabel(f"{100 * share:.{0 if share in (0, 1) else 1}f} % regular")
        rendered.append(pixels)
    options.report("limit surface")
    limit = LimitSurface(cages[-1])
    pixels, scene = _render_limit(stage, limit, options)
    lines, points = _isolines(limit, EDGE_SEGMENTS >> (LEVELS - 1)), _limit_points(limit)
    _draw(axes[-1], scene, pixels, lines, points, 0.17, options.resolution)
    axes[-1].set_title("limit surface")
    axes[-1].set_xlabel(f"regular but for {counts.pop()} points")
    rendered.append(pixels)
    written = write_plot(options, "subdivision", figure)
    metadata = {"levels": LEVELS, "spp": options.spp}
    return written + write_pixels(options, "subdivision", np.concatenate(rendered, axis=1)[..., :3], metadata)


def extraordinary_count(topology: Topology) -> int:
    """Number of inner vertices of valence other than 4, and of faces but quads. A refinement keeps this number."""
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
    """Share of the chosen elements in the area of the limit surface."""
    found = surface.tessellate(RATE)
    a, b, c = (found.positions[found.triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return float(area[elements[found.element]].sum() / area.sum())


def _render_cage(
    stage: mi.Scene, cage: ControlCage, regular: NDArray[np.bool_], options: FigureOptions, name: str
) -> tuple[NDArray[np.float32], mi.Scene]:
    """Render the cage as a polyhedron with flat faces; returns the pixels and the scene."""
    t = cage.topology
    # Every face becomes a fan of triangles around its centre. Its vertices are its own, and have its normal.
    corners = cage.positions[t.face_vertices]
    centres = np.add.reduceat(corners, t.face_offsets[:-1]) / t.face_sizes[:, None]
    ends = cage.positions[t.face_vertices[t.next]]
    cross = np.cross(corners - centres[t.face], ends - centres[t.face])
    normals = np.add.reduceat(cross, t.face_offsets[:-1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    half_edges = np.arange(t.half_edge_count)
    mesh = make_mesh(
        np.concatenate([corners, centres]),
        np.stack([half_edges, t.next, t.half_edge_count + t.face], axis=1),
        {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "face_color"}},
        normals=np.concatenate([normals[t.face], normals]),
        face_colours=np.where(regular[:, None], REGULAR, IRREGULAR)[t.face],
    )
    scene = staged(stage, mesh=mesh)
    return render(scene, options, name), scene


def _render_limit(
    stage: mi.Scene, surface: LimitSurface, options: FigureOptions
) -> tuple[NDArray[np.float32], mi.Scene]:
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(REGULAR)}}
    shape = {"type": "subdivision", **surface.cage.as_properties(mi), "tessellation_rate": RATE, "bsdf": bsdf}
    scene = staged(stage, surface=mi.load_dict(shape))
    return render(scene, options, "limit surface"), scene


def _edges(cage: ControlCage, segments: int) -> NDArray[np.float64]:
    """Points along the straight edges of a cage: ``(n_e, segments + 1, 3)``."""
    t = cage.topology
    begin, end = t.face_vertices[t.edge_half_edge], t.face_vertices[t.next[t.edge_half_edge]]
    along = np.linspace(0, 1, segments + 1)[None, :, None]
    return (1 - along) * cage.positions[begin, None] + along * cage.positions[end, None]


def _isolines(surface: LimitSurface, segments: int) -> NDArray[np.float64]:
    """The edges on the limit surface, where they are lines of constant u or v: ``(n_e, segments + 1, 3)``."""
    t = surface.cage.topology
    along = np.stack([np.linspace(0, 1, segments + 1), np.zeros(segments + 1)], axis=1)
    face = np.repeat(t.face[t.edge_half_edge], segments + 1)
    corner = np.repeat(t.edge_half_edge, segments + 1) - t.face_offsets[face]
    found = surface.evaluate(face, np.tile(along, (t.edge_count, 1)), corner)
    return found.p.reshape(-1, segments + 1, 3).astype(np.float64, copy=False)


def _is_extraordinary(topology: Topology) -> NDArray[np.bool_]:
    """``(n_v,)`` whether a vertex inside has another valence than 4."""
    return (topology.vertex_face_count != 4) & ~topology.is_border_vertex


def _extraordinary_points(cage: ControlCage) -> NDArray[np.float64]:
    t = cage.topology
    centres = np.add.reduceat(cage.positions[t.face_vertices], t.face_offsets[:-1]) / t.face_sizes[:, None]
    return np.concatenate([cage.positions[_is_extraordinary(t)], centres[t.face_sizes != 4]])


def _limit_points(surface: LimitSurface) -> NDArray[np.float64]:
    t = surface.cage.topology
    half_edge = t.vertex_half_edge[_is_extraordinary(t)]
    face = t.face[half_edge]
    found = surface.evaluate(face, np.zeros((len(face), 2)), half_edge - t.face_offsets[face])
    return found.p.astype(np.float64, copy=False)


def _draw(
    axis: Axes,
    scene: mi.Scene,
    pixels: NDArray[np.float32],
    lines: NDArray[np.float64],
    points: NDArray[np.float64],
    width: float,
    resolution: int,
) -> None:
    """Draw a rendered image, and the lines and points on its surface that the camera sees."""
    from matplotlib.collections import LineCollection

    show(axis, on_white(pixels))
    runs = visible_runs(scene, lines, resolution)
    axis.add_collection(LineCollection(runs, colors="#14181c", linewidths=width, capstyle="round"))
    seen = project(scene.sensors()[0], points[visible(scene, points)], resolution)
    axis.plot(*seen.T, "o", color="#d1432b", markersize=2, markeredgecolor="white", markeredgewidth=0.2)
    # The part of the square image that the surface fills.
    axis.set_xlim(0, resolution)
    axis.set_ylim(0.84 * resolution, 0.13 * resolution)
