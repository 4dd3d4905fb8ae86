"""How much memory there is, within whatever limits the process has."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

try:
    import resource
except ImportError:  # There is none on Windows.
    resource = None


def available_memory(root: Path = Path("/")) -> int | None:
    """Bytes that the process can still get: of the machine's, its control groups', and its own limit's.

    Parameters
    ----------
    root : Path
        Where the system's folders ``proc`` and ``sys`` are.

    Returns
    -------
    int or None
        None where the system does not tell.
    """
    return min((max(left, 0) for left in (*_of_machine(root), *_of_groups(root), *_of_process(root))), default=None)


def _of_machine(root: Path) -> Iterator[int]:
    lines = _lines(root / "proc/meminfo")
    found = [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    try:
        yield found[0] if found else os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return


def _of_groups(root: Path) -> Iterator[int]:
    """What is left of the limit of each control group that the process is in, and of those around it."""
    for line in _lines(root / "proc/self/cgroup"):
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            folder, limit, usage, cache = root / "sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"
        elif "memory" in controllers.split(","):
            folder, limit = root / "sys/fs/cgroup/memory", "memory.limit_in_bytes"
            usage, cache = "memory.usage_in_bytes", "total_inactive_file"
        else:
            continue
        # In a container, the path may be one outside of it.
        own = folder / path.lstrip("/")
        for group in (own, *own.parents):
            allowed, used = (_number(group / name) for name in (limit, usage))
            if allowed is not None and used is not None:
                # Files that were read are dropped when memory is needed.
                dropped = [int(v.split()[1]) for v in _lines(group / "memory.stat") if v.startswith(f"{cache} ")]
                yield allowed - used + sum(dropped)
            if group == folder:
                break


def _of_process(root: Path) -> Iterator[int]:
    if resource is None:
        return
    allowed, used = resource.getrlimit(resource.RLIMIT_AS)[0], _lines(root / "proc/self/statm")
    if allowed != resource.RLIM_INFINITY and used:
        yield allowed - int(used[0].split()[0]) * resource.getpagesize()


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []


def _number(path: Path) -> int | None:
    """None where there is no such file, or no limit."""
    lines = _lines(path)
    return int(lines[0]) if lines and lines[0].isdigit() else None
