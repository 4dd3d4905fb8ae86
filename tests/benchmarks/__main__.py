"""Time every stage of the package, and OpenSubdiv, Embree and Mitsuba at the same work.

python tests/benchmarks [--cages torus ev50k ..] [--rates 8 ..] [--repeats 3] [--json FILE] [--quick]

Peers compute points and normals of the same surface at as many samples as the tessellation has vertices, on all cores.
They are built on the first run, if a C++ compiler, OpenSubdiv and Embree are there, and left out otherwise. Times are
the best of some repeats; only the ratios within one run mean anything.

Cold is the first call in a process; stages, mesh, load and picture then find no compiled kernels, totals those in
Dr.Jit's cache. Peaks are resident memory, of warm calls.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from cages import MAKERS, cage_files
from peers import built_peers, time_peer

HERE = Path(__file__).parent
CACHE = Path(tempfile.gettempdir()) / "mitsuba-subdivision-benchmarks"
# Above so many triangles a dense file is not written.
DENSE_TRIANGLES = 20_000_000
OWN = "this package"


def main(arguments=None):
    """Run the benchmarks that the command line asks for."""
    options = _parsed(arguments)
    commands, absent = ({}, {}) if options.no_peers else built_peers(options.cache)
    for name, reason in absent.items():
        print(f"{name}: left out, {reason}")
    results, floors = [], _memory_of_cube(options, commands)
    for cage in options.cages:
        files = cage_files(cage, options.cache)
        for rate in options.rates:
            result = _measured(files, rate, options, commands)
            results.append({"cage": cage, "rate": rate, **result})
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
    parser.add_argument(
        "--samples", choices=["shared", "grid"], default="shared", help="of the peers: each once, or all"
    )
    parser.add_argument("--quick", action="store_true", help="totals and peers only")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--cache", type=Path, default=CACHE, help=f"folder of cages and peers; {CACHE}")
    parser.add_argument("--json", help="file to write the numbers to")
    return parser.parse_args(arguments)


def _measured(files, rate, options, commands):
    def own(task, variant="", home=None):
        return _own(task, files, rate, options.repeats, variant, home)

    triangles = 2 * rate**2 * (files["bin"].stat().st_size // 28)
    with tempfile.TemporaryDirectory() as home:
        # Dr.Jit keeps compiled kernels at home.
        result = {"empty kernel cache": own("total", home=home)}
    result["total"] = own("total")
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
            with tempfile.TemporaryDirectory() as home:
                result[f"{task}, {variant}" if variant else task] = own(task, variant, home)
    return result


def _memory_of_cube(options, commands):
    """Peak memory in MB of the package and of each peer for a cube: that of the program itself."""
    files = cage_files("cube", options.cache)
    found = {name: time_peer(command, files["bin"], 1, 1, options.samples) for name, command in commands.items()}
    return {name: peer["memory"] for name, peer in found.items() if "failed" not in peer} | {
        OWN: _own("total", files, 1, 2, "", None)["peak"]
    }


def _own(task, files, rate, repeats, variant, home):
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join([str(HERE.parents[1] / "plugin"), environment.get("PYTHONPATH", "")])
    if home:
        environment["HOME"] = home
    words = [sys.executable, HERE / "measure.py", task, files["obj"], files["bin"], rate, repeats, variant]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        raise SystemExit(f"{task} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


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
