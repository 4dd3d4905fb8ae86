"""Many damaged files, read by processes that a hang or a crash may take down."""

from __future__ import annotations

import multiprocessing
import os
import re
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from fuzz.law import broken_law, damaged_file

# Seconds that one small file may take, and memory that reading it may take.
PATIENCE = 8.0
MEMORY = 1 << 30
_POLL = 0.1
# So many findings with the same beginning are kept as files.
_KEPT = 5
_BEGINNING = 60


@dataclass
class Findings:
    """Broken laws, by the beginnings of what they say, without names of files and numbers."""

    folder: Path
    counts: dict[str, int] = field(default_factory=dict)

    def add(self, reader: str, seed: int, index: int, problem: str) -> None:
        key = re.sub(r'"/[^"]*"|\d+', "..", problem)[:_BEGINNING]
        self.counts[key] = self.counts.get(key, 0) + 1
        if self.counts[key] <= _KEPT:
            self.folder.mkdir(parents=True, exist_ok=True)
            suffix, content = damaged_file(reader, seed, index)
            path = self.folder / f"{reader}_{seed}_{index}{suffix}"
            path.write_bytes(content)
            path.with_suffix(f"{suffix}.txt").write_text(problem + "\n", errors="backslashreplace")


def run(reader: str, first: int, count: int, seed: int, processes: int, findings: Findings) -> int:
    """Read files of one kind, and say how many were read."""
    context = multiprocessing.get_context("spawn")
    queue = context.SimpleQueue()
    readers = [
        _Reader(context, queue, reader, seed, range(first + part, first + count, processes))
        for part in range(processes)
    ]
    shown = 0.0
    try:
        while any(each.is_busy for each in readers):
            time.sleep(_POLL)
            while not queue.empty():
                findings.add(reader, seed, *queue.get())
            for each in readers:
                problem = each.ended_by()
                if problem:
                    findings.add(reader, seed, *problem)
            if time.monotonic() > shown + 1 and sys.stderr.isatty():
                shown, done = time.monotonic(), sum(each.done for each in readers)
                sys.stderr.write(f"\r{reader}: {done} of {count}, {sum(findings.counts.values())} findings")
                sys.stderr.flush()
        while not queue.empty():
            findings.add(reader, seed, *queue.get())
    finally:
        for each in readers:
            each.stop()
    return sum(each.done for each in readers)


class _Reader:
    """A process that reads its share of the files, and starts again after the one that ended it."""

    def __init__(self, context, queue, reader: str, seed: int, indices: range) -> None:
        self.context, self.queue, self.kind, self.seed, self.indices = context, queue, reader, seed, indices
        self.place = context.Value("q", -1, lock=False)
        self.start(0)

    def start(self, first: int) -> None:
        self.place.value = first - 1
        self.seen, self.since = first - 1, None
        arguments = (self.queue, self.place, self.kind, self.seed, self.indices, first)
        self.process = self.context.Process(target=read_all, args=arguments, daemon=True)
        self.process.start()

    @property
    def done(self) -> int:
        return min(self.place.value, len(self.indices))

    @property
    def is_busy(self) -> bool:
        return self.place.value < len(self.indices)

    def ended_by(self) -> tuple[int, str] | None:
        """File that took the process down, and how; the process is started again."""
        place = self.place.value
        if place != self.seen:
            self.seen, self.since = place, time.monotonic()
        if not self.is_busy:
            return None
        if self.process.exitcode is not None:
            problem = f"crash, exit code {self.process.exitcode}"
        elif place >= 0 and self.since is not None and time.monotonic() - self.since > PATIENCE:
            problem = f"hang of more than {PATIENCE:g} s"
            self.stop()
        else:
            return None
        if place < 0:
            raise RuntimeError(f"the reading process did not start ({problem})")
        self.start(place + 1)
        return self.indices[place], problem

    def stop(self) -> None:
        self.process.kill()
        self.process.join()


def read_all(queue, place, reader: str, seed: int, indices: range, first: int) -> None:
    """Read files from a number on; the queue gets the findings, and the place says how far it has come."""
    damaged_file(reader, seed, 0)  # Imports what it takes.
    _limit_memory()
    # The USD library writes to the standard error of the process, too.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        for number in range(first, len(indices)):
            index = indices[number]
            place.value = number
            suffix, content = damaged_file(reader, seed, index)
            path = Path(folder) / f"{index}{suffix}"
            path.write_bytes(content)
            problem = broken_law(path)
            path.unlink()
            if problem:
                queue.put((index, problem))
    place.value = len(indices)


def _limit_memory() -> None:
    """Let this process have no more memory than it has and reading a small file may take, where the system can."""
    try:
        import resource
    except ImportError:
        return
    pages = Path("/proc/self/statm")
    if pages.exists():
        used = int(pages.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
