"""Shapes whose virtual functions are answered in Python: errors inside, lifetimes, variants, threads, and platforms."""

import gc
import subprocess
import sys
import threading
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.shapes import exact_shading, interaction_hook

if interaction_hook.hook_problem():
    pytest.skip(str(interaction_hook.hook_problem()), allow_module_level=True)


def make(variant=mi, **parameters):
    cage = named_cages.cube()
    return variant.load_dict(
        {"type": "subdivision", **cage.as_properties(variant), "tessellation_rate": 2, "shading": "exact", **parameters}
    )


def interaction(shape, variant=mi):
    """Of a ray that meets the cube's top away from the triangles' corners."""
    scene = variant.load_dict({"type": "scene", "shape": shape})
    return scene.ray_intersect(variant.Ray3f([0.13, 0.21, 4], [0, 0, -1]))


def vector(value):
    return np.array(value, dtype=np.float64).ravel()


@pytest.fixture(autouse=True)
def _nothing_is_reported_yet(monkeypatch):
    # Each error is reported once for each variant.
    for hook in interaction_hook._hooks.values():
        monkeypatch.setattr(hook, "_reported", set())


@pytest.mark.usefixtures("variants_all_rgb")
def test_an_error_is_reported_once_and_there_is_no_hit(monkeypatch, capsys):
    def fail(*_):
        raise ValueError("answer")

    shape = make()
    assert interaction(shape).is_valid()
    monkeypatch.setattr(exact_shading.ExactShading, "complete", fail)
    for _ in range(2):
        assert not dr.any(interaction(shape).is_valid())
    assert capsys.readouterr().err.count("ValueError: answer") == 1


