"""Damaged files, each read as any user's file is, by processes that a hang or a crash may take down.

The law: every file is a cage or a `CageError`, told in few words, and nothing stays behind.
"""

import multiprocessing
import os
import re
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from concurrent.futures import TimeoutError as TookTooLong
from functools import partial
from pathlib import Path
from random import Random

from fuzz.mutations import mutated
from fuzz.seed_files import WORDS, seed_files
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage
from pebble import ProcessExpired, ProcessPool
from tqdm import tqdm

OPTIONS = {"obj": {}, "ply": {}, "usd": {"prim": "*"}}
# What a message may be long, besides the path.
LONGEST_MESSAGE = 500
# Seconds of computing that one small file may take, those on the clock, as others may use the machine, and memory.
PATIENCE, PATIENCE_ON_CLOCK = 8.0, 120.0
MEMORY = 1 << 30
# So many findings with the same beginning are kept as files.
_KEPT, _BEGINNING = 5, 60
_DESCRIPTORS = Path("/proc/self/fd")


def damaged_file(reader: str, seed: int, index: int) -> tuple[str, bytes]:
    """Suffix and content of a file, the same for the same numbers."""
    random = Random(f"{reader} {seed} {index}")
    suffix, content = random.choice(seed_files(reader))
    return suffix, mutated(content, tuple(WORDS[reader]), random)


def broken_law(path: Path) -> str | None:
    """What reading a file does that no file may make it do; None where all is well."""
    before = _open_files()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        problem = _outcome(path)
    for warning in told:
        if not issubclass(warning.category, CageWarning):
            return f"{warning.category.__name__}: {warning.message}"
        problem = problem or _wrong_message("warning", str(warning.message), path)
    left = _open_files()
    return problem or (f"open file left: {left - before}" if sum(left.values()) > sum(before.values()) else None)


def _outcome(path: Path) -> str | None:
    try:
        ControlCage.from_file(path, **OPTIONS["usd" if path.suffix.startswith(".usd") else path.suffix[1:]])
    except CageError as error:
        return _wrong_message("error", str(error), path)
    except Exception as error:  # Which is the finding.
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} at {Path(frame.filename).name}:{frame.lineno}: {error}"
    return None


def _wrong_message(kind: str, message: str, path: Path) -> str | None:
    if str(path) not in message:
        return f"{kind} without the file's name: {message}"
    length = len(message) - len(str(path))
    return f"{kind} of {length} characters: {message}" if length > LONGEST_MESSAGE else None


def _open_files() -> Counter[str]:
    """Files that descriptors of this process refer to, where the system tells."""
    descriptors = list(_DESCRIPTORS.iterdir()) if _DESCRIPTORS.is_dir() else []
    # That of the folder itself is closed by now.
    return Counter(os.readlink(path) for path in descriptors if path.is_symlink())


def read_one(folder: str, reader: str, seed: int, index: int) -> str | None:
    suffix, content = damaged_file(reader, seed, index)
    path, start = Path(folder) / f"{index}{suffix}", time.process_time()
    path.write_bytes(content)
    problem, taken = broken_law(path), time.process_time() - start
    path.unlink()
    return problem or (f"{taken:.0f} s of computing" if taken > PATIENCE else None)


def run(
    reader: str, first: int, count: int, seed: int, processes: int, folder: Path, read: Callable = read_one
) -> Counter[str]:
    """Read files of one kind, and count the broken laws by their beginnings, without names of files and numbers.

    Some files that break them are kept in a folder.
    """
    problems: Counter[str] = Counter()
    with (
        # Here, as a process that is ended leaves its files behind.
        tempfile.TemporaryDirectory(prefix="fuzz-") as place,
        ProcessPool(
            processes, initializer=_prepare, initargs=(reader, seed), context=multiprocessing.get_context("spawn")
        ) as pool,
    ):
        indices = range(first, first + count)
        results = pool.map(partial(read, place, reader, seed), indices, timeout=PATIENCE_ON_CLOCK).result()
        for index in tqdm(indices, desc=reader, leave=False, disable=None):
            try:
                problem = next(results)
            except TookTooLong:
                problem = f"hang of more than {PATIENCE_ON_CLOCK:.0f} s"
            except ProcessExpired as ended:
                problem = f"crash, exit code {ended.exitcode}"
            if problem is None:
                continue
            kind = re.sub(r'"/[^"]*"|\d+', "..", problem)[:_BEGINNING]
            problems[kind] += 1
            if problems[kind] <= _KEPT:
                folder.mkdir(parents=True, exist_ok=True)
                suffix, content = damaged_file(reader, seed, index)
                path = folder / f"{reader}_{seed}_{index}{suffix}"
                path.write_bytes(content)
                path.with_suffix(f"{suffix}.txt").write_text(problem + "\n", errors="backslashreplace")
    return problems


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
