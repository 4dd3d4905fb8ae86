"""Tessellations that would not fit into memory are refused before."""

import os
import re
import subprocess
import sys
import tracemalloc

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.tessellation import Criterion, Measure
from mitsuba_subdivision.tessellation.memory import available_memory

MEGABYTE = 1 << 20


def system(folder, groups="", own="", **files):
    """A system's folders: lines of /proc/self/cgroup, and files of control groups by their paths."""
    texts = {
        "proc/meminfo": "MemTotal: 2000 kB\nMemAvailable:    1000 kB\n",
        "proc/self/cgroup": groups,
        "proc/self/statm": own,
        **files,
    }
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def test_memory_is_the_least_that_the_machine_and_its_groups_leave(tmp_path):
    assert available_memory(system(tmp_path / "machine")) == 1000 * 1024
    v2 = {
        "sys/fs/cgroup/a/memory.max": "max\n",
        "sys/fs/cgroup/a/memory.current": "5000\n",
        "sys/fs/cgroup/a/b/memory.max": "90000\n",
        "sys/fs/cgroup/a/b/memory.current": "60000\n",
        "sys/fs/cgroup/a/b/memory.stat": "anon 40000\ninactive_file 5000\n",
    }
    assert available_memory(system(tmp_path / "own", "0::/a/b\n", **v2)) == 35_000
    # The group around it has less left.
    v2["sys/fs/cgroup/a/memory.max"] = "25000\n"
    assert available_memory(system(tmp_path / "outer", "0::/a/b\n", **v2)) == 20_000
    # In a container, the path need not exist, and the group is the first one.
    inside = {"sys/fs/cgroup/memory.max": "7000\n", "sys/fs/cgroup/memory.current": "8000\n"}
    assert available_memory(system(tmp_path / "container", "0::/docker/1\n", **inside)) == 0
    v1 = {
        "sys/fs/cgroup/memory/a/memory.limit_in_bytes": "3000\n",
        "sys/fs/cgroup/memory/a/memory.usage_in_bytes": "1000\n",
        "sys/fs/cgroup/memory/a/memory.stat": "inactive_file 1\ntotal_inactive_file 50\n",
    }
    assert available_memory(system(tmp_path / "v1", "4:cpu,memory:/a\n3:cpu:/a\n", **v1)) == 2050


def test_the_process_s_own_limit_counts(tmp_path, monkeypatch):
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(resource, "getrlimit", lambda _: (300 * resource.getpagesize(), 0))
    assert available_memory(system(tmp_path, own="200 100 1\n")) == 100 * resource.getpagesize()


@pytest.mark.parametrize("name", ["cube", "tetrahedron", "extraordinary"])
def test_the_rate_that_is_offered_is_the_highest_that_fits(monkeypatch, name):
    cage = {"cube": named_cages.cube, "tetrahedron": named_cages.tetrahedron}.get(
        name, lambda: named_cages.extraordinary(7)
    )()
    surface = LimitSurface(cage, "loop" if name == "tetrahedron" else None)
    monkeypatch.setattr("mitsuba_subdivision.tessellation.memory.SMALL", 0)
    monkeypatch.setattr("mitsuba_subdivision.tessellation.memory.available_memory", lambda: MEGABYTE)
    message = r"rate 300 needs about [\d.e+-]+ GB, and 0.00105 GB are available; expected at most (\d+)$"
    with pytest.raises(MemoryError, match=message) as error:
        surface.tessellate(300)
    fits = int(re.search(message, str(error.value))[1])
    assert fits > 1
    surface.tessellate(fits)
    with pytest.raises(MemoryError, match=f"at most {fits}$"):
        surface.sampling(fits + 1)
    monkeypatch.setattr("mitsuba_subdivision.tessellation.memory.available_memory", lambda: 10)
    with pytest.raises(MemoryError, match="not even a rate of 1 fits"):
        surface.sampling(1)
    monkeypatch.setattr("mitsuba_subdivision.tessellation.memory.available_memory", lambda: None)
    surface.sampling(8)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_the_shape_says_so_too(monkeypatch):
    monkeypatch.setattr("mitsuba_subdivision.tessellation.memory.available_memory", lambda: MEGABYTE)
    shape = {"type": "subdivision", **named_cages.cube().as_properties(mi), "tessellation_rate": 300}
    with pytest.raises(RuntimeError, match=r"tessellation rate 300 needs about .* expected at most"):
        mi.load_dict(shape)


LIMITED = """
import sys, resource
import mitsuba_subdivision as msub
from mitsuba_subdivision.cage import named_cages
surface, rate = msub.LimitSurface(named_cages.cube()), int(sys.argv[1])
surface.tessellate(8)
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + int(sys.argv[2]), resource.RLIM_INFINITY))
try:
    print(len(surface.tessellate(rate).positions))
except MemoryError as error:
    print(error)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of the process are read from /proc")
def test_a_cube_at_5000_is_an_error_and_no_more_than_the_estimate_is_needed():
    def run(rate, limit):
        command = [sys.executable, "-c", LIMITED, str(rate), str(limit)]
        # Threads of other libraries would reserve memory of their own.
        settings = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=settings)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    said = run(5000, 200 * MEGABYTE)
    fits = int(re.fullmatch(r"tessellation rate 5000 needs about 32.7 GB, .* expected at most (\d+)", said)[1])
    assert 300 < fits < 500
    # It is an estimate: allocators keep more than they are asked for.
    assert int(run(fits, 300 * MEGABYTE)) == 6 * fits**2 + 2


def test_a_rate_of_a_wrong_type_is_an_error():
    surface = LimitSurface(named_cages.cube())
    for rate in (2.5, "8", None, np.array([1, 2])):
        with pytest.raises(ValueError, match=r"tessellation rate .*; expected an integer"):
            surface.tessellate(rate)
    assert len(surface.tessellate(np.int64(2)).positions) == 26


@pytest.mark.parametrize("rate", [0, -1, 2.5, "8", None, 1025, 40_000])
def test_a_wrong_max_rate_is_an_error(rate):
    # Rates of an adaptive grid have 16 bits.
    surface = LimitSurface(named_cages.cube())
    with pytest.raises(ValueError, match=r"max_rate .*; expected (an integer|1 or more|at most 1024)"):
        surface.adaptive_sampling(Criterion(Measure.CHORD, 0.1), rate)


def test_a_tessellation_is_shown_by_its_sizes():
    assert repr(LimitSurface(named_cages.cube()).tessellate(2)) == "Tessellation(26 vertices, 48 triangles)"


def test_the_coarsest_triangles_of_a_dense_cage_take_at_most_twice_the_memory_of_uniform_ones():
    """At the peak, from a cage to points, normals and triangles."""
    quads = named_cages.torus(100, 80)
    faces = quads.face_vertices.reshape(-1, 4)
    cage = ControlCage(quads.positions, np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]))

    def measured(make):
        tracemalloc.start()
        try:
            before = tracemalloc.get_traced_memory()[0]
            table = make(LimitSurface(cage))
            count = len(table.triangles)
            table.apply(cage.positions)
            return tracemalloc.get_traced_memory()[1] - before, count
        finally:
            tracemalloc.stop()

    makers = (lambda s: s.sampling(2), lambda s: s.adaptive_sampling(Criterion(Measure.CHORD, 100.0)))
    # Twice, as what surfaces share stays in memory.
    for _ in range(2):
        (uniform, count), (adaptive, adaptive_count) = map(measured, makers)
    assert adaptive_count == count
    assert adaptive <= 2 * uniform
