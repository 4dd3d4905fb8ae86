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
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

CYCLES = Path(__file__).with_name("cycles_stage.py")
SHADINGS = ("vertex", "exact")
STAGES = ("imports", "read", "load", "first picture", "program to picture", "file to picture", "next picture")


def main(arguments=None):
    options = _parsed(arguments)
    if not options.stage.is_file():
        raise SystemExit(f'"{options.stage}": there is no such file; expected a USD stage, such as chess_set.usda')
    if options.process:
        print(json.dumps(_own(options)))
        return
    sides = {shading: [sys.executable, __file__, "--process", shading] for shading in SHADINGS}
    if reason := _no_cycles(options.cycles):
        print(f"Cycles: left out, {reason}")
    else:
        sides["cycles"] = [options.cycles, CYCLES]
    _show(_measured(sides, options))


def _parsed(arguments):
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("stage", type=Path)
    parser.add_argument("--cycles", metavar="PYTHON", help="a Python that has the module bpy")
    parser.add_argument("--size", nargs=2, type=int, default=(640, 480))
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--grey", action="store_true", help="leave out the materials, on both sides")
    parser.add_argument("--process", choices=SHADINGS, help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


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
    done = subprocess.run([python, "-c", "import bpy"], capture_output=True, text=True, check=False)
    return f"{python} has no module bpy; expected `pip install bpy==5.0.1`" if done.returncode else None


def _measured(sides, options):
    """By side, the best wall and processor seconds of each stage, and the peak of memory in MB."""
    from processes import measured

    runs = {name: [] for name in sides}
    with tempfile.TemporaryDirectory() as folder:
        stage, camera = options.stage, Path(folder) / "camera.json"
        if options.grey:
            stage = without_materials(stage.resolve(), Path(folder) / "grey.usda")
        # Modules that are imported later are compiled once, as in an installation.
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = folder
        # The first round compiles kernels and modules, and reads files into memory.
        for number in range(options.repeats + 1):
            for name, command in sides.items():
                is_cycles, begun = name == "cycles", repr(time.monotonic())
                rest = [camera] if is_cycles else ["--size", *options.size, "--spp", options.spp]
                variables = {"PYTHONPATH": None} if is_cycles else {}
                run = measured(name, [*command, stage, *rest], BEGUN=begun, **variables)
                if number:
                    runs[name].append(run)
                if not is_cycles:
                    camera.write_text(json.dumps(run["camera"] | {"spp": options.spp}))
    return {
        name: {
            "seconds": {stage: np.min([run["seconds"][stage] for run in its_runs], axis=0) for stage in STAGES},
            "memory": max(run["memory"] for run in its_runs),
        }
        for name, its_runs in runs.items()
    }


def _show(best):
    print(" " * 20 + "".join(f"{name:>22}" for name in best) + "    wall s (CPU s)")
    for stage in STAGES:
        columns = (side["seconds"][stage] for side in best.values())
        print(f"{stage:<20}" + "".join(f"{wall:13.2f} ({processor:6.2f})" for wall, processor in columns))
    print(f"{'peak memory, MB':<20}" + "".join(f"{side['memory']:22.0f}" for side in best.values()))
    for name in (name for name in best if name != "exact"):
        exact, other = (best[side]["seconds"] for side in ("exact", name))
        ratios = ((stage, *(exact[stage] / other[stage])) for stage in STAGES[-3:])
        print(f"exact / {name}: " + ", ".join(f"{stage} {wall:.2f} (CPU {cpu:.2f})" for stage, wall, cpu in ratios))


def _own(options):
    """Seconds of this package in this process, and its camera."""
    # Before Dr.Jit, so that it finds an LLVM library that works.
    import mitsuba_subdivision as msub  # isort: skip
    import drjit as dr
    import mitsuba as mi
    from processes import peak_memory

    mi.set_variant("llvm_ad_rgb")
    clock = [(float(os.environ["BEGUN"]), 0.0), (time.monotonic(), time.process_time())]

    def lap():
        dr.sync_thread()
        clock.append((time.monotonic(), time.process_time()))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", msub.CageWarning)
        scene = msub.usd_scene(options.stage, mi, size=tuple(options.size), spp=options.spp, shading=options.process)
        lap()
        # In order, so that the kernels of instances are those of the first round.
        loaded = mi.load_dict(scene, parallel=False)
    lap()
    max_depth = scene["integrator"]["max_depth"]
    del scene
    for seed in range(2):
        np.array(mi.render(loaded, seed=seed))
        lap()
    laps = "imports", "read", "load", "first picture", "next picture"
    seconds = dict(zip(laps, np.diff(clock, axis=0).tolist(), strict=True))
    seconds["program to picture"] = np.subtract(clock[4], clock[0]).tolist()
    seconds["file to picture"] = np.subtract(clock[4], clock[1]).tolist()
    memory = peak_memory()
    from pxr import Usd, UsdGeom, UsdLux

    sensor, stage = loaded.sensors()[0], Usd.Stage.Open(str(options.stage))
    seen = mi.traverse(sensor)
    domes = (UsdLux.DomeLight(prim) for prim in stage.Traverse() if prim.IsA(UsdLux.DomeLight))
    domes = [dome.GetTextureFileAttr().Get() for dome in domes]
    camera = {
        "to_world": np.array(sensor.world_transform().matrix).reshape(4, 4).tolist(),
        "fov": float(np.array(seen["x_fov"]).ravel()[0]),
        # Radius and distance in focus, with depth of field.
        "lens": [float(seen[name][0]) for name in ("aperture_radius", "focus_distance") if name in seen],
        "dome": next((dome.resolvedPath for dome in domes if dome and dome.resolvedPath), None),
        "size": list(options.size),
        "is_open": loaded.environment() is not None,
        "max_depth": max_depth,
        "up": str(UsdGeom.GetStageUpAxis(stage)).lower(),
    }
    return {"seconds": seconds, "memory": memory, "camera": camera}


if __name__ == "__main__":
    main()
