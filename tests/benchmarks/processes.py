"""Processes that measure work lap by lap, with the package of this checkout, and rows of tables."""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROCESS = "--process"


class Clock:
    """Wall and processor seconds of laps, and their peaks of resident memory in MB: one row for each time of a name."""

    def __init__(self, begun=None):
        self.laps = {}
        self._start()
        if begun is not None:
            self._last = begun, 0.0

    def lap(self, name=None):
        """End a lap; without a name it does not count."""
        wall, processor, memory = time.monotonic(), time.process_time(), peak_memory()
        if name:
            self.laps.setdefault(name, []).append([wall - self._last[0], processor - self._last[1], memory])
        self._start()

    def _start(self):
        with suppress(OSError):  # On Linux, the peak begins anew from the memory in use.
            Path("/proc/self/clear_refs").write_text("5")
        self._last = time.monotonic(), time.process_time()


def peak_memory():
    """Peak resident memory of this process in MB, on Linux since a clock's lap began."""
    if sys.platform == "linux" and "VmHWM:" in (status := Path("/proc/self/status").read_text()):
        return int(status.split("VmHWM:")[1].split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def run(main, *works, variant=None):
    """Run a program as its user does; or, for `measured`, one of its works, and print the laps of its clock as JSON.

    They begin here, or where the variable BEGUN says.
    """
    if sys.argv[1:2] != [PROCESS]:
        main()
        return
    name, words = sys.argv[2:]
    clock = Clock(float(os.environ["BEGUN"]) if "BEGUN" in os.environ else None)
    if variant:
        import mitsuba

        mitsuba.set_variant(variant)
    more = {work.__name__: work for work in works}[name](clock, *json.loads(words))
    peak = max((memory for laps in clock.laps.values() for *_, memory in laps), default=0.0)
    print(json.dumps({"laps": clock.laps, "peak": peak, **(more or {})}))


def measured(work, *words, **variables):
    """Laps and peak of a work of this program in a process of its own, and what it returns besides."""
    words = json.dumps(words, default=os.fspath)
    return printed([sys.executable, sys.argv[0], PROCESS, work.__name__, words], **variables)


def measured_from_empty_cache(work, *words, times=1):
    """The same of processes one after the other, of which the first finds no compiled kernels."""
    # Dr.Jit keeps them at home.
    with tempfile.TemporaryDirectory() as home:
        return [measured(work, *words, HOME=home) for _ in range(times)]


def printed(words, **variables):
    """The object that a command prints as JSON, in a line after which others may follow."""
    done = ran(words, **variables)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not lines:
        raise SystemExit(f"{words} failed:\n{done.stderr or done.stdout}")
    return json.loads(lines[-1])


def ran(words, **variables):
    """A command that has ended. Variables of the environment that are None are left out."""
    path = os.pathsep.join([str(ROOT / "plugin"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, **variables}
    environment = {name: value for name, value in environment.items() if value is not None}
    return subprocess.run([str(word) for word in words], capture_output=True, text=True, env=environment, check=False)


def print_row(name, *cells, width=20):
    print(f"{name:<50}" + "".join(f"{cell:>{width}}" for cell in cells), flush=True)
