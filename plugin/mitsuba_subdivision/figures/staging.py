"""Cages of users in place of a figure's own, surfaces and meshes in scenes, renders, and projections of points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from .. import example_file
from ..cage import ControlCage
from ..device_arrays import upload
from ..mitsuba_mesh import mitsuba_mesh, points_at
from ..regression.scene import load_scene, render_parts
from ..srgb import decoded
from ..surface import LimitSurface
from ..variants import SceneNode
from .output import FigureError, FigureOptions, panels, show, write_figure

PART_SAMPLES = 1 << 26  # Samples of one part, which determine a render's memory and its steps of progress
WIDER, HEIGHT = 2.25, 0.625  # Width of single pictures relative to a panel's, and height relative to that
LIFT = 2e-3  # Offset of points from their surface for visibility tests, relative to the camera's distance
REFINEMENTS = 2  # Enough to isolate every extraordinary vertex
FAR = 4  # Distance from the vertex beyond which faces are holes, relative to the shortest edge there
# Sizes of a cage before a camera, the largest first, and margin at each side of the picture.
SCALES, MARGIN = np.geomspace(4, 0.4, 100), 0.04
SMALLEST = 1e-300  # Size of a cage of equal points


def load_stage(name: str, **parameters: str | float) -> mi.Scene:
    """Load a scene of the figures, with values for some of its parameters."""
    # With other filters than the box, the order of sums, and so the last bits, vary.
    return load_scene(example_file(f"{name}.xml"), parameters, "box").scene


def make_mesh(
    positions: NDArray[np.floating], triangles: NDArray[np.integer], bsdf: SceneNode, **buffers: NDArray[np.floating]
) -> mi.Mesh:
    """Make a mesh with buffers of `mitsuba_mesh`; by default, vertex normals are averages of the triangles'."""
    averages = "vertex_normals" not in buffers
    buffers["vertex_positions"] = positions
    return mitsuba_mesh("figure", triangles, buffers, bsdf=mi.load_dict(bsdf), averages_normals=averages)


def limit_surface(cage: ControlCage, rate: int, bsdf: SceneNode | mi.BSDF, **parameters: Any) -> mi.Shape:
    """The limit surface of a cage, with ``rate`` segments per edge."""
    given = {**cage.as_properties(mi), "tessellation_rate": rate, "bsdf": bsdf, **parameters}
    return mi.load_dict({"type": "subdivision", **given})


def staged(stage: mi.Scene, shapes: Sequence[mi.Shape] | None = None, **objects: Any) -> mi.Scene:
    """Make a scene with the camera, integrator, emitters and some or all shapes of another, and more objects."""
    children = {f"shape{i}": shape for i, shape in enumerate(stage.shapes() if shapes is None else shapes)}
    apart = [emitter for emitter in stage.emitters() if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)]
    children |= {f"emitter{i}": emitter for i, emitter in enumerate(apart)}
    seen_by = {"integrator": stage.integrator(), "sensor": stage.sensors()[0]}
    return mi.load_dict({"type": "scene", **seen_by, **children, **objects})


