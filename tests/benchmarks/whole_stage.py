"""Time a USD file from its reading to the picture and to the next one, against Cycles with adaptive subdivision.

python tests/benchmarks/whole_stage.py STAGE.usda [--grey] [--cycles PYTHON] [--size 640 480] [--spp 16] [--repeats 2]

The stage that the page of speed has is the Open Chess Set of https://github.com/usd-wg/assets, which is not loaded from
there by itself. PYTHON is one that has Blender as a module, `pip install bpy==5.0.1`; without it Cycles is left out.
Both sides have the same camera with its depth of field, all processors, paths as long, the stage's lights, the picture
of its first dome and no denoiser, and subdivide the same meshes: those of Catmull-Clark. Cycles has triangles of a
pixel, and a sky in place of the studio or of a dome without a picture; materials that it cannot read are plain. With
``--grey`` both sides render the stage without its materials. All run in processes of their own that take turns. What
they import at first is a stage of its own; what reads USD is imported then by Blender, and as it reads here. Compiled
kernels are in Dr.Jit's cache. Times are the best of the repeats.
"""

import argparse
import json
import os
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from processes import PROCESS, measured, print_row, printed, ran, run

CYCLES = Path(__file__).with_name("cycles_stage.py")
SHADINGS = ("vertex", "exact")
LAPS = ("imports", "read", "load", "first picture", "next picture")
# The laps of each row.
ROWS = {name: [name] for name in LAPS[:-1]}
ROWS |= {"program to picture": LAPS[:4], "file to picture": LAPS[1:4], "next picture": LAPS[4:]}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("stage", type=Path)
    parser.add_argument("--cycles", metavar="PYTHON", help="a Python that has the module bpy")
    parser.add_argument("--size", nargs=2, type=int, default=(640, 480))
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--grey", action="store_true", help="leave out the materials, on both sides")
    options = parser.parse_args()
    if not options.stage.is_file():
        raise SystemExit(f'"{options.stage}": there is no such file; expected a USD stage, such as chess_set.usda')
    reason = _no_cycles(options.cycles)
    if reason:
        print(f"Cycles: left out, {reason}")
    _show(_best(options, SHADINGS if reason else (*SHADINGS, "cycles")))


def without_materials(path, copy):
    """A stage that has all of another one but its materials, except in prototypes."""
    from pxr import Sdf, Usd, UsdShade, UsdUtils

    # It takes what USD says of MaterialX documents, which it cannot open.
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    layer, given = Sdf.Layer.CreateNew(str(copy)), Sdf.Layer.FindOrOpen(str(path))
    # Metadata of a stage are those of its root layer.
    for key in given.pseudoRoot.ListInfoKeys():
        layer.pseudoRoot.SetInfo(key, given.pseudoRoot.GetInfo(key))
    layer.subLayerPaths[:] = [str(path)]
    stage = Usd.Stage.Open(layer)
    for prim in stage.Traverse():
        UsdShade.MaterialBindingAPI(prim).UnbindAllBindings()
    for prim in [prim for prim in stage.Traverse() if prim.IsA(UsdShade.Material)]:
        prim.SetActive(False)
    layer.Save()
    del delegate
    return copy


def _no_cycles(python):
    """Why Cycles cannot be measured; None if it can."""
    if python is None:
        return "no --cycles PYTHON was given; expected one with `pip install bpy==5.0.1`"
    done = ran([python, "-c", "import bpy"], PYTHONPATH=None)
    return f"{python} has no module bpy; expected `pip install bpy==5.0.1`" if done.returncode else None


def _best(options, sides):
    """By side, the best wall and processor seconds of each row, and the peak of memory in MB."""
    runs, camera = {name: [] for name in sides}, None
    with tempfile.TemporaryDirectory() as folder:
        stage = options.stage
        if options.grey:
            stage = without_materials(stage.resolve(), Path(folder) / "grey.usda")
        # Modules that are imported later are compiled once, as in an installation.
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = folder
        # The first round compiles kernels and modules, and reads files into memory.
        for number in range(options.repeats + 1):
            for name in sides:
                begun = repr(time.monotonic())
                if name == "cycles":
                    words = json.dumps([str(stage), camera])
                    taken = printed([options.cycles, CYCLES, PROCESS, name, words], PYTHONPATH=None, BEGUN=begun)
                else:
                    taken = measured(package, stage, options.size, options.spp, name, BEGUN=begun)
                    camera = taken["camera"]
                if number:
                    runs[name].append(taken)
    return {
        name: {row: np.min([_sum(taken, laps) for taken in its_runs], axis=0) for row, laps in ROWS.items()}
        | {"memory": max(taken["peak"] for taken in its_runs)}
        for name, its_runs in runs.items()
    }


def _sum(taken, laps):
    return np.sum([taken["laps"][name][0][:2] for name in laps], axis=0)


def _show(best):
    print_row("", *best, "wall s (CPU s)")
    for row in ROWS:
        print_row(row, *("{:.2f} ({:6.2f})".format(*side[row]) for side in best.values()))
    print_row("peak memory, MB", *(f"{side['memory']:.0f}" for side in best.values()))
    for name, other in best.items():
        if name != "exact":
            ratios = {row: best["exact"][row] / other[row] for row in [*ROWS][-3:]}
            told = (f"{row} {wall:.2f} (CPU {processor:.2f})" for row, (wall, processor) in ratios.items())
            print(f"exact / {name}: {', '.join(told)}")


def package(clock, path, size, spp, shading):
    """A stage from its reading to two pictures by this package; returns the camera, for Cycles."""
    # Before Dr.Jit, so that it finds an LLVM library that works.
    import mitsuba_subdivision as msub  # isort: skip
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    clock.lap("imports")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", msub.CageWarning)
        scene = msub.usd_scene(path, mi, size=tuple(size), spp=spp, shading=shading)
        clock.lap("read")
        # In order, so that the kernels of instances are those of the first round.
        loaded = mi.load_dict(scene, parallel=False)
        dr.sync_thread()
    clock.lap("load")
    max_depth = scene["integrator"]["max_depth"]
    del scene
    for seed, name in enumerate(LAPS[3:]):
        np.array(mi.render(loaded, seed=seed))
        clock.lap(name)
    from pxr import Usd, UsdGeom, UsdLux

    sensor, stage = loaded.sensors()[0], Usd.Stage.Open(path)
    seen = mi.traverse(sensor)
    domes = (UsdLux.DomeLight(prim) for prim in stage.Traverse() if prim.IsA(UsdLux.DomeLight))
    domes = [dome.GetTextureFileAttr().Get() for dome in domes]
    camera = {
        "to_world": np.array(sensor.world_transform().matrix).reshape(4, 4).tolist(),
        "fov": float(np.array(seen["x_fov"]).ravel()[0]),
        # Radius and distance in focus, with depth of field.
        "lens": [float(seen[name][0]) for name in ("aperture_radius", "focus_distance") if name in seen],
        "dome": next((dome.resolvedPath for dome in domes if dome and dome.resolvedPath), None),
        "size": size,
        "spp": spp,
        "is_open": loaded.environment() is not None,
        "max_depth": max_depth,
        "up": str(UsdGeom.GetStageUpAxis(stage)).lower(),
    }
    return {"camera": camera}


if __name__ == "__main__":
    run(main, package)
