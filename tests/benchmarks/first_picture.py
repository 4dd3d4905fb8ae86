"""Time a new process from its first import to the pixels, against Mitsuba's own PLY mesh of the same triangles.

python tests/benchmarks/first_picture.py [--cages star human ..] [--rate 4] [--repeats 15] [--variants llvm_ad_rgb ..]

Both sides render 128 by 128 pixels with 4 samples, in processes of their own that take turns. Kernels and bytecode are
compiled before. The interpreter's own start does not count. Times are medians; of the stages, too.
"""

import argparse
import os
import statistics
import sys
import tempfile
from pathlib import Path

from cages import CACHE, MAKERS, cage_files
from processes import ROOT, measured, ran

PROCESS = Path(__file__).with_name("one_picture.py")
SHAPES = ("subdivision", "ply")


def main(arguments=None):
    options = _parsed(arguments)
    for cage in options.cages:
        path = options.cages_folder / f"{cage}.obj"
        if not path.exists():
            path = cage_files(cage, options.cache)["obj"]
        with tempfile.TemporaryDirectory() as folder:
            dense = Path(folder) / "dense.ply"
            # Bytecode is kept.
            variables = {"PYTHONDONTWRITEBYTECODE": None, "PYTHONPYCACHEPREFIX": folder}
            _run(variables, "scalar_rgb", "subdivision", path, options.rate, dense)
            for variant in options.variants:
                _show(cage, variant, _measured(variables, variant, {"subdivision": path, "ply": dense}, options))


def _parsed(arguments):
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cages", nargs="+", default=["star"], help=f"of scenes/cages, or {', '.join(MAKERS)}")
    parser.add_argument("--rate", type=int, default=4)
    parser.add_argument("--variants", nargs="+", default=["scalar_rgb", "llvm_ad_rgb"])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--cache", type=Path, default=CACHE, help=f"folder of cages; {CACHE}")
    parser.set_defaults(cages_folder=ROOT / "scenes/cages")
    return parser.parse_args(arguments)


def _measured(variables, variant, files, options):
    """Seconds of each stage, for each kind of shape: one list for each run."""
    # The package chooses a library by itself; Mitsuba would take another one.
    find = "from mitsuba_subdivision.llvm import select_llvm; print(select_llvm().path or '')"
    library = ran([sys.executable, "-c", find], **variables).stdout.strip()
    of_kind = {"subdivision": None, "ply": library or os.environ.get("DRJIT_LIBLLVM_PATH")}
    found = {kind: [] for kind in SHAPES}
    for repeat in range(options.repeats + 1):
        # The order changes, so that neither side always finds the other's files in memory. The first runs compile.
        for kind in SHAPES if repeat % 2 else SHAPES[::-1]:
            own = {**variables, "DRJIT_LIBLLVM_PATH": of_kind[kind]}
            seconds = _run(own, variant, kind, files[kind], options.rate)
            if repeat:
                found[kind].append(seconds)
    return found


def _run(variables, variant, kind, *words):
    return measured(kind, [sys.executable, PROCESS, variant, kind, *words], **variables)


def _show(cage, variant, found):
    medians = {
        kind: {stage: statistics.median(run[stage] for run in runs) * 1e3 for stage in runs[0]}
        for kind, runs in found.items()
    }
    own, mitsuba = (medians[kind] for kind in SHAPES)
    print(f"\n{cage}, {variant:<26}this package   PLY (ms)   ratio")
    for stage in own:
        ratio = f"{own[stage] / mitsuba[stage]:8.2f}" if stage in ("total", "processor") else ""
        print(f"  {stage:<34}{own[stage]:12.1f}{mitsuba[stage]:11.1f}{ratio}")


if __name__ == "__main__":
    main()
