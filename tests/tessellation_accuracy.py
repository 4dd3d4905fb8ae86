"""How many triangles an adaptive tessellation has where a uniform one has the same error.

Chords: the uniform tessellation's largest distance from the surface is measured at points of its triangles, and asked
of the adaptive one. What that gets is measured likewise.

Outlines: the edges of triangles with nothing behind them on one side, as a camera sees them, are compared with those of
a tessellation of 64 segments per edge. Their distance is Hausdorff's, in pixels of a picture 512 pixels wide. The
adaptive tessellation is the coarsest found, of pixel errors in steps of 3 %, whose outline is no further away.
"""

import argparse

# Before Mitsuba, so that Dr.Jit finds an LLVM library that works.
import mitsuba_subdivision

# isort: split
import mitsuba as mi
import numpy as np
from kernels.surfaces import CAGES
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.kernels.locations import TriangleLocations
from mitsuba_subdivision.mitsuba_mesh import mitsuba_mesh
from mitsuba_subdivision.tessellation.criterion import Criterion, Sensor
from mitsuba_subdivision.tessellation.vertex_table import VertexTable
from scipy.spatial import cKDTree
from shapes.scenes import scene_with

SURFACES = {
    **{name: (name, "catmull_clark") for name in ("human", "rook", "barrel", "propeller", "star")},
    **{"star, Doo-Sabin": ("star", "doo_sabin"), "star, Loop": ("star", "loop")},
}
WITH_OUTLINES = ("human", "rook", "barrel")
REFERENCE_RATE = 64
# Points of each triangle that are looked at: of a lattice of so many steps, but for its corners.
STEPS = 4
TRIANGLES_AT_ONCE, WIDTH, FOV = 40_000, 512, 40.0
# Points along outlines, and how far beside them there is nothing, in pixels.
SPACING, BESIDE = 1 / 40, 1 / 100
VIEW = np.array([0.6, -1.1, 0.35])
COARSEST, FINER = 2.0, 0.97


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--surfaces", nargs="+", default=list(SURFACES), choices=SURFACES)
    parser.add_argument("--rate", type=int, default=16, help="of the uniform tessellation (default: 16)")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    print(f"                    uniform, rate {options.rate}            adaptive, as asked        times fewer")
    for name in options.surfaces:
        cage, scheme = SURFACES[name]
        surface = LimitSurface(ControlCage.from_file(CAGES / f"{cage}.obj"), scheme)
        uniform = surface.sampling(options.rate)
        error = chord_error(surface, uniform)
        adaptive = surface.adaptive_sampling(Criterion("chord", error))
        report(f"{name}, chord", uniform, error, adaptive, chord_error(surface, adaptive))
        if name in WITH_OUTLINES:
            outlines, asked = Outlines(surface), COARSEST
            error = outlines.error(uniform)
            while (reached := outlines.error(adaptive := outlines.adaptive(asked))) > error:
                asked *= FINER
            report(f"{name}, outline", uniform, error, adaptive, reached)


def report(name: str, uniform: VertexTable, error: float, adaptive: VertexTable, reached: float) -> None:
    many, few = len(uniform.triangles), len(adaptive.triangles)
    sides = f"{many:8} triangles {error:.5f}   {few:8} triangles {reached:.5f}"
    print(f"{name:<18} {sides} {many / few:8.2f}", flush=True)


def chord_error(surface: LimitSurface, table: VertexTable) -> float:
    """Largest distance of points of triangles from the surface; from below, as no other points are looked at."""
    positions, _ = table.apply(surface.cage.positions)
    i, j = (index.ravel() for index in np.indices((STEPS + 1, STEPS + 1)))
    inside = (i + j <= STEPS) & (np.max([i, j, STEPS - i - j], axis=0) < STEPS)
    weights = np.stack([i, j, STEPS - i - j], axis=1)[inside] / STEPS
    kernel, distances = surface.on_device("llvm_ad_rgb_double"), []
    types, location_of = kernel.types, TriangleLocations(table, kernel.walk)
    for begin in range(0, len(table.triangles), TRIANGLES_AT_ONCE):
        triangles = np.arange(begin, min(begin + TRIANGLES_AT_ONCE, len(table.triangles)))
        points = (weights @ positions[table.triangles[triangles]]).reshape(-1, 3)
        b1, b2 = np.tile(weights[:, 1:], (len(triangles), 1)).T
        start = location_of(types.indices(np.repeat(triangles, len(weights))), types.floats(b1), types.floats(b2))
        distances.append(np.array(kernel.closest(upload(types.vector3, points), start).distance).max())
    return max(distances)


