"""Time a new process from its first import to the pixels, against Mitsuba's own PLY mesh of the same triangles.

python tests/benchmarks/first_picture.py [--cages star human ..] [--rate 4] [--repeats 15] [--variants llvm_ad_rgb ..]

Both sides render 128 by 128 pixels with 4 samples, in processes of their own that take turns. Kernels and bytecode are
compiled before. The interpreter's own start does not count. Times are medians; of the stages, too.
"""

import sys
import time

SHAPES = ("subdivision", "ply")


def main(arguments=None):
    # One process of these imports nothing else before its clock starts.
    import argparse
    import tempfile
    from pathlib import Path

    from cages import CACHE, MAKERS, cage_files
    from processes import ROOT

    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cages", nargs="+", default=["star"], help=f"of scenes/cages, or {', '.join(MAKERS)}")
    parser.add_argument("--rate", type=int, default=4)
    parser.add_argument("--variants", nargs="+", default=["scalar_rgb", "llvm_ad_rgb"])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--cache", type=Path, default=CACHE, help=f"folder of cages; {CACHE}")
    options = parser.parse_args(arguments)
    for cage in options.cages:
        path = ROOT / "scenes/cages" / f"{cage}.obj"
        if not path.exists():
            path = cage_files(cage, options.cache)["obj"]
        with tempfile.TemporaryDirectory() as folder:
            files = {"subdivision": path, "ply": Path(folder) / "dense.ply"}
            # Bytecode is kept.
            variables = {"PYTHONDONTWRITEBYTECODE": None, "PYTHONPYCACHEPREFIX": folder}
            run(variables, "scalar_rgb", "subdivision", path, options.rate, files["ply"])
            for variant in options.variants:
                show(cage, variant, in_turns(variables, variant, files, options))


def in_turns(variables, variant, files, options):
    """Seconds of each stage, for each kind of shape: one list for each run."""
    import os

    from processes import ran

    # The package chooses a library by itself; Mitsuba would take another one.
    find = "from mitsuba_subdivision.llvm import select_llvm; print(select_llvm().path or '')"
    library = ran([sys.executable, "-c", find], **variables).stdout.strip()
    of_kind = {"subdivision": None, "ply": library or os.environ.get("DRJIT_LIBLLVM_PATH")}
    runs = {kind: [] for kind in SHAPES}
    for repeat in range(options.repeats + 1):
        # The order changes, so that neither side always finds the other's files in memory. The first runs compile.
        for kind in SHAPES if repeat % 2 else SHAPES[::-1]:
            its_variables = {**variables, "DRJIT_LIBLLVM_PATH": of_kind[kind]}
            seconds = run(its_variables, variant, kind, files[kind], options.rate)
            if repeat:
                runs[kind].append(seconds)
    return runs


def run(variables, variant, kind, *words):
    from processes import measured

    return measured(kind, [sys.executable, __file__, "--process", variant, kind, *words], **variables)


def show(cage, variant, runs):
    import statistics

    print(f"\n{cage}, {variant:<26}this package   PLY (ms)   ratio")
    for stage in runs["ply"][0]:
        ours, mitsuba = (statistics.median(run[stage] for run in runs[kind]) * 1e3 for kind in SHAPES)
        print(f"  {stage:<34}{ours:12.1f}{mitsuba:11.1f}{ours / mitsuba:8.2f}")


def process(variant, kind, path, rate, write=None):
    """Render a file with a shape of this kind, and print the seconds of each stage."""
    clock, processor = [time.perf_counter()], time.process_time()
    if kind == "subdivision":
        import mitsuba_subdivision  # noqa: F401 - registers the shape
    import mitsuba as mi
    import numpy as np

    clock.append(time.perf_counter())
    mi.set_variant(variant)
    clock.append(time.perf_counter())
    shape = {"type": kind, "filename": path}
    if kind == "subdivision":
        shape["tessellation_rate"] = int(rate)
    camera = mi.ScalarTransform4f().look_at(origin=[4, -6, 4], target=[0, 0, 0], up=[0, 0, 1])
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "to_world": camera, "film": {"type": "hdrfilm", "width": 128, "height": 128}},
        "surface": shape,
    }
    loaded = mi.load_dict(scene)
    clock.append(time.perf_counter())
    np.array(mi.render(loaded, spp=4))
    clock.append(time.perf_counter())
    processor = time.process_time() - processor

    import json

    if write:
        loaded.shapes()[0].write_ply(write)
    stages = dict(zip(("import", "variant", "load", "picture"), np.diff(clock).tolist(), strict=True))
    print(json.dumps(stages | {"total": clock[-1] - clock[0], "processor": processor}))


if __name__ == "__main__":
    process(*sys.argv[2:]) if sys.argv[1:2] == ["--process"] else main()
