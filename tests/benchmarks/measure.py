"""One measurement in a process of its own; prints a line of JSON. Called by ``python tests/benchmarks``.

measure.py total|stages|mesh|load|picture CAGE.obj CAGE.bin RATE REPEATS VARIANT
"""

import json
import resource
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

# Before Dr.Jit, so that it finds an LLVM library that works; it registers the shape, too.
import mitsuba_subdivision as msub

# isort: split
import drjit as dr
import mitsuba as mi
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
    from drjit.llvm.ad import Float
    from mitsuba_subdivision.kernels import VertexKernel

    positions, quads = read_bin(binary)

    def run(clock):
        surface = msub.LimitSurface(msub.ControlCage(positions, quads))
        kernel = VertexKernel(surface.sampling(rate), Float)
        points = Float(surface.cage.positions.ravel())
        found = computed(kernel(points))
        clock.lap("total")
        moved = computed(points + 0.001)
        # Their memory is used again, as the peers do.
        del found
        clock.lap()
        _ = computed(kernel(moved))
        clock.lap("update")

    return summary(run, repeats)


def stages(obj, binary, rate, repeats, _variant):
    from drjit.llvm.ad import Float
    from mitsuba_subdivision.files.obj_reader import read_obj
    from mitsuba_subdivision.kernels import VertexKernel
    from mitsuba_subdivision.mesh.connectivity import Topology

    (positions, quads), vertex_counts = read_bin(binary), []

    def run(clock):
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
        found = computed(kernel(points))
        clock.lap("evaluation")
        _ = table.triangles, table.element, found
        clock.lap("triangles")
        vertex_counts.append(table.vertex_count)

    result = summary(run, repeats)
    # Points and normals, three floats each, against filling an array of that size.
    evaluation = 24 * vertex_counts[0] / result["warm"]["evaluation"]
    return result | {"bandwidth": {"evaluation": evaluation, "fill": fill_bandwidth(6 * vertex_counts[0])}}


def fill_bandwidth(count):
    """Bytes per second of a kernel that does nothing but write floats."""
    from drjit.llvm.ad import Float

    def run(clock):
        _ = computed(dr.arange(Float, count))
        clock.lap("fill")

    return 4 * count / summary(run, 4)["warm"]["fill"]


def mesh(_obj, binary, rate, repeats, variant):
    """The shape of a cage in memory, and a scene of it with the hierarchy that rays need."""
    mi.set_variant(variant)
    shape = {"type": "subdivision", "tessellation_rate": rate}
    shape |= msub.ControlCage(*read_bin(binary)).as_properties(mi)

    def run(clock):
        loaded = mi.load_dict(shape)
        finish(loaded)
        clock.lap("mesh")
        _ = mi.load_dict({"type": "scene", "surface": loaded})
        finish(loaded)
        clock.lap("hierarchy")

    return summary(run, repeats)


def load(obj, _binary, rate, repeats, variant):
    """The shape from files of the cage, text and binary, and the same surface from a dense file, by Mitsuba itself.

    What comes first in the process is the cage's text; only its first time is a cold one.
    """
    mi.set_variant(variant)

    def run(clock):
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

    with tempfile.TemporaryDirectory() as folder:
        dense = str(Path(folder) / "dense.ply")
        return summary(run, repeats)


def picture(_obj, binary, rate, repeats, variant):
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
        for shading, own_rate in (("vertex", rate), ("exact", 1)):
            surface = {**shape, "tessellation_rate": own_rate, "shading": shading, "bsdf": {"type": "conductor"}}
            name = f"{shading}, rate {own_rate}"
            clock.lap()
            scene = mi.load_dict({**rest, "surface": surface})
            finish(scene)
            clock.lap(f"{name}: load, with hierarchy")
            for lap in ("first picture", "next picture"):
                np.array(mi.render(scene, spp=16))
                clock.lap(f"{name}: {lap}")
            del scene

    return summary(run, repeats)


def computed(arrays):
    """Arrays of Dr.Jit that are in memory."""
    dr.eval(arrays)
    dr.sync_thread()
    return arrays


def finish(shape):
    """Wait for all that the shape has started."""
    shape.bbox()
    dr.sync_thread()


class Clock:
    """Seconds, and peak resident memory in MB, of laps by their names, and the peak of all laps."""

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


def summary(run, repeats):
    """Of the first run, and the best of the others; of these, each lap's peak memory, and the highest of all."""
    clocks = []
    for _ in range(max(2, repeats)):
        clocks.append(Clock())
        run(clocks[-1])
    cold, *warm = clocks
    return {
        "cold": cold.seconds,
        "warm": {name: min(clock.seconds[name] for clock in warm) for name in cold.seconds},
        "memory": {name: max(clock.memory[name] for clock in warm) for name in cold.memory},
        "peak": max(clock.peak for clock in clocks),
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
