"""Read damaged files of every kind; each must be a cage or an error that says why it is none.

python tests/fuzz --count 1000000 [--reader obj ply usd] [--seed 0] [--first 0] [--output FOLDER]

What breaks this law is written to a folder. A number and the seed name a file: the same ones give the same file.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])

from fuzz.campaign import run  # noqa: E402 - from the folder of tests


def main(arguments=None):
    """Run as the command line says; the exit status is 1 where something was found."""
    parser = argparse.ArgumentParser(prog="python tests/fuzz", description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--count", type=int, default=10_000, help="files of each kind")
    parser.add_argument("--reader", nargs="+", choices=["obj", "ply", "usd"], default=["obj", "ply", "usd"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first file")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--output", type=Path, default=Path(tempfile.gettempdir()) / "mitsuba-subdivision-findings")
    options = parser.parse_args(arguments)
    total = 0
    for reader in options.reader:
        start = time.monotonic()
        problems = run(reader, options.first, options.count, options.seed, options.processes, options.output)
        seconds = time.monotonic() - start
        print(f"{reader}: {options.count} files, {problems.total()} findings, {seconds:.0f} s", flush=True)
        for problem, count in problems.most_common():
            print(f"  {count:7d}  {problem!r}")
        total += problems.total()
    if total:
        print(f"findings are in {options.output}")
    return int(total > 0)


if __name__ == "__main__":
    sys.exit(main())
