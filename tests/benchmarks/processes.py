"""Processes that measure, with the package of this checkout, and what they measure with."""

import json
import os
import resource
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

ROOT = Path(__file__).parents[2]


def ran(words, **variables):
    """A command that has ended. Variables of the environment that are None are left out."""
    path = os.pathsep.join([str(ROOT / "plugin"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, **variables}
    environment = {name: value for name, value in environment.items() if value is not None}
    return subprocess.run([str(word) for word in words], capture_output=True, text=True, env=environment, check=False)


def measured(name, words, **variables):
    """The object that a command prints as JSON, in a line after which others may follow."""
    done = ran(words, **variables)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not lines:
        raise SystemExit(f"{name} failed:\n{done.stderr or done.stdout}")
    return json.loads(lines[-1])


class Clock:
    """By names of laps: the best of their wall and processor seconds, and peaks of resident memory in MB."""

    def __init__(self):
        self.seconds, self.memory, self.peak = {}, {}, 0.0
        self._start()

    def lap(self, name=None):
        """End a lap; without a name it does not count."""
        now, memory = (time.perf_counter(), time.process_time()), peak_memory()
        self.peak = max(self.peak, memory)
        if name:
            lap = tuple(end - begin for begin, end in zip(self._last, now, strict=True))
            self.seconds[name] = tuple(map(min, self.seconds.get(name, lap), lap))
            self.memory[name] = max(self.memory.get(name, 0.0), memory)
        self._start()

    def _start(self):
        with suppress(OSError):  # On Linux, the peak begins anew from the memory in use.
            Path("/proc/self/clear_refs").write_text("5")
        self._last = time.perf_counter(), time.process_time()


def peak_memory():
    """Peak resident memory of this process in MB, on Linux since a clock's lap began."""
    if sys.platform == "linux" and "VmHWM:" in (status := Path("/proc/self/status").read_text()):
        return int(status.split("VmHWM:")[1].split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10)
