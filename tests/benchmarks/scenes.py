"""What a scene costs with exact shading, against vertex shading in the same run.

python tests/benchmarks/scenes.py [hits shapes instances growth copies gradients] [--cages rook human] [--repeats 3]

hits       one shape, 256 by 256 pixels, 64 samples, paths of 4 segments, rough metal: rate 2 exact, rate 8 vertex
shapes     6 shapes and 42 of the same six cages: what a further one costs
instances  7 shapes and 64 instances of one cage, 64 by 64 pixels, 4 samples
growth     shapes and instances in growing numbers, of one group and of several, 64 by 64 pixels, 1 sample
copies     a stage with copies of a rook of 182 faces from a point instancer: file to picture, 640 by 480 pixels
gradients  prb, 3 segments, 128 by 128 pixels, 16 samples: one step of a fit of control points

Every row of a table is measured in a process of its own for each shading, twice: in the first, Dr.Jit has no compiled
kernels, in the second those of the first. Times are wall seconds, and seconds of all processors, which serve where
other programs run beside; "next" is the best of some repeats. Only the ratios within one run mean anything.
"""

import argparse
import tempfile
from pathlib import Path

# Before Dr.Jit, so that it finds an LLVM library that works; it registers the shape, too.
import mitsuba_subdivision as msub

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_subdivision.device_arrays import upload
from processes import ROOT, measured_from_empty_cache, print_row, run

SHADINGS = ("vertex", "exact")
# Segments on each edge with which the surface looks alike.
RATES = {"vertex": 8, "exact": 2}
SIX_CAGES = ("rook", "human", "star", "jar", "barrel", "propeller")
# Numbers of shapes outside groups, of instances, and of groups of one shape.
GROWTH = ((50, 50, 1), (100, 100, 1), (200, 200, 1), (100, 100, 10), (100, 200, 10), (100, 200, 20), (200, 400, 20))
COPIES = (400, 1_000, 5_000, 20_000)
FEW, MANY = 6, 42


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"of {', '.join(TASKS)}; all of them")
    parser.add_argument("--cages", nargs="+", default=["rook", "human", "star"], help="of scenes/cages")
    parser.add_argument("--growth", nargs="+", type=_counts, default=GROWTH, metavar="SHAPES,INSTANCES,GROUPS")
    parser.add_argument("--copies", nargs="+", type=int, default=COPIES)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    if wrong := set(options.tasks) - TASKS.keys():
        parser.error(f"there is no task {', '.join(sorted(wrong))}; expected some of {', '.join(TASKS)}")
    for name in options.tasks or TASKS:
        (work, cases), taken = TASKS[name], []
        for words in cases(options):
            given = options.repeats, *words
            runs = {shading: measured_from_empty_cache(work, shading, *given, times=2) for shading in SHADINGS}
            taken.append(runs)
            _show(f"{name} {' '.join(map(str, words))}", runs)
        if work is shapes:
            _show_further(*taken)


def _counts(text):
    return tuple(map(int, text.split(",")))


def _seconds(run):
    """Wall and processor seconds of each lap, the least of its times."""
    return {name: np.min(laps, axis=0)[:2] for name, laps in run["laps"].items()}


def _show(title, runs):
    print()
    print_row(title, *SHADINGS, "ratio", "wall s (CPU s)")
    for cache, vertex, exact in zip(("empty cache", "compiled"), *runs.values(), strict=True):
        slow = _seconds(exact)
        for name, seconds in _seconds(vertex).items():
            columns = seconds, slow[name], slow[name] / np.maximum(seconds, 1e-9)
            print_row(f"  {cache}: {name}", *(f"{wall:.4f} ({processor:7.4f})" for wall, processor in columns))
        print_row(f"  {cache}: memory, MB", *(f"{run['peak']:.0f}" for run in (vertex, exact)))


def _show_further(few, many):
    """What each of the further shapes costs, with compiled kernels."""
    for shading in SHADINGS:
        (_, less), (_, more) = few[shading], many[shading]
        begun, ended = _seconds(less), _seconds(more)
        times = ", ".join(f"{name} {(ended[name] - begun[name])[0] / (MANY - FEW) * 1e3:.1f} ms" for name in begun)
        print(f"  each further shape, {shading}: {times}, {(more['peak'] - less['peak']) / (MANY - FEW):.1f} MB")


def hits(clock, shading, repeats, cage):
    shape = _shape(cage, shading, RATES[shading], bsdf={"type": "roughconductor", "alpha": 0.2})
    _pictures(clock, scene_around({"shape": shape}, 256, 64), repeats)


def shapes(clock, shading, repeats, count):
    _pictures(clock, scene_around(spread(shading, SIX_CAGES, count), 64, 4), repeats)


def instances(clock, shading, repeats, shape_count=7, instance_count=64, group_count=1, *, samples=4):
    """Shapes and instances of one cage, the latter of several groups in turn."""
    placed = list(spread(shading, ["star"], shape_count + instance_count).items())
    entries = dict(placed[:shape_count])
    for number in range(group_count):
        # Mitsuba would make one of equal groups.
        entries[f"group_{number}"] = {"type": "shapegroup", f"shape_of_{number}": _shape("star", shading, 2)}
    for number, (name, shape) in enumerate(placed[shape_count:]):
        group = {"type": "ref", "id": f"group_{number % group_count}"}
        entries[f"of_{name}"] = {"type": "instance", "group": group, "to_world": shape["to_world"]}
    _pictures(clock, scene_around(entries, 64, samples), repeats)


