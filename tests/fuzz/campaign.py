"""Many damaged files, read by processes that a hang or a crash may take down."""

import multiprocessing
import os
import re
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import TimeoutError as TookTooLong
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from fuzz.law import broken_law, damaged_file
from pebble import ProcessExpired, ProcessPool
from tqdm import tqdm

# Seconds of computing that one small file may take, those on the clock, as others may use the machine, and memory.
PATIENCE, PATIENCE_ON_CLOCK = 8.0, 120.0
MEMORY = 1 << 30
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


def read_one(folder: str, reader: str, seed: int, index: int) -> str | None:
    """Read a file; what law it breaks."""
    suffix, content = damaged_file(reader, seed, index)
    path, start = Path(folder) / f"{index}{suffix}", time.process_time()
    path.write_bytes(content)
    problem, taken = broken_law(path), time.process_time() - start
    path.unlink()
    return problem or (f"{taken:.0f} s of computing" if taken > PATIENCE else None)


def run(
    reader: str, first: int, count: int, seed: int, processes: int, findings: Findings, read: Callable = read_one
) -> int:
    """Read files of one kind, and say how many were read."""
    indices = range(first, first + count)
    with (
        # Here, as a process that is ended leaves its files behind.
        tempfile.TemporaryDirectory(prefix="fuzz-") as folder,
        ProcessPool(
            processes,
            initializer=_prepare,
            initargs=(reader, seed),
            context=multiprocessing.get_context("spawn"),
        ) as pool,
    ):
        found = pool.map(partial(read, folder, reader, seed), indices, timeout=PATIENCE_ON_CLOCK).result()
        for index in tqdm(indices, desc=reader, leave=False, disable=None):
            try:
                problem = next(found)
            except TookTooLong:
                problem = f"hang of more than {PATIENCE_ON_CLOCK:.0f} s"
            except ProcessExpired as ended:
                problem = f"crash, exit code {ended.exitcode}"
            if problem:
                findings.add(reader, seed, index, problem)
    return len(indices)


def _prepare(reader: str, seed: int) -> None:
    """Let this process have no more memory than it has and reading a small file may take, where the system can."""
    damaged_file(reader, seed, 0)  # Imports what it takes.
    # The USD library writes to the standard error of the process, too.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    try:
        import resource
    except ImportError:
        return
    pages = Path("/proc/self/statm")
    if pages.exists():
        # Of data, as the address space that threads reserve depends on the machine.
        used = int(pages.read_text().split()[5]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_DATA, (used + MEMORY, resource.getrlimit(resource.RLIMIT_DATA)[1]))