def test_an_interruption_comes_again_when_c_has_returned():
    code = (
        "import mitsuba_subdivision, mitsuba as mi, signal, time\n"
        "from mitsuba_subdivision.cage import named_cages\n"
        "from mitsuba_subdivision.shapes import exact_shading\n"
        # What runs in the background of a shell ignores interruptions otherwise.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "def interrupt(*_):\n"
        "    raise KeyboardInterrupt\n"
        "exact_shading.ExactShading.complete = interrupt\n"
        "shape = {'type': 'subdivision', **named_cages.cube().as_properties(mi), 'shading': 'exact'}\n"
        "scene = mi.load_dict({'type': 'scene', 'shape': shape})\n"
        "try:\n"
        "    scene.ray_intersect(mi.Ray3f([0, 0, 4], [0, 0, -1]))\n"
        "    for _ in range(200):\n"
        "        time.sleep(0.1)\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "interrupted\n", done.stderr


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_sizes_that_do_not_fit_are_an_error_and_no_crash(capsys):
    shape = make()
    scene = mi.load_dict({"type": "scene", "shape": shape})
    rays = mi.Ray3f(mi.Point3f([0.13, 0, 0.1], 0.21, 4), mi.Vector3f(0, 0, -1))
    found = shape.compute_surface_interaction(
        rays, scene.ray_intersect_preliminary(rays), active=mi.Mask([True, False])
    )
    assert not dr.any(found.is_valid())
    assert "3 hits, 2 masks; expected as many" in capsys.readouterr().err


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_shapes_that_are_made_in_parallel_share_a_hook():
    """Mitsuba makes the shapes of a scene in parallel; the table of one hook must not be given up for another's."""
    code = (
        "import mitsuba_subdivision, mitsuba as mi, numpy as np\n"
        "from mitsuba_subdivision.cage import named_cages\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "shape = {'type': 'subdivision', **named_cages.cube().as_properties(mi), 'shading': 'exact'}\n"
        "scene = mi.load_dict({'type': 'scene', **{f's{i}': dict(shape) for i in range(12)}})\n"
        "assert scene.ray_intersect(mi.Ray3f([0, 0, 4], [0, 0, -1])).is_valid()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_errors_about_attributes_are_reported_and_leave_mitsubas_result(monkeypatch, capsys):
    shape = make(vertex_heat=mi.TensorXf(np.arange(8.0, dtype=np.float32)[:, None]))
    si = interaction(shape)
    exact = shape.eval_attribute_1("vertex_heat", si)[0]

    def fail(*_):
        raise ValueError("attribute")

    monkeypatch.setattr(exact_shading.ExactShading, "attribute", fail)
    assert shape.eval_attribute_1("vertex_heat", si)[0] == pytest.approx(exact, abs=0.5)
    assert capsys.readouterr().err.count("ValueError: attribute") == 1


@pytest.mark.usefixtures("variants_all_rgb")
def test_shapes_come_and_go():
    # Addresses are used again, so that answers kept for too long would be those of another cage.
    expected = vector(interaction(make()).sh_frame.n)
    for turn in range(120):
        shape = make(flip_normals=turn % 2 == 1)
        if turn % 40 < 2:
            sign = -1 if turn % 2 else 1
            np.testing.assert_allclose(vector(interaction(shape).sh_frame.n), sign * expected, atol=1e-6)
    plain = mi.load_dict({"type": "sphere"})
    assert vector(interaction(plain).p)[2] == pytest.approx(np.sqrt(1 - 0.13**2 - 0.21**2), abs=1e-5)


@pytest.mark.usefixtures("variants_all_rgb")
def test_shapes_are_freed_with_their_scenes():
    shape = make()
    scene = mi.load_dict({"type": "scene", "shape": shape})
    scene.ray_intersect(mi.Ray3f([0, 0, 4], [0, 0, -1]))
    alive = weakref.ref(shape._exact), weakref.ref(shape)
    del shape
    gc.collect()
    # The scene has it still.
    assert alive[0]() is not None
    del scene
    gc.collect()
    assert [each() for each in alive] == [None, None]


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_a_scene_outlives_the_names_of_its_shapes():
    scenes = [mi.load_dict({"type": "scene", "shape": make(), "other": make()}) for _ in range(3)]
    gc.collect()
    normals = [vector(each.ray_intersect(mi.Ray3f([0.13, 0.21, 4], [0, 0, -1])).n) for each in scenes]
    np.testing.assert_array_equal(normals, [normals[0]] * len(scenes))
    assert np.linalg.norm(normals[0] - [0, 0, 1]) > 0.05


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_variants_side_by_side():
    names = [
        name for name in mi.variants() if name in ("scalar_rgb", "llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono")
    ]
    shapes, found = {}, {}
    for name in names:
        mi.set_variant(name)
        shapes[name] = make()
    for name in reversed(names):
        mi.set_variant(name)
        found[name] = vector(interaction(shapes[name]).sh_frame.n)
    for normal in found.values():
        np.testing.assert_allclose(normal, found["scalar_rgb"], atol=1e-6)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_threads_of_scalar_variants_ask_at_once():
    scene = mi.load_dict({"type": "scene", "shape": make()})
    xs = np.linspace(-0.4, 0.4, 8)

    def ask(x):
        return vector(scene.ray_intersect(mi.Ray3f([float(x), 0.1, 4], [0, 0, -1])).n)

    expected = [ask(x) for x in xs]
    found = {}
    threads = [threading.Thread(target=lambda k=k: found.update({k: [ask(x) for x in xs]})) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for each in found.values():
        np.testing.assert_array_equal(each, expected)
    assert len(found) == len(threads)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_mitsubas_own_threads_ask_as_well():
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    to_world = mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 0], [0, 0, 1])
    sensor = {"type": "perspective", "to_world": to_world, "film": film}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant"}, "a": sensor,
                          "shape": make()})  # fmt: skip
    images = [np.array(mi.render(scene, spp=1, seed=3)) for _ in range(2)]
    np.testing.assert_array_equal(*images)
    assert np.isfinite(images[0]).all()


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_inactive_lanes_may_have_any_triangle():
    shape = make()
    scene = mi.load_dict({"type": "scene", "shape": shape})
    ray = mi.Ray3f(mi.Point3f([0.13, 0.21], [0.21, 9], 4), [0, 0, -1])
    preliminary = scene.ray_intersect_preliminary(ray)
    is_hit = preliminary.is_valid()
    assert np.array(is_hit).tolist() == [True, False]
    preliminary.prim_index = dr.select(is_hit, preliminary.prim_index, 0xFFFFFFF0)
    found = shape.compute_surface_interaction(ray, preliminary, mi.RayFlags.All, is_hit)
    expected = scene.ray_intersect(ray)
    np.testing.assert_array_equal(np.array(found.n)[:, 0], np.array(expected.n)[:, 0])


# Where it cannot be


@pytest.fixture
def _asked_again():
    interaction_hook.hook_problem.cache_clear()
    yield
    interaction_hook.hook_problem.cache_clear()


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("sys.platform", "darwin", "CPython on Linux on x86-64, until Mitsuba 3.10; this is "),
        ("platform.machine", lambda: "aarch64", "CPython on Linux on x86-64, until Mitsuba 3.10; this is "),
        ("mi.__version__", "3.9.2", "needs Mitsuba 3.9.1; this is 3.9.2"),
        (
            "_POINTER_OF",
            "no_such_function",
            "needs the functions of Mitsuba's bindings by their names: .*no_such_function",
        ),
    ],
)
@pytest.mark.usefixtures("variant_llvm_ad_rgb", "_asked_again")
def test_a_shape_says_why_it_cannot_be_hooked(monkeypatch, place, value, message):
    monkeypatch.setattr(interaction_hook, "_hooks", {})
    monkeypatch.setattr(f"mitsuba_subdivision.shapes.interaction_hook.{place}", value)
    with pytest.raises(RuntimeError, match=message):
        make()
    assert mi.load_dict({"type": "subdivision", **named_cages.cube().as_properties(mi)}).face_count() > 0


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_a_class_without_the_functions_is_rejected(monkeypatch):
    monkeypatch.setattr(interaction_hook, "_virtual_functions", lambda *_: [0, 0, 0])
    with pytest.raises(RuntimeError, match="0 virtual functions compute_surface_interaction; expected one"):
        interaction_hook.InteractionHook(sys.modules["mitsuba"].llvm_ad_rgb, make())
