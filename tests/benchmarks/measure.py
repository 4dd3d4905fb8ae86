"""One measurement in a process of its own; prints a line of JSON. Called by ``python tests/benchmarks``.

measure.py total|stages|mesh|load|picture CAGE.obj CAGE.bin RATE REPEATS VARIANT
"""

from __future__ import annotations

import json
import resource
import sys
import time
from contextlib import suppress
from pathlib import Path

# Before Dr.Jit, so that it finds an LLVM library that works; it registers the shape, too.
import mitsuba_subdivision as msub
import numpy as np
from cages import read_bin


def main(task, obj, binary, rate, repeats, variant):
    """Run one task; times in seconds, memory in MB."""
    run = {"total": total, "stages": stages, "mesh": mesh, "load": load, "picture": picture}[task]
    print(json.dumps(run(obj, binary, int(rate), int(repeats), variant)))


def total(_obj, binary, rate, repeats, _variant):
    """From a cage in memory to points and normals in memory, and again after control points moved.

    The first run is cold in this process; the others keep what the package and Dr.Jit keep from shape to shape.
    """
    import drjit as dr
    from drjit.llvm.ad import Float
    from mitsuba_subdivision.kernels import VertexKernel

    positions, quads = read_bin(binary)
    runs = []
    for _ in range(max(2, repeats)):
        clock = Clock()
        surface = msub.LimitSurface(msub.ControlCage(positions, quads))
        kernel = VertexKernel(surface.sampling(rate), Float)
        points = Float(surface.cage.positions.ravel())
        found = kernel(points)
        dr.eval(found)
        dr.sync_thread()
        clock.lap("total")
        moved = points + 0.001
        dr.eval(moved)
        dr.sync_thread()
        # Their memory is used again, as the peers do.
        del found
        clock.lap()
        found = kernel(moved)
        dr.eval(found)
        dr.sync_thread()
        clock.lap("update")
        runs.append(clock)
        del found, kernel, surface
    return summary(runs)


def stages(obj, binary, rate, repeats, _variant):
    """Each step by itself."""
    import drjit as dr
    from drjit.llvm.ad import Float
    from mitsuba_subdivision.files.obj_reader import read_obj
    from mitsuba_subdivision.kernels import VertexKernel
    from mitsuba_subdivision.mesh.connectivity import Topology

    positions, quads = read_bin(binary)
    runs = []
    for _ in range(max(2, repeats)):
        clock = Clock()
        read_obj(obj)
        clock.lap("read")
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
        clock.lap("device_arrays")
        found = kernel(points)
        dr.eval(found)
        dr.sync_thread()
        clock.lap("evaluation")
        _ = table.triangles, table.element
        clock.lap("triangles")
        runs.append(clock)
        del found, kernel
        vertex_count = table.vertex_count
        del table, surface, cage
    result = summary(runs)
    # Points and normals, three floats each, against filling an array of that size.
    evaluation = 24 * vertex_count / result["warm"]["evaluation"]
    return result | {"bandwidth": {"evaluation": evaluation, "fill": fill_bandwidth(6 * vertex_count)}}


def fill_bandwidth(count):
    """Bytes per second of a kernel that does nothing but write floats."""
    import drjit as dr
    from drjit.llvm.ad import Float

    times = []
    for _ in range(4):
        clock = Clock()
        filled = dr.arange(Float, count)
        dr.eval(filled)
        dr.sync_thread()
        clock.lap("fill")
        times.append(clock.seconds["fill"])
        del filled
    return 4 * count / min(times)


def mesh(_obj, binary, rate, repeats, variant):
    """The shape of a cage in memory, and a scene of it with the hierarchy that rays need."""
    import mitsuba as mi

    mi.set_variant(variant)
    shape = {"type": "subdivision", "tessellation_rate": rate}
    shape |= msub.ControlCage(*read_bin(binary)).as_properties(mi)
    runs = []
    for _ in range(max(2, repeats)):
        clock = Clock()
        loaded = mi.load_dict(shape)
        finish(loaded)
        clock.lap("mesh")
        scene = mi.load_dict({"type": "scene", "surface": loaded})
        finish(loaded)
        clock.lap("hierarchy")
        runs.append(clock)
        del loaded, scene
    return summary(runs)