def growth(clock, shading, repeats, *counts):
    instances(clock, shading, repeats, *counts, samples=1)


def copies(clock, shading, repeats, count):
    """A stage of so many copies in a square, turned at random."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "copies.usdc"
        _write_copies(path, msub.ControlCage.from_file(ROOT / "scenes/cages/rook.obj"), count)
        clock.lap()
        scene = msub.usd_scene(path, mi, spp=4, shading=shading)
        clock.lap("read")
        _pictures(clock, scene, repeats)


def _write_copies(path, cage, count):
    from pxr import Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    instancer = UsdGeom.PointInstancer.Define(stage, "/copies")
    mesh = UsdGeom.Mesh.Define(stage, "/copies/rook")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(cage.positions.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(cage.face_sizes.astype(np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(cage.face_vertices.astype(np.int32)))
    instancer.CreatePrototypesRel().SetTargets([mesh.GetPath()])
    instancer.CreateProtoIndicesAttr(Vt.IntArray.FromNumpy(np.zeros(count, np.int32)))
    side = int(np.ceil(np.sqrt(count)))
    places = np.stack([*np.divmod(np.arange(count), side), np.zeros(count)], axis=1) * np.ptp(cage.positions) * 1.25
    instancer.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(places.astype(np.float32)))
    half = np.random.default_rng(0).uniform(0, np.pi, count)
    # Imaginary parts first.
    turns = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    instancer.CreateOrientationsAttr(Vt.QuathArray.FromNumpy(turns.astype(np.float16)))
    stage.Save()


def gradients(clock, shading, repeats, cage):
    """A step of a fit: render, differentiate by control points, update."""
    shape = _shape(cage, shading, RATES[shading], bsdf={"type": "diffuse"})
    clock.lap()
    scene = mi.load_dict(scene_around({"shape": shape}, 128, 16, {"type": "prb", "max_depth": 3}))
    parameters = mi.traverse(scene)
    (key,) = (key for key in parameters.keys() if key.endswith("control_points"))  # noqa: SIM118
    dr.sync_thread()
    clock.lap("load")
    start = upload(type(parameters[key]), parameters[key])
    for step in range(repeats + 1):
        moved = start + 1e-4 * step
        dr.enable_grad(moved)
        parameters[key] = moved
        parameters.update()
        dr.backward(dr.mean(mi.render(scene, parameters, seed=step, spp=16) ** 2, axis=None))
        dr.eval(dr.grad(moved))
        dr.sync_thread()
        clock.lap("next" if step else "first")


TASKS = {
    "hits": (hits, lambda options: [[cage] for cage in options.cages]),
    "shapes": (shapes, lambda _: [[FEW], [MANY]]),
    "instances": (instances, lambda _: [[]]),
    "growth": (growth, lambda options: options.growth),
    "copies": (copies, lambda options: [[count] for count in options.copies]),
    "gradients": (gradients, lambda options: [[cage] for cage in options.cages]),
}


def _pictures(clock, scene, repeats):
    clock.lap()
    loaded = mi.load_dict(scene)
    dr.sync_thread()
    clock.lap("load")
    for number in range(repeats + 1):
        np.array(mi.render(loaded, seed=number))
        clock.lap("next" if number else "first")


def scene_around(shapes, size, spp, integrator=None):
    """Shapes around the origin, in a box of half a side 1.5, seen from the front."""
    camera = {"fov": 30, "to_world": mi.ScalarTransform4f().look_at([2, -6, 3], [0, 0, 0], [0, 0, 1])}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    sampler = {"type": "independent", "sample_count": spp}
    return {
        "type": "scene",
        "integrator": integrator or {"type": "path", "max_depth": 4},
        "sky": {"type": "constant", "radiance": 0.5},
        "lamp": {"type": "point", "position": [3.0, -5.0, 4.0], "intensity": 30.0},
        "sensor": {"type": "perspective", **camera, "film": film, "sampler": sampler},
        **shapes,
    }


def spread(shading, cages, count):
    """So many shapes, at equal distances in a square, their cages in turn."""
    side = int(np.ceil(np.sqrt(count)))
    places = (np.stack(np.divmod(np.arange(count), side), axis=1) + 0.5) * 2 / side - 1
    return {
        f"shape_{number}": _shape(cages[number % len(cages)], shading, 2, scale=1 / side, place=[*place, 0])
        for number, place in enumerate(places.tolist())
    }


def _shape(cage, shading, rate, *, scale=1.0, place=(0, 0, 0), bsdf=None):
    """The shape of a cage of ``scenes/cages`` within the unit ball, scaled and placed."""
    path = ROOT / "scenes/cages" / f"{cage}.obj"
    # Not by the package: what it keeps of a cage would not be measured.
    lines = (line.split() for line in path.read_text().splitlines())
    points = np.array([words[1:4] for words in lines if words[:1] == ["v"]], dtype=float)
    middle, radius = (points.min(axis=0) + points.max(axis=0)) / 2, float(np.linalg.norm(np.ptp(points, axis=0)) / 2)
    placed = mi.ScalarTransform4f().translate(list(place)).scale(scale / radius).translate((-middle).tolist())
    shape = {"type": "subdivision", "filename": str(path), "tessellation_rate": rate, "shading": shading}
    return {**shape, "to_world": placed, **({} if bsdf is None else {"bsdf": bsdf})}


if __name__ == "__main__":
    run(main, *(work for work, _ in TASKS.values()), variant="llvm_ad_rgb")
