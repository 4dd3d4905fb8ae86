"""Time every stage of the package, and OpenSubdiv, Embree and Mitsuba at the same work.

python tests/benchmarks [--cages torus ev50k ..] [--rates 8 ..] [--repeats 3] [--json FILE] [--quick]

Peers compute points and normals of the same surface at as many samples as the tessellation has vertices, on all cores.
They are built on the first run, if a C++ compiler, OpenSubdiv and Embree are there, and left out otherwise. Times are
the best of some repeats; only the ratios within one run mean anything.

Cold is the first call in a process; stages, load and picture then find no compiled kernels, totals those in Dr.Jit's
cache. Peaks are resident memory, of warm calls.
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
PACKAGE = "this package"


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
        everything = {"absent": absent, "memory of a cube": floors, "results": results}
        Path(options.json).write_text(json.dumps(everything, indent=1))


def _parsed(arguments):
    parser = argparse.ArgumentParser(prog="python tests/benchmarks", description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cages", nargs="+", choices=MAKERS, default=["cube", "star", "torus", "mix50k", "ev50k"])
    parser.add_argument("--rates", nargs="+", type=int, default=[8])
    parser.add_argument("--variants", nargs="*", default=["scalar_rgb", "llvm_ad_rgb"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="totals and peers only")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--cache", type=Path, default=CACHE, help=f"folder of cages and peers; {CACHE}")
    parser.add_argument("--json", help="file to write the numbers to")
    return parser.parse_args(arguments)


def _measured(files, rate, options, commands):
    def with_empty_cache(task, variant=""):
        # Dr.Jit keeps compiled kernels at home.
        with tempfile.TemporaryDirectory() as home:
            return _timed(task, files, rate, options.repeats, variant, HOME=home)

    result = {"empty kernel cache": with_empty_cache("total"), "total": _timed("total", files, rate, options.repeats)}
    result["peers"] = {
        name: time_peer(command, files["bin"], rate, options.repeats) for name, command in commands.items()
    }
    if options.quick:
        return result
    result["stages"] = with_empty_cache("stages")
    is_small = 2 * rate**2 * (files["bin"].stat().st_size // 28) <= DENSE_TRIANGLES
    for variant in options.variants:
        if is_small:
            result[f"load, {variant}"] = with_empty_cache("load", variant)
        if not variant.startswith("scalar"):
            result[f"picture, {variant}"] = with_empty_cache("picture", variant)
    return result


def _memory_of_cube(options, commands):
    """Peak memory in MB of the package and of each peer for a cube: that of the program itself."""
    files = cage_files("cube", options.cache)
    peers = {name: time_peer(command, files["bin"], 1, 1) for name, command in commands.items()}
    memory = {name: peer["memory"] for name, peer in peers.items() if "failed" not in peer}
    return memory | {PACKAGE: _timed("total", files, 1, 2)["peak"]}


def _timed(task, files, rate, repeats, variant="", **variables):
    program = Path(__file__).with_name("measure.py")
    words = [sys.executable, program, task, files["obj"], files["bin"], rate, repeats, variant]
    return measured(task, words, **variables)


def _show(result, floors):
    total = result["total"]
    print(f"\n{result['cage']}, rate {result['rate']:<33}cold      warm   (ms)  peak (MB)")
    labels = {"total": "", "empty kernel cache": "empty kernel cache: "}
    for task, times in result.items():
        for name in times["cold"] if isinstance(times, dict) and "cold" in times else ():
            cold, warm = times["cold"][name] * 1e3, times["warm"][name] * 1e3
            label = labels.get(task, f"{task}: ") + name
            print(f"  {label:50}{cold:10.1f}{warm:10.1f}{times['memory'][name]:15.0f}")
    print(f"  peak memory {total['peak']:.0f} MB, {total['peak'] - floors[PACKAGE]:.0f} above a cube's")
    for name, peer in result["peers"].items():
        if "failed" in peer:
            print(f"  {name:18} {peer['failed']}")
            continue
        update = (peer["update"] + peer["evaluation"]) / total["warm"]["update"]
        print(
            f"  {name:18} set-up {peer['setup'] * 1e3:8.1f}  evaluation {peer['evaluation'] * 1e3:8.1f}  "
            f"total {peer['total'] * 1e3:8.1f}: {peer['total'] / total['warm']['total']:5.2f} x, "
            f"update {update:5.2f} x, memory {peer['memory']:.0f} MB, "
            f"{peer['memory'] - floors.get(name, 0):.0f} above a cube's"
        )


if __name__ == "__main__":
    main()