def load(obj, _binary, rate, repeats, variant):
    """The shape from files of the cage, text and binary, and the same surface from a dense file, by Mitsuba itself.

    What comes first in the process is the cage's text; only its first time is a cold one.
    """
    import tempfile

    import mitsuba as mi

    mi.set_variant(variant)
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        dense = str(Path(folder) / "dense.ply")
        for _ in range(max(2, repeats)):
            clock = Clock()
            for name, filename in (("OBJ cage", obj), ("PLY cage", str(Path(obj).with_suffix(".ply")))):
                loaded = mi.load_dict({"type": "subdivision", "filename": filename, "tessellation_rate": rate})
                finish(loaded)
                clock.lap(name)
                if not Path(dense).exists():
                    loaded.write_ply(dense)
                del loaded
                clock.lap()
            finish(mi.load_dict({"type": "ply", "filename": dense}))
            clock.lap("dense PLY")
            runs.append(clock)
    return summary(runs)


def picture(_obj, binary, rate, repeats, variant):
    """From a cage in memory to a picture: by vertex shading at a rate, and by exact shading at one segment per edge."""
    import mitsuba as mi

    mi.set_variant(variant)
    shape = msub.ControlCage(*read_bin(binary)).as_properties(mi)
    sky = np.random.default_rng(0).uniform(0, 9, (64, 128, 3)).astype(np.float32)
    rest = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        "sensor": {
            "type": "perspective",
            "fov": 35,
            "to_world": mi.ScalarTransform4f().look_at([0, -4, 1.5], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 256, "height": 256, "rfilter": {"type": "box"}},
        },
    }
    runs = []
    for _ in range(max(2, repeats)):
        clock = Clock()
        for shading, own_rate in (("vertex", rate), ("exact", 1)):
            surface = {"type": "subdivision", **shape, "tessellation_rate": own_rate, "shading": shading}
            name = f"{shading}, rate {own_rate}"
            clock.lap()
            scene = mi.load_dict({**rest, "surface": {**surface, "bsdf": {"type": "conductor"}}})
            finish(scene)
            clock.lap(f"{name}: load, with hierarchy")
            for lap in ("first picture", "next picture"):
                np.array(mi.render(scene, spp=16))
                clock.lap(f"{name}: {lap}")
            del scene
        runs.append(clock)
    return summary(runs)


def finish(shape):
    """Wait for all that the shape has started."""
    import drjit as dr

    shape.bbox()
    dr.sync_thread()


class Clock:
    """Seconds, and peak resident memory in MB, of laps.

    Attributes
    ----------
    seconds, memory : dict of str to float
    peak : float
        Of all laps.
    """

    def __init__(self):
        self.seconds, self.memory, self.peak = {}, {}, 0.0
        self._start()

    def lap(self, name=None):
        """End a lap; without a name its time does not count."""
        now, memory = time.perf_counter(), peak_memory()
        self.peak = max(self.peak, memory)
        if name:
            self.seconds[name], self.memory[name] = now - self._last, memory
        self._start()

    def _start(self):
        forget_peak_memory()
        self._last = time.perf_counter()


def summary(runs):
    """Of the first run, and the best of the others; of these, each lap's peak memory, and the highest of all."""
    cold, *warm = runs
    return {
        "cold": cold.seconds,
        "warm": {name: min(run.seconds[name] for run in warm) for name in cold.seconds},
        "memory": {name: max(run.memory[name] for run in warm) for name in cold.memory},
        "peak": max(run.peak for run in runs),
    }


def peak_memory():
    """Peak resident memory of this process in MB, where Linux tells: since it was last forgotten."""
    if sys.platform == "linux" and "VmHWM:" in (status := Path("/proc/self/status").read_text()):
        return int(status.split("VmHWM:")[1].split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def forget_peak_memory():
    """Begin anew from the memory in use, on Linux."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


if __name__ == "__main__":
    main(*sys.argv[1:])
