"""Time every stage of the package, and OpenSubdiv, Embree and Mitsuba at the same work.

python tests/benchmarks [--cages torus ev50k ..] [--rates 8 ..] [--repeats 3] [--json FILE] [--quick]

Peers compute points and normals of the same surface at as many samples as the tessellation has vertices, on all cores.
They are built on the first run, if a C++ compiler, OpenSubdiv and Embree are there, and left out otherwise. Times are
the best of some repeats; only the ratios within one run mean anything.

Cold is the first call in a process; stages, mesh, load and picture then find no compiled kernels, totals those in
Dr.Jit's cache. Peaks are resident memory, of warm calls.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

from cages import CACHE, MAKERS, cage_files
from peers import built_peers, time_peer
from processes import measured

# Above so many triangles a dense file is not written.
DENSE_TRIANGLES = 20_000_000
OWN = "this package"


def main(arguments=None):
    options = _parsed(arguments)
    commands, absent = ({}, {}) if options.no_peers else built_peers(options.cache)
    for name, reason in absent.items():
        print(f"{name}: left out, {reason}")
    results, floors = [], _memory_of_cube(options, commands)
    for cage in options.cages:
        files = cage_files(cage, options.cache)
        for rate in options.rates:
            results.append({"cage": cage, "rate": rate, **_measured(files, rate, options, commands)})
            _show(results[-1], floors)
    if options.json:
        found = {"absent": absent, "memory of a cube": floors, "results": results}
        Path(options.json).write_text(json.dumps(found, indent=1))


def _parsed(arguments):
    parser = argparse.ArgumentParser(prog="python tests/benchmarks", description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cages", nargs="+", choices=MAKERS, default=["cube", "star", "torus", "mix50k", "ev50k"])
    parser.add_argument("--rates", nargs="+", type=int, default=[8])
    parser.add_argument("--variants", nargs="*", default=["scalar_rgb", "llvm_ad_rgb"])
    parser.add_argument("--repeats", type=int, default=3)
    once = "of the peers: each once, or all"
    parser.add_argument("--samples", choices=["shared", "grid"], default="shared", help=once)
    parser.add_argument("--quick", action="store_true", help="totals and peers only")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--cache", type=Path, default=CACHE, help=f"folder of cages and peers; {CACHE}")
    parser.add_argument("--json", help="file to write the numbers to")
    return parser.parse_args(arguments)


def _measured(files, rate, options, commands):
    def with_empty_cache(task, variant=""):
        # Dr.Jit keeps compiled kernels at home.
        with tempfile.TemporaryDirectory() as home:
            return _own(task, files, rate, options.repeats, variant, HOME=home)

    triangles = 2 * rate**2 * (files["bin"].stat().st_size // 28)
    result = {"empty kernel cache": with_empty_cache("total"), "total": _own("total", files, rate, options.repeats)}
    result["peers"] = {
        name: time_peer(command, files["bin"], rate, options.repeats, options.samples)
        for name, command in commands.items()
    }
    if not options.quick:
        tasks = [("stages", "")]
        for variant in options.variants:
            tasks.append(("mesh", variant))
            if triangles <= DENSE_TRIANGLES:
                tasks.append(("load", variant))
            if not variant.startswith("scalar"):
                tasks.append(("picture", variant))
        for task, variant in tasks:
            result[f"{task}, {variant}" if variant else task] = with_empty_cache(task, variant)
    return result


def _memory_of_cube(options, commands):
    """Peak memory in MB of the package and of each peer for a cube: that of the program itself."""
    files = cage_files("cube", options.cache)
    found = {name: time_peer(command, files["bin"], 1, 1, options.samples) for name, command in commands.items()}
    memory = {name: peer["memory"] for name, peer in found.items() if "failed" not in peer}
    return memory | {OWN: _own("total", files, 1, 2)["peak"]}


def _own(task, files, rate, repeats, variant="", **variables):
    program = Path(__file__).with_name("measure.py")
    words = [sys.executable, program, task, files["obj"], files["bin"], rate, repeats, variant]
    return measured(task, words, **variables)


def _show(result, floors):
    total = result["total"]
    print(f"\n{result['cage']}, rate {result['rate']:<33}cold      warm   (ms)  peak (MB)")
    for name in ("total", "update"):
        _row(name, total, name)
    _row("total, empty kernel cache", result["empty kernel cache"], "total")
    print(f"  peak memory {total['peak']:.0f} MB" + _above_cube(total["peak"], floors[OWN]))
    for task, found in result.items():
        if task.startswith(("stages", "mesh", "load", "picture")):
            for name in found["cold"]:
                _row(f"{task}: {name}", found, name)
        if task == "stages":
            written, filled = (found["bandwidth"][name] / 1e9 for name in ("evaluation", "fill"))
            print(f"  evaluation writes {written:.1f} GB/s; filling an array of that size, {filled:.1f} GB/s")
        if task.startswith("load"):
            for cage in ("OBJ cage", "PLY cage"):
                ratio = found["warm"]["dense PLY"] / found["warm"][cage]
                print(f"  {f'{task}: dense PLY / {cage}':50}{ratio:8.2f}")
    for name, peer in result["peers"].items():
        if "failed" in peer:
            print(f"  {name:18} {peer['failed']}")
            continue
        update = (peer["update"] + peer["evaluation"]) / total["warm"]["update"]
        memory = f"memory {peer['memory']:.0f} MB" + _above_cube(peer["memory"], floors.get(name))
        print(
            f"  {name:18} set-up {peer['setup'] * 1e3:8.1f}  evaluation {peer['evaluation'] * 1e3:8.1f}  "
            f"total {peer['total'] * 1e3:8.1f}: {peer['total'] / total['warm']['total']:5.2f} x, "
            f"update {update:5.2f} x, {memory}"
        )


def _above_cube(memory, floor):
    return "" if floor is None else f", {memory - floor:.0f} above a cube's"


def _row(label, found, name):
    cold, warm = found["cold"][name] * 1e3, found["warm"][name] * 1e3
    print(f"  {label:38}{cold:10.1f}{warm:10.1f}{found['memory'][name]:15.0f}")


if __name__ == "__main__":
    main()
