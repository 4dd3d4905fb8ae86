import os
import re
import subprocess
import sys
import tracemalloc

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.tessellation.criterion import Criterion
from mitsuba_subdivision.tessellation.memory import available_memory
from mitsuba_subdivision.tessellation.uniform import uniform_table
from patches.closed_cages import tetrahedron, torus, triangulated

MEGABYTE = 1 << 20
CHORD = Criterion("chord", 0.1)


@pytest.fixture
def leave(monkeypatch):
    """Function that says how many bytes are available."""
    return lambda count: monkeypatch.setattr("mitsuba_subdivision.tessellation.memory.available_memory", lambda: count)


def system(folder, group="", own="", **files):
    """A system's folders: the line of /proc/self/cgroup, pages of the process, and files of control groups."""
    files = {f"sys/fs/cgroup/{name}": text for name, text in files.items()}
    memory = "MemTotal: 2000 kB\nMemAvailable:    1000 kB"
    for name, text in {"proc/meminfo": memory, "proc/self/cgroup": group, "proc/self/statm": own, **files}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n" if text else "")
    return folder


GROUP = {"a/b/memory.max": "90000", "a/b/memory.current": "60000", "a/b/memory.stat": "anon 40000\ninactive_file 5000"}
FIRST_VERSION = {
    "memory/a/memory.limit_in_bytes": "3000",
    "memory/a/memory.usage_in_bytes": "1000",
    "memory/a/memory.stat": "inactive_file 1\ntotal_inactive_file 50",
}


@pytest.mark.parametrize(
    ("group", "files", "expected"),
    [
        ("", {}, 1000 * 1024),
        ("0::/a/b", {**GROUP, "a/memory.max": "max", "a/memory.current": "5000"}, 35_000),
        # The group around it has less left.
        ("0::/a/b", {**GROUP, "a/memory.max": "25000", "a/memory.current": "5000"}, 20_000),
        # In a container, the path need not exist, and the group is the first one.
        ("0::/docker/1", {"memory.max": "7000", "memory.current": "8000"}, 0),
        ("4:cpu,memory:/a\n3:cpu:/a", FIRST_VERSION, 2050),
    ],
)
def test_available_memory_is_the_least_of_machine_and_groups(group, files, expected, tmp_path):
    assert available_memory(system(tmp_path, group, **files)) == expected


def test_the_memory_limit_of_the_process_counts(tmp_path, monkeypatch):
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(resource, "getrlimit", lambda _: (300 * resource.getpagesize(), 0))
    assert available_memory(system(tmp_path, own="200 100 1")) == 100 * resource.getpagesize()


@pytest.mark.parametrize(("cage", "scheme"), [(tetrahedron(), "loop"), (named_cages.extraordinary(7), None)])
def test_the_suggested_rate_is_the_highest_possible(cage, scheme, leave, monkeypatch):
    surface = LimitSurface(cage, scheme)
    monkeypatch.setattr("mitsuba_subdivision.tessellation.memory.SMALL", 0)
    leave(MEGABYTE)
    message = r"rate 300 needs about [\d.e+-]+ GB, and 0.00105 GB are available; expected at most (\d+)$"
    with pytest.raises(MemoryError, match=message) as error:
        surface.tessellate(300)
    fits = int(re.search(message, str(error.value))[1])
    assert fits > 1
    surface.tessellate(fits)
    with pytest.raises(MemoryError, match=f"at most {fits}$"):
        surface.sampling(fits + 1)
    leave(10)
    with pytest.raises(MemoryError, match="not even a rate of 1 fits"):
        surface.sampling(1)
    leave(None)
    surface.sampling(8)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_the_shape_raises_the_same_error(leave):
    leave(MEGABYTE)
    shape = {"type": "subdivision", **named_cages.cube().as_properties(mi), "tessellation_rate": 300}
    with pytest.raises(RuntimeError, match=r"tessellation rate 300 needs about .* expected at most"):
        mi.load_dict(shape)


LIMITED = f"""
import re, resource
import mitsuba_subdivision as msub
from mitsuba_subdivision.cage import named_cages
surface = msub.LimitSurface(named_cages.cube())
surface.tessellate(8)
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + {200 * MEGABYTE}, resource.RLIM_INFINITY))
try:
    surface.tessellate(5000)
except MemoryError as error:
    print(error)
    fits = int(re.search(r"at most (\\d+)$", str(error))[1])
# It is an estimate: allocators keep more than they are asked for.
resource.setrlimit(resource.RLIMIT_AS, (used + {300 * MEGABYTE}, resource.RLIM_INFINITY))
print(len(surface.tessellate(fits).positions))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of the process are read from /proc")
def test_a_cube_at_5000_is_an_error_and_no_more_than_the_estimate_is_needed():
    # Threads of other libraries would reserve memory of their own.
    settings = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    printed = subprocess.check_output([sys.executable, "-c", LIMITED], text=True, timeout=120, env=settings)
    message, count = printed.strip().splitlines()
    fits = int(re.fullmatch(r"tessellation rate 5000 needs about 36 GB, .* expected at most (\d+)", message)[1])
    assert 300 < fits < 500
    assert int(count) == 6 * fits**2 + 2


# Rates of an adaptive grid have 16 bits.
MAX_RATES = (0, -1, 2.5, "8", None, 1025, 40_000)
OF_ANOTHER_CAGE = (np.zeros((5, 3)), np.zeros((9, 3)), np.full((8, 3), np.nan))


@pytest.mark.parametrize(
    ("make", "values", "message"),
    [
        (LimitSurface.tessellate, (2.5, "8", None, np.array([1, 2])), "tessellation rate .*; expected an integer"),
        (LimitSurface.tessellate, (0, -1), "tessellation rate (0|-1); expected 1 or more"),
        (lambda s, rate: uniform_table(s.patches, rate), (0, -1), "tessellation rate (0|-1); expected 1 or more"),
        (lambda s, rate: s.adaptive_sampling(CHORD, rate), MAX_RATES, "expected (an integer|1 or more|at most 1024)"),
        (lambda s, p: s.adaptive_sampling(CHORD, control_points=p), OF_ANOTHER_CAGE, r"finite ones of shape \(8, 3\)"),
        (lambda _, error: Criterion("chord", error), (-1e-3, np.nan), "expected a number from 0 on"),
    ],
)
def test_invalid_tessellation_options_are_errors(make, values, message):
    for value in values:
        with pytest.raises(ValueError, match=message):
            make(LimitSurface(named_cages.cube()), value)


def test_a_tessellation_is_shown_by_its_sizes():
    assert repr(LimitSurface(named_cages.cube()).tessellate(np.int64(2))) == "Tessellation(26 vertices, 48 triangles)"


def test_the_coarsest_triangles_of_a_dense_cage_take_at_most_twice_the_memory_of_uniform_ones():
    """At the peak, from a cage to points, normals and triangles."""
    cage = triangulated(torus(60, 50))

    def measured(make):
        tracemalloc.start()
        try:
            before, _ = tracemalloc.get_traced_memory()
            table = make(LimitSurface(cage))
            count = len(table.triangles)
            table.apply(cage.positions)
            return tracemalloc.get_traced_memory()[1] - before, count
        finally:
            tracemalloc.stop()

    makers = (lambda s: s.sampling(2), lambda s: s.adaptive_sampling(Criterion("chord", 100.0)))
    # Twice, as what surfaces share stays in memory.
    for _ in range(2):
        (uniform, count), (coarsest, coarsest_count) = map(measured, makers)
    assert coarsest_count == count
    assert coarsest <= 2 * uniform
