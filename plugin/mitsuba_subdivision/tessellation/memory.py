"""Memory available to the process within its limits, and memory needed by a tessellation."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from .uniform_grid import UniformGrid

if TYPE_CHECKING:
    from ..patches.patch_table import PatchTable

# Measured peak memory of a uniform tessellation, in bytes: of a vertex, with its point, normal and two triangles, and
# of a sample of a class of patches.
VERTEX_BYTES, SAMPLE_BYTES = 90, 900
# Peak bytes per triangle of an adaptive tessellation, with its vertices and their weights.
ADAPTIVE_TRIANGLE_BYTES = 400
# Bytes that are assumed to be available, because a query takes half as long as computing a small cage's weights.
SMALL = 1 << 24


def bytes_of_tessellation(patches: PatchTable, grid: UniformGrid) -> int:
    """Estimate of a uniform tessellation's peak memory."""
    rate, refined = grid.rate, patches.refined
    in_whole = (rate + 1) ** 2 if patches.scheme.domain.corner_count == 4 else (rate + 1) * (rate + 2) // 2
    # A patch at a corner of an element has half the segments along each side.
    at_corner = (rate // 2 + 1) ** 2
    sample_count = 0
    for patch_class in patches.evaluated.classes:
        is_whole = refined is None and patches.is_whole[patches.elements.face[patch_class.corners[:1]]][0]
        sample_count += in_whole if is_whole else at_corner
    return VERTEX_BYTES * grid.vertex_count + SAMPLE_BYTES * sample_count


def require_memory(patches: PatchTable, grid: UniformGrid) -> None:
    """Check that a uniform tessellation fits into memory. Raises a MemoryError that names a rate that would."""
    needed = bytes_of_tessellation(patches, grid)
    available = exceeded_limit(needed)
    if available is None:
        return

    def needed_at(rate: int) -> int:
        return bytes_of_tessellation(patches, UniformGrid(grid.domain, grid.topology, rate))

    fits = bisect_right(range(1, grid.rate), available, key=needed_at)
    expected = f"expected at most {fits}" if fits else "not even a rate of 1 fits"
    raise MemoryError(
        f"tessellation rate {grid.rate} needs about {needed / 1e9:.3g} GB, and {available / 1e9:.3g} GB are available; "
        f"{expected}"
    )


def require_memory_for_triangles(count: int) -> None:
    """Check that an adaptive tessellation fits into memory. Raises MemoryError if not."""
    needed = ADAPTIVE_TRIANGLE_BYTES * count
    available = exceeded_limit(needed)
    if available is not None:
        raise MemoryError(
            f"an adaptive tessellation of about {count:.3g} triangles needs about {needed / 1e9:.3g} GB, and "
            f"{available / 1e9:.3g} GB are available; expected a larger error, or a smaller highest rate"
        )


def exceeded_limit(needed: float) -> int | None:
    """The available bytes if less than ``needed``; else None."""
    if needed <= SMALL:
        return None
    limit = available_memory()
    return None if limit is None or needed <= limit else limit


def available_memory(root: Path = Path("/")) -> int | None:
    """Bytes that the machine, the process's control groups and its own limit leave; None if that is not reported.

    The folders `proc` and `sys` are in ``root``.
    """
    machine = [line.split()[1] for line in _lines(root / "proc/meminfo") if line.startswith("MemAvailable:")]
    left = [*(1024 * int(kilobytes) for kilobytes in machine), *_of_groups(root), *_of_process(root)]
    return min((max(count, 0) for count in left), default=None)


def _of_groups(root: Path) -> Iterator[int]:
    """Memory left within the limits of the process's control groups, and of their ancestors."""
    for line in _lines(root / "proc/self/cgroup"):
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            folder, limit, usage, cache = root / "sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"
        elif "memory" in controllers.split(","):
            folder, limit = root / "sys/fs/cgroup/memory", "memory.limit_in_bytes"
            usage, cache = "memory.usage_in_bytes", "total_inactive_file"
        else:
            continue
        # In a container, the path may be that of the host. Its parents up to the folder are tried as well.
        innermost = folder / path.lstrip("/")
        for group in (innermost, *innermost.parents):
            allowed, used = (_number(group / name) for name in (limit, usage))
            if allowed is not None and used is not None:
                # The file cache counts as used, but is dropped when memory is needed.
                stat = _lines(group / "memory.stat")
                cached = [int(line.split()[1]) for line in stat if line.startswith(f"{cache} ")]
                yield allowed - used + sum(cached)
            if group == folder:
                break


def _of_process(root: Path) -> Iterator[int]:
    pages = _lines(root / "proc/self/statm")
    if pages:
        import resource

        allowed = resource.getrlimit(resource.RLIMIT_AS)[0]
        if allowed != resource.RLIM_INFINITY:
            yield allowed - int(pages[0].split()[0]) * resource.getpagesize()


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []


def _number(path: Path) -> int | None:
    lines = _lines(path)
    return int(lines[0]) if lines and lines[0].isdigit() else None
