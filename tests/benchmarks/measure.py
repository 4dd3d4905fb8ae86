"""What `python tests/benchmarks` measures: each work some times, of which the first one is cold in its process.

A work reads its cage and returns what is repeated, a function of the clock.
"""

import tempfile
from functools import wraps
from pathlib import Path

# Before Dr.Jit, so that it finds an LLVM library that works; it registers the shape, too.
import mitsuba_subdivision as msub

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
from cages import read_bin


def repeated(begin):
    """A work for `measured`; what one time has made is gone when the next begins."""

    @wraps(begin)
    def work(clock, files, rate, repeats, *words):
        with tempfile.TemporaryDirectory() as folder:
            once = begin(files, rate, folder, *words)
            for _ in range(repeats):
                clock.lap()
                once(clock)

    return work


@repeated
def total(files, rate, _folder):
    """From a cage in memory to points and normals in memory, and again after control points moved."""
    from drjit.llvm.ad import Float
    from mitsuba_subdivision.kernels.vertex_kernel import VertexKernel

    positions, quads = read_bin(files["bin"])

    def once(clock):
        surface = msub.LimitSurface(msub.ControlCage(positions, quads))
        kernel = VertexKernel(surface.sampling(rate), Float)
        points = Float(surface.cage.positions.ravel())
        vertices = computed(kernel(points))
        clock.lap("total")
        moved = computed(points + 0.001)
        # Their memory is used again, as the peers do.
        del vertices
        clock.lap()
        _ = computed(kernel(moved))
        clock.lap("update")

    return once


@repeated
def stages(files, rate, _folder):
    from drjit.llvm.ad import Float
    from mitsuba_subdivision.kernels.vertex_kernel import VertexKernel
    from mitsuba_subdivision.mesh.connectivity import Topology

    positions, quads = read_bin(files["bin"])

    def once(clock):
        msub.ControlCage.from_file(files["obj"])
        clock.lap("read, with validation")
        topology = Topology(len(positions), np.full(len(quads), 4), quads.ravel())
        for name in ("edge", "twin", "vertex_half_edge", "open_fan_start"):
            getattr(topology, name)
        clock.lap("connectivity")
        cage = msub.ControlCage(positions, quads)
        clock.lap("validate, with connectivity")
        surface = msub.LimitSurface(cage)
        _ = surface.patches.classes
        clock.lap("patch table")
        table = surface.sampling(rate)
        clock.lap("polynomials of vertices")
        kernel = VertexKernel(table, Float)
        points = computed(Float(cage.positions.ravel()))
        clock.lap("upload")
        vertices = computed(kernel(points))
        clock.lap("evaluation")
        _ = table.triangles, table.element, vertices
        clock.lap("triangles")

    return once


@repeated
def load(files, rate, folder, variant):
    """The shape from files of the cage, text and binary, and the same surface from a dense file, by Mitsuba itself.

    What comes first in the process is the cage's text; only its first time is a cold one.
    """
    mi.set_variant(variant)
    dense = Path(folder) / "dense.ply"

    def once(clock):
        for kind in ("obj", "ply"):
            loaded = mi.load_dict({"type": "subdivision", "filename": files[kind], "tessellation_rate": rate})
            finish(loaded)
            clock.lap(f"{kind.upper()} cage")
            if not dense.exists():
                loaded.write_ply(str(dense))
            del loaded
            clock.lap()
        finish(mi.load_dict({"type": "ply", "filename": str(dense)}))
        clock.lap("dense PLY")

    return once


@repeated
def picture(files, rate, _folder, variant):
    """From a cage in memory to a picture: by vertex shading at a rate, and by exact shading at one segment per edge."""
    mi.set_variant(variant)
    shape = msub.ControlCage(*read_bin(files["bin"])).as_properties(mi) | {"type": "subdivision"}
    sky = np.random.default_rng(0).uniform(0, 9, (64, 128, 3)).astype(np.float32)
    camera = {"fov": 35, "to_world": mi.ScalarTransform4f().look_at([0, -4, 1.5], [0, 0, 0], [0, 0, 1])}
    film = {"type": "hdrfilm", "width": 256, "height": 256, "rfilter": {"type": "box"}}
    rest = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        "sensor": {"type": "perspective", **camera, "film": film},
    }

    def once(clock):
        for shading, its_rate in (("vertex", rate), ("exact", 1)):
            surface = {**shape, "tessellation_rate": its_rate, "shading": shading, "bsdf": {"type": "conductor"}}
            name = f"{shading}, rate {its_rate}"
            clock.lap()
            scene = mi.load_dict({**rest, "surface": surface})
            finish(scene)
            clock.lap(f"{name}: load, with hierarchy")
            for lap in ("first picture", "next picture"):
                np.array(mi.render(scene, spp=16))
                clock.lap(f"{name}: {lap}")
            del scene

    return once


def computed(arrays):
    dr.eval(arrays)
    dr.sync_thread()
    return arrays


def finish(shape):
    shape.bbox()
    dr.sync_thread()
