"""Time a new process from its first import to the pixels, against Mitsuba's own PLY mesh of the same triangles.

python tests/benchmarks/first_picture.py [--cages star human ..] [--rate 4] [--repeats 15] [--variants llvm_ad_rgb ..]

Both sides render 128 by 128 pixels with 4 samples, in processes of their own that take turns. Kernels and bytecode are
compiled before. The interpreter's own start does not count. Times are medians; of the stages, too.
"""

import sys
import time

SHAPES = ("subdivision", "ply")


def main():
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
    options = parser.parse_args()
    for cage in options.cages:
        path = ROOT / "scenes/cages" / f"{cage}.obj"
        if not path.exists():
            path = cage_files(cage, options.cache)["obj"]
        with tempfile.TemporaryDirectory() as folder:
            compare(cage, {"subdivision": path, "ply": Path(folder) / "dense.ply"}, folder, options)


def compare(cage, files, folder, options):
    import os
    import statistics

    from processes import print_row, printed, ran

    # Bytecode is kept.
    variables = {"PYTHONDONTWRITEBYTECODE": None, "PYTHONPYCACHEPREFIX": folder}

    def run(variant, kind, *written, **more):
        words = [sys.executable, __file__, "--process", variant, kind, files[kind], options.rate, *written]
        return printed(words, **variables, **more)

    run("scalar_rgb", "subdivision", files["ply"])
    # The package chooses a library by itself; Mitsuba would take another one.
    find = "from mitsuba_subdivision.llvm import select_llvm; print(select_llvm().path or '')"
    library = ran([sys.executable, "-c", find], **variables).stdout.strip()
    of_kind = {"subdivision": None, "ply": library or os.environ.get("DRJIT_LIBLLVM_PATH")}
    for variant in options.variants:
        runs = {kind: [] for kind in SHAPES}
        for repeat in range(options.repeats + 1):
            # The order changes, so that neither side always finds the other's files in memory. The first runs compile.
            for kind in SHAPES if repeat % 2 else SHAPES[::-1]:
                runs[kind].append(run(variant, kind, DRJIT_LIBLLVM_PATH=of_kind[kind]))
        print()
        print_row(f"{cage}, {variant}", "this package (ms)", "PLY (ms)", "ratio")
        for stage in runs["ply"][0]:
            ours, theirs = (statistics.median(taken[stage] for taken in runs[kind][1:]) * 1e3 for kind in SHAPES)
            print_row(f"  {stage}", f"{ours:.1f}", f"{theirs:.1f}", f"{ours / theirs:.2f}")


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
