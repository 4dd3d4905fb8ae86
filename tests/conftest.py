"""Fixtures for all tests.

``variant_<name>`` sets one variant of Mitsuba and ``variants_<group>`` runs a test in each variant of a group. What is
not compiled into Mitsuba, or has no backend on this machine, is skipped.
"""

import gc
import os
from collections import defaultdict

# All cores have tests to run: a BLAS or FLIP of several threads in each process has them wait for each other, which
# takes twice the time of the processors. Before NumPy is imported; processes that tests start have it from here.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import quick_kernels  # noqa: F401, I001 - before drjit, as it chooses the LLVM library
import drjit as dr
import mitsuba as mi
from patches.closed_cages import cube_with_hexagon, tetrahedron, torus
import numpy as np
import pytest
from mitsuba_subdivision.cage import ControlCage, named_cages
from mitsuba_subdivision.variants import variant_problem


ALL_THREADS = dr.thread_count()
# Folders of tests that compute with Dr.Jit, but for those marked `threads`. Its threads wait for work in a loop, for 20
# ms each time, while the other processes of pytest have tests for all cores.
IN_ONE_THREAD = {
    *("documents", "evaluation", "figures", "fit", "gradients", "kernels"),
    *("patches", "regression", "shapes", "surface", "tessellation"),
}


# Cases of each core law, so that `-m core` takes half a minute: spread evenly over all of them.
CORE_CASES = 4


def pytest_collection_modifyitems(config, items):
    """Leave out exact shading in scalar variants, which have none, and with `-m core` most cases of each law."""

    def is_kept(item):
        given = [v for v in item.callspec.params.values() if isinstance(v, str)] if hasattr(item, "callspec") else []
        return "exact" not in given or not any(v.startswith("scalar_") for v in given)

    items[:] = filter(is_kept, items)
    if config.option.markexpr == "core":
        laws = defaultdict(list)
        for item in items:
            laws[item.nodeid.partition("[")[0]].append(item)
        items[:] = [item for cases in laws.values() for item in cases[:: -(-len(cases) // CORE_CASES)]]


def pytest_collection_finish():
    # Otherwise a tenth of the time of tests is that of the garbage collector, which visits all tests again and again.
    gc.freeze()
    gc.set_threshold(10_000)


@pytest.fixture(scope="module", autouse=True)
def _old_objects():
    """Let the garbage collector leave what earlier modules have cached, which it takes half a second to visit."""
    gc.collect()
    gc.freeze()


def pytest_runtest_setup(item):
    is_alone = item.path.parent.name in IN_ONE_THREAD and not item.get_closest_marker("threads")
    # A picture that a test before still writes ends with a call of Python, for which Dr.Jit would wait for ever.
    mi.Thread.wait_for_tasks()
    dr.set_thread_count(1 if is_alone else ALL_THREADS)
    if os.name != "posix" and item.get_closest_marker("posix"):
        pytest.skip("there are no programs of the shell, signals, pipes or links as on POSIX")


@pytest.fixture
def no_other_scene():
    """Free the scenes of earlier tests.

    Dr.Jit 1.5 cannot propagate derivatives forward through a ray while the shapes of another scene have derivatives,
    Mitsuba's own included, and its next derivative ends the process.
    """
    gc.collect()


@pytest.fixture
def few_pixels(monkeypatch):
    """Draw plots with few pixels: most of the time to draw one goes into packing them."""
    from matplotlib.figure import Figure

    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **more: save(figure, path, **{**more, "dpi": 20}))


@pytest.fixture
def np_rng():
    return np.random.default_rng(0)


_CAGES = {
    "cube": named_cages.cube,
    "tetrahedron": tetrahedron,
    "torus": lambda: torus(5, 4),
    "small torus": lambda: torus(3, 3),
    "valence 3": lambda: named_cages.extraordinary(3),
    "valence 5": lambda: named_cages.extraordinary(5),
    "dome": lambda: named_cages.extraordinary(7, closed=False),
    "mixed faces": cube_with_hexagon,
    "one triangle": lambda: ControlCage(np.eye(3), [[0, 1, 2]]),
}


@pytest.fixture(params=_CAGES)
def any_cage(request):
    return _CAGES[request.param]()


@pytest.fixture
def obj_file(tmp_path):
    """Function that writes text or bytes to ``cube.obj`` and returns its path."""

    def write(text):
        path = tmp_path / "cube.obj"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


_COMPILED = list(mi.variants())
_RGB = [v for v in _COMPILED if v.endswith("_rgb")]
_GROUPS = {"all": _COMPILED, "all_rgb": _RGB, "array_rgb": [v for v in _RGB if not v.startswith("scalar")]}
_GROUPS["all_ad_rgb"] = [v for v in _RGB if v.endswith("_ad_rgb")]


def _in_variant(variant: str):
    if reason := variant_problem(variant):
        pytest.skip(reason)
    mi.set_variant(variant)
    yield variant
    if not variant.startswith("scalar"):
        # What one test leaves on the device must not reach the next.
        dr.sync_thread()
        dr.kernel_history_clear()
        dr.flush_malloc_cache()
        dr.set_flag(dr.JitFlag.Default, True)


def _fixture(name: str, variants: list[str] | None = None):
    """One for each of some variants, or one of a variant's name."""

    @pytest.fixture(name=f"variants_{name}" if variants else f"variant_{name}", params=variants)
    def fixture(request):
        yield from _in_variant(request.param if variants else name)

    return fixture


for _name in {*_COMPILED, "scalar_rgb", "llvm_ad_rgb", "llvm_ad_spectral", "cuda_ad_rgb"}:
    globals()[f"variant_{_name}"] = _fixture(_name)
for _name, _variants in _GROUPS.items():
    globals()[f"variants_{_name}"] = _fixture(_name, _variants)
