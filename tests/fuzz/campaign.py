"""Many damaged files, read by processes that a hang or a crash may take down."""

import multiprocessing
import os
import re
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from fuzz.law import broken_law, damaged_file

# Seconds of computing that one small file may take, those on the clock, as others may use the machine, and memory.
PATIENCE = 8.0
PATIENCE_ON_CLOCK = 120.0
MEMORY = 1 << 30
_POLL = 0.1
# Seconds between two lines of progress, on a terminal and elsewhere.
_INTERVAL_ON_TERMINAL, _INTERVAL = 1.0, 60.0
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
    interval = _INTERVAL_ON_TERMINAL if sys.stderr.isatty() else _INTERVAL
    next_line = time.monotonic() + interval
    with ExitStack() as stack:
        # Here, as a process that is ended leaves its files behind.
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="fuzz-"))
        readers = [
            _Reader(context, queue, folder, reader, seed, range(first + part, first + count, processes))
            for part in range(processes)
        ]
        for each in readers:
            stack.callback(each.stop)
        while any(each.is_busy for each in readers):
            time.sleep(_POLL)
            _take(queue, findings, reader, seed)
            for each in readers:
                problem = each.ended_by()
                if problem:
                    findings.add(reader, seed, *problem)
            if time.monotonic() > next_line:
                next_line += interval
                done = sum(each.done for each in readers)
                end = "\r" if sys.stderr.isatty() else "\n"
                sys.stderr.write(f"{reader}: {done} of {count}, {sum(findings.counts.values())} findings{end}")
                sys.stderr.flush()
        _take(queue, findings, reader, seed)
        return sum(each.done for each in readers)


def _take(queue, findings: Findings, reader: str, seed: int) -> None:
    while not queue.empty():
        findings.add(reader, seed, *queue.get())


class _Reader:
    """A process that reads its share of the files, and starts again after the one that ended it."""

    def __init__(self, context, queue, folder: str, reader: str, seed: int, indices: range) -> None:
        self.context, self.indices = context, indices
        self.shared = (queue, folder, reader, seed, indices)
        self.place = context.Value("q", -1, lock=False)
        self.start(0)

    def start(self, first: int) -> None:
        self.first, self.place.value = first, first - 1
        self.process = self.context.Process(target=read_all, args=(*self.shared, self.place, first), daemon=True)
        self.process.start()
        self.seen, self.since = first - 1, self._clocks()

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
            self.seen, self.since = place, self._clocks()
        if not self.is_busy:
            return None
        computing, on_clock = (now - then for now, then in zip(self._clocks(), self.since, strict=True))
        if self.process.exitcode is not None:
            problem = f"crash, exit code {self.process.exitcode}"
        elif place >= self.first and (computing > PATIENCE or on_clock > PATIENCE_ON_CLOCK):
            problem = f"hang of more than {max(computing, PATIENCE):.0f} s"
            self.stop()
        else:
            return None
        if place < self.first:
            raise RuntimeError(f"the reading process did not start ({problem})")
        self.start(place + 1)
        return self.indices[place], problem

    def _clocks(self) -> tuple[float, float]:
        """Seconds of computing, where the system tells those of other processes, and on the clock."""
        try:
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
            computing = sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")
        except OSError:
            computing = 0.0
        return computing, time.monotonic()

    def stop(self) -> None:
        self.process.kill()
        self.process.join()


def read_all(queue, folder: str, reader: str, seed: int, indices: range, place, first: int) -> None:
    """Read files from a number on; the queue gets the findings, and the place says how far it has come."""
    damaged_file(reader, seed, 0)  # Imports what it takes.
    _limit_memory()
    # The USD library writes to the standard error of the process, too.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    parent = os.getppid()
    for number in range(first, len(indices)):
        if os.getppid() != parent:  # Which was ended without a chance to end this.
            return
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
        # Of data, as the address space that threads reserve depends on the machine.
        used = int(pages.read_text().split()[5]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_DATA, (used + MEMORY, resource.getrlimit(resource.RLIMIT_DATA)[1]))
