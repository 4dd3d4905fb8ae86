"""One measurement in a process of its own; prints a line of JSON. Called by ``python tests/benchmarks``.

measure.py total|stages|load|picture CAGE.obj CAGE.bin RATE REPEATS VARIANT
"""

import json
import sys
import tempfile
from pathlib import Path

# Before Dr.Jit, so that it finds an LLVM library that works; it registers the shape, too.
import mitsuba_subdivision as msub

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
from cages import read_bin
from processes import Clock


def main(task, obj, binary, rate, repeats, variant):
    """Run a task some times: the first run is cold in this process. Times in seconds, memory in MB."""
    begin = {"total": total, "stages": stages, "load": load, "picture": picture}[task]
    clocks = []
    with tempfile.TemporaryDirectory() as folder:
        run = begin(obj, binary, int(rate), variant, folder)
        for _ in range(max(2, int(repeats))):
            clocks.append(Clock())
            run(clocks[-1])
    cold, *warm = clocks
    result = {
        "cold": {name: seconds[0] for name, seconds in cold.seconds.items()},
        "warm": {name: min(clock.seconds[name][0] for clock in warm) for name in cold.seconds},
        "memory": {name: max(clock.memory[name] for clock in warm) for name in cold.memory},
        "peak": max(clock.peak for clock in clocks),
    }
    print(json.dumps(result))


def total(_obj, binary, rate, _variant, _folder):
    """From a cage in memory to points and normals in memory, and again after control points moved."""
    from drjit.llvm.ad import Float
    from mitsuba_subdivision.kernels.vertex_kernel import VertexKernel

    positions, quads = read_bin(binary)

    def run(clock):
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

    return run


def stages(obj, binary, rate, _variant, _folder):
    from drjit.llvm.ad import Float
    from mitsuba_subdivision.kernels.vertex_kernel import VertexKernel
    from mitsuba_subdivision.mesh.connectivity import Topology

    positions, quads = read_bin(binary)

    def run(clock):
        msub.ControlCage.from_file(obj)
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
        points = Float(cage.positions.ravel())
        dr.eval(points)
        clock.lap("upload")
        vertices = computed(kernel(points))
        clock.lap("evaluation")
        _ = table.triangles, table.element, vertices
        clock.lap("triangles")

    return run


def load(obj, _binary, rate, variant, folder):
    """The shape from files of the cage, text and binary, and the same surface from a dense file, by Mitsuba itself.

    What comes first in the process is the cage's text; only its first time is a cold one.
    """
    mi.set_variant(variant)
    dense = Path(folder) / "dense.ply"

    def run(clock):
        for name, filename in (("OBJ cage", obj), ("PLY cage", str(Path(obj).with_suffix(".ply")))):
            loaded = mi.load_dict({"type": "subdivision", "filename": filename, "tessellation_rate": rate})
            finish(loaded)
            clock.lap(name)
            if not dense.exists():
                loaded.write_ply(str(dense))
            del loaded
            clock.lap()
        finish(mi.load_dict({"type": "ply", "filename": str(dense)}))
        clock.lap("dense PLY")

    return run


def picture(_obj, binary, rate, variant, _folder):
    """From a cage in memory to a picture: by vertex shading at a rate, and by exact shading at one segment per edge."""
    mi.set_variant(variant)
    shape = msub.ControlCage(*read_bin(binary)).as_properties(mi) | {"type": "subdivision"}
    sky = np.random.default_rng(0).uniform(0, 9, (64, 128, 3)).astype(np.float32)
    camera = {"fov": 35, "to_world": mi.ScalarTransform4f().look_at([0, -4, 1.5], [0, 0, 0], [0, 0, 1])}
    film = {"type": "hdrfilm", "width": 256, "height": 256, "rfilter": {"type": "box"}}
    rest = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        "sensor": {"type": "perspective", **camera, "film": film},
    }

    def run(clock):
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

    return run


def computed(arrays):
    """Arrays of Dr.Jit that are in memory."""
    dr.eval(arrays)
    dr.sync_thread()
    return arrays


def finish(shape):
    """Wait for all that the shape has started."""
    shape.bbox()
    dr.sync_thread()


if __name__ == "__main__":
    main(*sys.argv[1:])