class Outlines:
    """Outlines of a surface's tessellations before a background, as a camera sees them."""

    def __init__(self, surface: LimitSurface) -> None:
        self.surface = surface
        low, high = surface.cage.positions.min(axis=0), surface.cage.positions.max(axis=0)
        self.target = (low + high) / 2
        self.eye = self.target + VIEW * np.linalg.norm(high - low)
        self.pixel = 2 * np.tan(np.radians(FOV) / 2) / WIDTH
        self.reference = self.outline(surface.sampling(REFERENCE_RATE))
        self.tree = cKDTree(self.reference)

    def adaptive(self, pixel_error: float) -> VertexTable:
        sensor = Sensor(self.eye, self.pixel / np.hypot(1, self.pixel * WIDTH / np.sqrt(2)))
        return self.surface.adaptive_sampling(Criterion("chord", pixel_error, sensor, sensor))

    def error(self, table: VertexTable) -> float:
        """Hausdorff distance from the reference, in pixels."""
        outline = self.outline(table)
        there, back = self.tree.query(outline)[0], cKDTree(outline).query(self.reference)[0]
        return max(there.max(), back.max()) / self.pixel

    def outline(self, table: VertexTable) -> np.ndarray:
        """``(n, 2)`` points of the outline in the plane at a distance of one."""
        positions, _ = table.apply(self.surface.cage.positions)
        triangles = table.weld_target[table.triangles]
        a, b, c = positions[triangles].swapaxes(0, 1)
        faces_camera = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - self.eye) < 0
        edges = np.sort(np.concatenate([triangles[:, [i, i - 1]] for i in range(3)]))
        unique, edge = np.unique(edges, axis=0, return_inverse=True)
        front = np.bincount(edge.ravel(), np.tile(faces_camera, 3), minlength=len(unique))
        count = np.bincount(edge.ravel(), minlength=len(unique))
        begin, end = positions[unique[(count == 1) | ((front > 0) & (front < count))]].swapaxes(0, 1)
        step = SPACING * self.pixel * np.linalg.norm(self.target - self.eye)
        parts = np.maximum(1, np.ceil(np.linalg.norm(end - begin, axis=1) / step)).astype(int)
        which = np.repeat(np.arange(len(parts)), parts + 1)
        place = np.arange(len(which)) - np.repeat(np.cumsum(parts + 1) - (parts + 1), parts + 1)
        along = (place / parts[which])[:, None]
        points = (1 - along) * begin[which] + along * end[which]
        seen = points - self.eye
        seen /= np.linalg.norm(seen, axis=1)[:, None]
        beside = np.cross(seen, (end - begin)[which])
        beside /= np.maximum(np.linalg.norm(beside, axis=1), np.finfo(float).tiny)[:, None]
        mesh = mitsuba_mesh("outline", triangles, {"vertex_positions": positions})
        scene = scene_with(mesh=mesh)
        is_free = np.full(len(points), False)
        for side in (BESIDE * self.pixel, -BESIDE * self.pixel):
            directions = upload(mi.Vector3f, seen + side * beside)
            is_free |= ~np.array(scene.ray_test(mi.Ray3f(mi.Point3f(*self.eye.tolist()), directions)))
        forward = self.target - self.eye
        right = np.cross(forward, [0, 0, 1])
        axes = [axis / np.linalg.norm(axis) for axis in (right, np.cross(right, forward), forward)]
        x, y, depth = (seen[is_free] @ np.array(axes).T).T
        return np.stack([x / depth, y / depth], axis=1)


if __name__ == "__main__":
    mitsuba_subdivision.register_variant("llvm_ad_rgb")
    main()