def render(scene: mi.Scene, options: FigureOptions, name: str) -> NDArray[np.float32]:
    """Render with the samples per pixel of the options: ``(height, width, channels)``, linear."""
    width, height = scene.sensors()[0].film().crop_size()
    return render_parts(scene, _parts(options.spp, PART_SAMPLES // (int(width) * int(height))), what=name)


def _parts(spp: int, most: int) -> list[int]:
    """Split samples per pixel into powers of 4, which stratified samplers can spread evenly over a pixel."""
    parts: list[int] = []
    while rest := spp - sum(parts):
        parts.append(4 ** ((max(min(rest, most), 1).bit_length() - 1) // 2))
    return parts


def picture_size(options: FigureOptions) -> tuple[int, int]:
    """Width and height in pixels of a single picture."""
    width = round(WIDER * options.resolution)
    return width, round(HEIGHT * width)


def draw_picture(
    options: FigureOptions, name: str, pixels: NDArray[np.float32], columns: Sequence[float] = (), **metadata: Any
) -> list[Path]:
    """Write linear RGB pixels as a figure of one picture, with white lines at some of its columns."""
    figure, ((axis,),) = panels(options, 1, 1)
    show(axis, in_8_bits(pixels))
    axis.set_position((0, 0, 1, 1))
    figure.set_figheight(HEIGHT * figure.get_figwidth())
    for column in columns:
        axis.axvline(column - 0.5, color="white")
    return write_figure(options, name, figure, [pixels], pixels=pixels.shape[1], layouts=0, **metadata)


def on_white(pixels: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Composite linear RGBA pixels, premultiplied by alpha, on white: 8-bit sRGB."""
    return in_8_bits(pixels[..., :3] + (1 - np.clip(pixels[..., 3:], 0, 1)))


def in_8_bits(pixels: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Convert linear RGB pixels to 8-bit sRGB."""
    return np.array(mi.util.convert_to_bitmap(np.ascontiguousarray(pixels)))


def paint(colour: str | tuple[float, float, float]) -> SceneNode:
    """Diffuse material of an sRGB colour."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": decoded(np.array(to_rgb(colour))).tolist()}}


def edge_rods(
    cage: ControlCage, edges: NDArray[np.integer], sharpness: NDArray[np.floating], looks: Sequence[tuple[Any, float]]
) -> SceneNode:
    """Rods along edges of a cage, given by their ends ``(n, 2)``, with joints there; by colours in sRGB and radii."""
    shapes: SceneNode = {}
    for edge in np.argsort(sharpness, kind="stable"):  # The sharpest edge comes last, so that a vertex keeps its joint
        colour, radius = looks[edge]
        rod = {"radius": radius, "bsdf": paint(colour)}
        p0, p1 = cage.positions[edges[edge]].tolist()
        shapes[f"edge{edge}"] = {"type": "cylinder", "p0": p0, "p1": p1, **rod}
        for end, at in zip(edges[edge], (p0, p1), strict=True):
            shapes[f"joint{end}"] = {"type": "sphere", "center": at, **rod}
    return shapes


def split_quads(quads: NDArray[np.integer]) -> NDArray[np.integer]:
    """Two triangles for each quadrilateral: ``(2 m, 3)`` vertices of ``(m, 4)``."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def grid_points(along: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points ``(n^2, 2)`` of a square grid with these coordinates, row by row."""
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


def grid_triangles(segments: int, count: int) -> NDArray[np.integer]:
    """Triangles of some square grids of ``segments + 1`` points in each row and column, numbered row by row."""
    corner = np.arange(count * (segments + 1) ** 2).reshape(count, segments + 1, segments + 1)
    quads = [corner[:, :-1, :-1], corner[:, :-1, 1:], corner[:, 1:, 1:], corner[:, 1:, :-1]]
    return np.concatenate([split_quads(quad.reshape(-1, 4)) for quad in np.stack(quads, axis=-1)])


def render_panels(options: FigureOptions, axes: Any, scenes: Iterable[tuple[str, Any]]) -> list[NDArray[np.float32]]:
    """Render a scene in each panel, by titles whose second line is the caption; returns the pictures."""
    rendered = []
    for (title, scene), axis in zip(scenes, axes.flat, strict=True):
        name, _, caption = title.partition("\n")
        rendered.append(render(scene, options, name)[..., :3])
        show(axis, in_8_bits(rendered[-1]), name, caption)
    return rendered


def project(sensor: mi.Sensor, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Pixel coordinates ``(.., n, 2)`` of world points ``(.., n, 3)``."""
    parameters = mi.traverse(sensor)
    camera = points_at(points, np.linalg.inv(camera_matrix(sensor)))
    # Mitsuba's cameras look along +z, with x to the left and y up. An orthographic camera covers -1 to 1 in x and y.
    half_width = np.ones_like(camera[..., 2:])
    if "x_fov" in parameters:
        half_width = camera[..., 2:] * np.tan(np.radians(float(np.array(parameters["x_fov"]).item()) / 2))
    size = np.array(sensor.film().crop_size())
    return (size - camera[..., :2] / half_width * size[0]) / 2


def visible(scene: mi.Scene, points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether each point ``(n, 3)`` is visible to the scene's orthographic camera."""
    to_world = camera_matrix(scene.sensors()[0])
    backward = -to_world[:3, 2]
    start = points + LIFT * points_at(points, np.linalg.inv(to_world))[:, 2:] * backward
    towards = mi.Vector3f(*(backward / np.linalg.norm(backward)).tolist())
    if "scalar" in str(mi.variant()) or not len(points):
        return np.array([not scene.ray_test(mi.Ray3f(mi.Point3f(p), towards)) for p in start], dtype=bool)
    return ~np.array(scene.ray_test(mi.Ray3f(upload(mi.Point3f, start), towards)))


def visible_runs(scene: mi.Scene, lines: NDArray[np.floating]) -> list[NDArray[np.float64]]:
    """Visible parts of polylines ``(m, points, 3)`` in pixels, each ``(.., 2)``."""
    seen = visible(scene, lines.reshape(-1, 3)).reshape(lines.shape[:2])
    positions = project(scene.sensors()[0], lines)
    parts = [np.ma.flatnotmasked_contiguous(np.ma.array(shown, mask=~shown)) for shown in seen]
    runs = [line[part] for line, its_parts in zip(positions, parts, strict=True) for part in its_parts]
    return [run for run in runs if len(run) > 1]


def camera_matrix(sensor: mi.Sensor) -> NDArray[np.float64]:
    """Transform ``(4, 4)`` from the camera to the world."""
    return np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)


def around_vertices(path: Path, most: int) -> dict[str, ControlCage]:
    """A Catmull-Clark cage, renumbered for each of its extraordinary vertices of lowest valences, by their names.

    The vertex is vertex 0, and the first faces lie around it and begin with it. Centres of faces, which are vertices of
    the refined cage, count only if there are no others.
    """
    cage, name = read(path), "valence"
    count = cage.vertex_count
    for refinement in range(REFINEMENTS + 1):
        cage = cage.refined() if refinement else cage
        if fans := _isolated_fans(cage, count):
            break
    else:
        fans, name = _isolated_fans(cage, cage.vertex_count), "centre of a face of"
    if not fans:
        raise FigureError(f'"{path}" has no extraordinary vertex inside of its surface and apart from creases')
    return {f"{name} {valence}": _numbered(cage, fans[valence]) for valence in sorted(fans)[:most]}


def motion(old: tuple[NDArray[np.float64], ...], new: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
    """The similarity ``(4, 4)`` from one frame of `frame` to another."""
    matrix = np.eye(4)
    matrix[:3, :3] = new[1] @ old[1].T * (new[2] / old[2])
    matrix[:3, 3] = new[0] - matrix[:3, :3] @ old[0]
    return matrix


def read(path: Path) -> ControlCage:
    """Read a cage of Catmull-Clark surfaces. Warns about it the first time only."""
    return _read(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _read(path: Path, _modified: int) -> ControlCage:
    cage = ControlCage.from_file(path)
    if cage.scheme not in (None, "catmull_clark"):
        raise FigureError(f'"{path}" names the scheme {cage.scheme}; expected catmull_clark')
    return cage


def frame(surface: LimitSurface, face: int = 0, corner: int = 0) -> tuple[NDArray[np.float64], ...]:
    """Limit point of a vertex, axes (columns: along an edge, across, and the normal), and length of that edge."""
    samples = surface.evaluate(face, [[0.0, 0.0], [1.0, 0.0]], corner)
    normal, along = samples.n[0], samples.dp_du[0] - (samples.dp_du[0] @ samples.n[0]) * samples.n[0]
    along = along / np.linalg.norm(along)
    length = np.asarray(np.linalg.norm(samples.p[1] - samples.p[0]))
    return samples.p[0], np.stack([along, np.cross(normal, along), normal], axis=1), length


def in_view(cage: ControlCage, sensor: mi.Sensor) -> ControlCage:
    """The cage, standing on the ground below the origin, as large as the picture allows."""
    least, most = cage.positions.min(axis=0), cage.positions.max(axis=0)
    standing = cage.positions - least - np.array([0.5, 0.5, 0]) * (most - least)
    standing /= max(np.linalg.norm(standing, axis=1).max(), SMALLEST)
    at = project(sensor, SCALES[:, None, None] * standing) / np.array(sensor.film().crop_size())
    fits = (np.abs(at - 0.5) < 0.5 - MARGIN).all(axis=(1, 2))
    return cage.with_positions(SCALES[fits.argmax()] * standing)


def in_ball(cage: ControlCage, radius: float) -> ControlCage:
    """The cage, scaled into a ball around the origin."""
    centred = cage.positions - (cage.positions.min(axis=0) + cage.positions.max(axis=0)) / 2
    return cage.with_positions(centred * (radius / max(np.linalg.norm(centred, axis=1).max(), SMALLEST)))


def _isolated_fans(cage: ControlCage, end: int) -> dict[int, NDArray[np.integer]]:
    """For each valence, half-edges around an extraordinary vertex before ``end`` whose faces have no other."""
    topology, contents = cage.topology, cage.contents
    if (cage.face_sizes != 4).any():
        return {}
    is_tagged = np.zeros(cage.vertex_count, dtype=bool)
    is_tagged[[*contents.creases[:, :2].astype(int).ravel(), *contents.corners[:, 0].astype(int)]] = True
    is_irregular = (topology.vertex_face_count != 4) | topology.is_border_vertex | is_tagged
    is_apart = is_irregular[topology.face_vertices.reshape(-1, 4)].sum(axis=1) == 1
    offsets, half_edges = topology.vertex_fans
    fans: dict[int, NDArray[np.integer]] = {}
    for vertex in np.flatnonzero((is_irregular & ~is_tagged & (np.diff(offsets) > 0))[:end]):
        fan = half_edges[offsets[vertex] : offsets[vertex + 1]]
        if is_apart[topology.face[fan]].all():
            fans.setdefault(len(fan), fan)
    return fans


def _numbered(cage: ControlCage, fan: NDArray[np.integer]) -> ControlCage:
    """The same cage, with the fan's faces and vertices first; distant faces become holes."""
    contents, faces = cage.contents, cage.face_vertices.reshape(-1, 4)
    vertex, first = cage.face_vertices[fan[0]], fan // 4
    order = np.concatenate([first, np.setdiff1d(np.arange(len(faces)), first)])
    number = np.arange(cage.vertex_count)
    number[[0, vertex]] = vertex, 0
    faces = number[faces[order]]
    for face, half_edge in enumerate(fan):
        faces[face] = np.roll(faces[face], -(half_edge % 4))
    positions = cage.positions[number]
    distance = np.linalg.norm(positions - positions[0], axis=1)
    is_far = distance[faces].min(axis=1) > FAR * distance[faces[: len(fan), 1]].min()
    holes = np.flatnonzero(np.isin(order, contents.holes) | is_far)
    creases, corners = contents.creases.copy(), contents.corners.copy()
    creases[:, :2], corners[:, 0] = number[creases[:, :2].astype(int)], number[corners[:, 0].astype(int)]
    options: dict[str, Any] = {**contents.rules, "creases": creases, "corners": corners, "holes": holes}
    return ControlCage(positions, faces, **options)
