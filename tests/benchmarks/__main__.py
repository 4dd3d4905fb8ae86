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
from pathlib import Path

import numpy as np
from cages import CACHE, MAKERS, cage_files
from measure import load, picture, stages, total
from peers import built_peers, time_peer
from processes import measured, measured_from_empty_cache, print_row, run

# Above so many triangles a dense file is not written.
DENSE_TRIANGLES = 20_000_000


def main():
    parser = argparse.ArgumentParser(prog="python tests/benchmarks", description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cages", nargs="+", choices=MAKERS, default=["cube", "star", "torus", "mix50k", "ev50k"])
    parser.add_argument("--rates", nargs="+", type=int, default=[8])
    parser.add_argument("--variants", nargs="*", default=["scalar_rgb", "llvm_ad_rgb"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="totals and peers only")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--cache", type=Path, default=CACHE, help=f"folder of cages and peers; {CACHE}")
    parser.add_argument("--json", type=Path, help="file to write the numbers to")
    options = parser.parse_args()
    commands, absent = ({}, {}) if options.no_peers else built_peers(options.cache)
    for name, reason in absent.items():
        print(f"{name}: left out, {reason}")
    # Of the program itself, which a cube hardly adds to.
    cube, results = _totals(cage_files("cube", options.cache), 1, 1, commands), []
    for cage in options.cages:
        files = cage_files(cage, options.cache)
        for rate in options.rates:
            result = {"cage": cage, "rate": rate, **_totals(files, rate, options.repeats, commands)}
            if not options.quick:
                result |= _stages(files, rate, options)
            results.append(result)
            _show(result, cube)
    if options.json:
        options.json.write_text(json.dumps({"absent": absent, "a cube": cube, "results": results}, indent=1))


def _totals(files, rate, repeats, commands):
    words = files, rate, max(2, repeats)
    peers = {name: time_peer(command, files["bin"], rate, repeats) for name, command in commands.items()}
    (without,) = measured_from_empty_cache(total, *words)
    return {"empty kernel cache": without, "compiled": measured(total, *words), "peers": peers}


def _stages(files, rate, options):
    works = [("stages", stages, [])]
    is_small = 2 * rate**2 * (files["bin"].stat().st_size // 28) <= DENSE_TRIANGLES
    for variant in options.variants:
        works += [(f"load, {variant}", load, [variant])] * is_small
        works += [(f"picture, {variant}", picture, [variant])] * (not variant.startswith("scalar"))
    repeats = max(2, options.repeats)
    return {name: measured_from_empty_cache(work, files, rate, repeats, *words)[0] for name, work, words in works}


def _show(result, cube):
    print()
    print_row(f"{result['cage']}, rate {result['rate']}", "cold (ms)", "warm (ms)", "peak (MB)")
    for work, taken in result.items():
        for name, laps in taken["laps"].items() if isinstance(taken, dict) and "laps" in taken else ():
            cold, *warm = np.array(laps)[:, 0] * 1e3
            print_row(f"  {work}: {name}", f"{cold:.1f}", f"{min(warm):.1f}", f"{np.max(laps[1:], axis=0)[2]:.0f}")
    package, floor = result["compiled"], cube["compiled"]["peak"]
    print(f"  peak memory {package['peak']:.0f} MB, {package['peak'] - floor:.0f} above a cube's")
    once, again = (min(wall for wall, *_ in package["laps"][name][1:]) for name in ("total", "update"))
    for name, peer in result["peers"].items():
        if "failed" in peer:
            print(f"  {name:18} {peer['failed']}")
            continue
        above = peer["memory"] - cube["peers"][name].get("memory", 0)
        print(
            f"  {name:18} set-up {peer['setup'] * 1e3:8.1f}  evaluation {peer['evaluation'] * 1e3:8.1f}  "
            f"total {peer['total'] * 1e3:8.1f}: {peer['total'] / once:5.2f} x, "
            f"update {(peer['update'] + peer['evaluation']) / again:5.2f} x, "
            f"memory {peer['memory']:.0f} MB, {above:.0f} above a cube's"
        )


if __name__ == "__main__":
    run(main, total, stages, load, picture)
