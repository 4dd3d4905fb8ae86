"""Shapes whose virtual functions are answered in Python: errors inside, lifetimes, variants, threads, and platforms."""

import contextlib
import gc
import mmap
import re
import subprocess
import sys
import traceback
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.shapes import exact_shading
from mitsuba_subdivision.shapes.mitsuba_3_9_hook import hook_trial, interaction_hook, machine_code

pytestmark = pytest.mark.threads

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


def fail(*_):
    raise AnswerError("answer")


class AnswerError(Exception):
    """Of these tests."""


def scene_of(shape, integrator="path", size=16):
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    to_world = mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 0], [0, 0, 1])
    sensor = {"type": "perspective", "to_world": to_world, "film": film}
    sky = {"type": "constant"}
    return mi.load_dict({"type": "scene", "integrator": {"type": integrator}, "sky": sky, "a": sensor, "shape": shape})


def program(code, variant):
    """Run a program in a process of its own, which may crash, and return what it prints."""
    begin = (
        "import mitsuba_subdivision, mitsuba as mi, drjit as dr, numpy as np, signal\n"
        "from mitsuba_subdivision.cage import named_cages\n"
        "from mitsuba_subdivision.shapes import exact_shading\n"
        # What runs in the background of a shell ignores interruptions otherwise.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"mi.set_variant({variant!r})\n"
        "def shape(shading):\n"
        "    cage = named_cages.cube().as_properties(mi)\n"
        "    return {'type': 'subdivision', **cage, 'tessellation_rate': 2, 'shading': shading}\n"
    )
    done = subprocess.run([sys.executable, "-c", begin + code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


# Errors


@pytest.mark.usefixtures("variants_array_rgb")
def test_an_error_is_raised_by_what_caused_it_and_by_nothing_else(monkeypatch, capfd):
    shape = make()
    scene = scene_of(shape)
    expected = vector(interaction(shape).n)
    picture = np.array(mi.render(scene, spp=1, seed=3))
    with monkeypatch.context() as during:
        during.setattr(exact_shading.ExactShading, "complete", fail)
        for _ in range(2):
            with pytest.raises(AnswerError, match=r"^answer$"):
                interaction(shape)
            with pytest.raises(AnswerError, match=r"^answer$"):
                mi.render(scene, spp=1)
    assert sys.gettrace() is None
    np.testing.assert_array_equal(vector(interaction(shape).n), expected)
    np.testing.assert_array_equal(np.array(mi.render(scene, spp=1, seed=3)), picture)
    assert capfd.readouterr().err == ""


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_errors_pass_through_loops_and_derivatives(monkeypatch):
    scene = scene_of(make(), "prb")
    parameters = mi.traverse(scene)
    key = "shape.control_points"
    dr.enable_grad(parameters[key])
    parameters.update()
    picture = mi.render(scene, parameters, spp=1)
    monkeypatch.setattr(exact_shading.ExactShading, "complete", fail)
    with pytest.raises(AnswerError, match=r"^answer$"):
        dr.backward(dr.mean(picture))
    with pytest.raises(AnswerError, match=r"^answer$"):
        mi.render(scene, parameters, spp=1)


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_errors_inside_a_loop_of_the_answer_are_themselves(monkeypatch):
    def loop(_, si, *__):
        dr.while_loop((mi.UInt32(si.prim_index),), lambda i: i < 3, fail)

    monkeypatch.setattr(exact_shading.ExactShading, "complete", loop)
    with pytest.raises(AnswerError, match=r"^answer$"):
        interaction(make())


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_with_a_debugger_errors_are_causes(monkeypatch):
    scene = scene_of(make())
    monkeypatch.setattr(exact_shading.ExactShading, "complete", fail)
    tracer = sys.gettrace()
    sys.settrace(lambda *_: None)
    try:
        with pytest.raises(RuntimeError, match="RenderOp") as caught:
            mi.render(scene, spp=1)
    finally:
        sys.settrace(tracer)
    assert isinstance(caught.value.__cause__, AnswerError)


@pytest.mark.usefixtures("variants_array_rgb")
def test_errors_keep_no_objects_of_c(monkeypatch):
    shape = make()

    def complete(_, si, *others):
        del others
        raise AnswerError(type(si).__name__)

    monkeypatch.setattr(exact_shading.ExactShading, "complete", complete)
    with pytest.raises(AnswerError) as caught:
        interaction(shape)
    frames = {frame.f_code.co_name: frame for frame, _ in traceback.walk_tb(caught.value.__traceback__)}
    assert frames["complete"].f_locals == frames["answer"].f_locals == {}


@pytest.mark.usefixtures("variants_array_rgb")
def test_errors_go_with_their_last_name(monkeypatch):
    # And with them, what their frames hold; not when the collector comes by.
    scene, alive = scene_of(make()), []

    def complete(*_):
        error = AnswerError()
        alive.append(weakref.ref(error))
        raise error

    monkeypatch.setattr(exact_shading.ExactShading, "complete", complete)
    gc.disable()
    try:
        with contextlib.suppress(AnswerError):
            mi.render(scene, spp=1)
        assert {each() for each in alive} == {None}
    finally:
        gc.enable()


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_errors_leave_no_variables_behind():
    code = (
        "import contextlib\n"
        "scene = mi.load_dict({'type': 'scene', 'shape': shape('exact')})\n"
        "def fail(self, si, hit):\n"
        "    si.uv = mi.Point2f(3 * si.p.x, si.p.y)\n"
        "    raise ValueError\n"
        "def ask():\n"
        "    with contextlib.suppress(ValueError):\n"
        "        scene.ray_intersect(mi.Ray3f(mi.Point3f(dr.arange(mi.Float, 5), 0.1, 4), [0, 0, -1]))\n"
        "    return dr.whos(as_string=True).count('\\n')\n"
        "exact_shading.ExactShading.complete = fail\n"
        "print(len({ask() for _ in range(3)}))\n"
    )
    assert program(code, "llvm_ad_rgb") == "1\n"


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_mitsubas_own_errors_are_those_of_vertex_shading():
    """An exception of C++ passes by Python: flags, sizes and indices that do not fit are errors, and no crash."""
    rays = mi.Ray3f(mi.Point3f([0.13, 0, 0.1], 0.21, 4), mi.Vector3f(0, 0, -1))
    ray = mi.Ray3f([0.13, 0.21, 4], [0, 0, -1])
    flags = mi.RayFlags.DetachShape | mi.RayFlags.FollowShape

    def errors(shading):
        shape = make(shading=shading)
        scene = mi.load_dict({"type": "scene", "shape": shape})
        found = scene.ray_intersect_preliminary(rays)
        outside = scene.ray_intersect_preliminary(ray)
        outside.prim_index = mi.UInt32(100000)
        for ask in (
            lambda: shape.compute_surface_interaction(rays, found, flags),
            lambda: shape.compute_surface_interaction(rays, found, active=mi.Mask([True, False])),
            lambda: shape.compute_surface_interaction(ray, outside),
            lambda: shape.eval_attribute_1("face_element", scene.ray_intersect(rays), mi.Mask([True, False])),
        ):
            with pytest.raises(RuntimeError) as caught:
                ask()
            yield re.sub("r[0-9]+", "", str(caught.value))

    assert list(errors("exact")) == list(errors("vertex"))


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_errors_about_attributes_are_raised(monkeypatch):
    shape = make(vertex_heat=upload(mi.TensorXf, np.arange(8.0, dtype=np.float32)[:, None]))
    si = interaction(shape)
    exact = shape.eval_attribute_1("vertex_heat", si)[0]
    with monkeypatch.context() as during:
        during.setattr(exact_shading.ExactShading, "attribute", fail)
        for evaluate in (shape.eval_attribute, shape.eval_attribute_1):
            with pytest.raises(AnswerError, match=r"^answer$"):
                evaluate("vertex_heat", si)
    assert shape.eval_attribute_1("vertex_heat", si)[0] == exact


# Interruptions

INTERRUPTED = """
import os, threading, time
def chain(error):
    return [] if error is None else [type(error).__name__, *chain(error.__cause__)]
scenes = {}
for shading in ("vertex", "exact"):
    film = {"type": "hdrfilm", "width": WIDTH, "height": WIDTH}
    to_world = mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 0], [0, 0, 1])
    shapes = {f"shape{i}": shape(shading) for i in range(COUNT)}
    scenes[shading] = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "to_world": to_world, "film": film}, **shapes})
    mi.render(scenes[shading], spp=1)
mi.set_log_level(mi.LogLevel.Error)
def interrupt():
    global sent
    sent = time.monotonic()
    os.kill(os.getpid(), signal.SIGINT)
for shading, scene in scenes.items():
    for turn in range(2):
        threading.Timer(0.1 + 0.05 * turn, interrupt).start()
        try:
            while True:
                mi.render(scene, spp=SAMPLES)
        except BaseException as error:
            took, kinds = time.monotonic() - sent, chain(error)
        assert kinds[-1] == "KeyboardInterrupt" and took < 1, (shading, turn, kinds, took)
        # It does not come again.
        time.sleep(0.05)
        print(shading, *kinds)
"""


# Many renders, which take most of their time in answers.
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_an_interruption_is_raised_when_mitsuba_has_returned():
    turns = program(f"WIDTH, COUNT, SAMPLES = 8, 40, 1\n{INTERRUPTED}", "llvm_ad_rgb").splitlines()
    assert [turn.split()[0] for turn in turns] == ["vertex"] * 2 + ["exact"] * 2


@pytest.mark.usefixtures("variants_array_rgb")
def test_an_interruption_inside_an_answer_is_raised(monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    scene = scene_of(make())
    monkeypatch.setattr(exact_shading.ExactShading, "complete", interrupt)
    with pytest.raises(KeyboardInterrupt):
        mi.render(scene, spp=1)


# Frozen functions and instances


@pytest.mark.parametrize("parameters", [{}, {"vertex_heat": 1}, {"scheme": "doo_sabin"}])
@pytest.mark.usefixtures("no_other_scene", "variant_llvm_ad_rgb")
def test_frozen_functions_render_as_others(parameters):
    if "vertex_heat" in parameters:
        heat = upload(mi.TensorXf, np.arange(8.0, dtype=np.float32)[:, None])
        bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_heat"}}
        parameters = {"vertex_heat": heat, "bsdf": bsdf}
    for shading in ("vertex", "exact"):
        scene = scene_of(make(shading=shading, **parameters))
        points = mi.traverse(scene)

        def render(scene, seed):
            return mi.render(scene, spp=2, seed=seed)

        frozen = dr.freeze(render)
        for seed in range(4):
            expected = np.array(render(scene, mi.UInt32(seed)))
            np.testing.assert_array_equal(np.array(frozen(scene, mi.UInt32(seed))), expected)
            if seed == 1:
                points["shape.control_points"] *= 1.1
                points.update()
        # Once, and again where control points have become an array of their own, or another scene is gone.
        assert frozen.n_recordings < 4


@pytest.fixture
def asked(monkeypatch, no_other_scene):  # noqa: ARG001
    """Shapes that are asked for interactions, one after the other. Shapes of earlier scenes would be asked as well."""
    found = []
    complete = exact_shading.ExactShading.complete

    def note(shading, *arguments):
        found.append(shading)
        complete(shading, *arguments)

    monkeypatch.setattr(exact_shading.ExactShading, "complete", note)
    return found


def cube(**parameters):
    cage = named_cages.cube().as_properties(mi)
    return {"type": "subdivision", **cage, "tessellation_rate": 2, "shading": "exact", **parameters}


def instance(group, place):
    to_world = mi.ScalarTransform4f().translate([2 * place, 0, 0]).rotate([0, 0, 1], 10 * place)
    return {"type": "instance", "to_world": to_world, "group": {"type": "ref", "id": group}}


def members(number, count):
    """Cubes above each other, and other shapes in the same group."""
    place = mi.ScalarTransform4f().translate
    shapes = {f"m{number}_{k}": cube(to_world=place([0, 0, 2 * k]).scale(1 + 0.1 * number)) for k in range(count)}
    shapes[f"ball{number}"] = {"type": "sphere", "radius": 0.5, "center": [0, 0, -2]}
    shapes[f"vertex{number}"] = cube(shading="vertex", to_world=place([0, 0, -4]))
    return {"type": "shapegroup", **shapes}


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_shapes_outside_groups_are_not_asked_inside_instances(asked):
    def answers(shapes, instances):
        scene = {"type": "scene", "group": {"type": "shapegroup", "a": cube()}}
        scene |= {f"shape{i}": cube() for i in range(shapes)}
        scene |= {f"instance{i}": instance("group", i + 1) for i in range(instances)}
        asked.clear()
        found = mi.load_dict(scene).ray_intersect(mi.Ray3f(mi.Point3f([0.13, 2.13], 0.21, 4), [0, 0, -1]))
        assert np.linalg.norm(np.array(found.n), axis=0) == pytest.approx(1, abs=1e-6)
        return len(asked)

    assert answers(4, 3) - answers(4, 1) == answers(1, 3) - answers(1, 1) == 2
    assert answers(4, 1) - answers(1, 1) == 3


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_shapes_of_other_groups_do_not_answer(asked):
    """Each shape answers twice, for itself and its group, and once in each instance of its own group."""

    def answers(groups, count, instances):
        scene = {"type": "scene", **{f"group{g}": members(g, count) for g in range(groups)}}
        scene |= {f"of{g}_{i}": instance(f"group{g}", g + i) for g in range(groups) for i in range(instances)}
        asked.clear()
        mi.load_dict(scene).ray_intersect(mi.Ray3f([0.13, 0.21, 9], [0, 0, -1]))
        return len(asked)

    for groups, count, instances in ((1, 1, 1), (1, 2, 3), (2, 1, 1), (2, 2, 3), (3, 2, 2)):
        assert answers(groups, count, instances) == groups * count * (2 + instances)


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_groups_side_by_side_are_as_each_alone():
    """Points, normals and their derivatives, of exact and of other shapes; in a frozen function, too."""
    x = np.linspace(-0.7, 0.7, 60, dtype=np.float32)
    origins = np.stack([6 + x, 0.3 * x, np.tile([5, -1, -3], len(x) // 3)], axis=1)
    ray = mi.Ray3f(upload(mi.Point3f, origins), mi.Vector3f(0.1, 0, -1))
    key = "group1.m1_0.control_points"

    def scene_of(*groups):
        shown = {f"group{g}": members(g, 1) for g in groups} | {f"of{g}": instance(f"group{g}", 3 * g) for g in groups}
        return mi.load_dict({"type": "scene", **shown})

    def found(scene):
        parameters = mi.traverse(scene)
        dr.enable_grad(parameters[key])
        parameters.update()
        si = scene.ray_intersect(ray)
        dr.backward(dr.sum(dr.select(si.is_valid(), dr.dot(si.p + si.sh_frame.n, mi.Vector3f(1, 2, 3)), 0)))
        values, gradient = (*si.p, *si.sh_frame.n, *si.dp_du, si.is_valid()), dr.grad(parameters[key])
        # In one kernel.
        dr.eval(values, gradient)
        return np.array([np.array(each) for each in values]), np.array(gradient)

    both = scene_of(0, 1)
    normals = np.array(dr.freeze(lambda scene, ray: scene.ray_intersect(ray).sh_frame.n)(both, ray))
    (values, gradient), (expected, expected_gradient) = found(both), found(scene_of(1))
    assert expected[-1].mean() > 0.5
    assert np.abs(expected_gradient).max() > 0.1
    np.testing.assert_allclose(values, expected, atol=1e-5)
    np.testing.assert_allclose(values[3:6], normals, atol=1e-6)
    np.testing.assert_allclose(gradient, expected_gradient, atol=1e-3)


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_errors_in_groups_are_raised(monkeypatch):
    scene = mi.load_dict({"type": "scene", "group": members(0, 1), "instance": instance("group", 1)})
    ray = mi.Ray3f([2.13, 0.21, 9], [0, 0, -1])
    expected = vector(scene.ray_intersect(ray).n)
    with monkeypatch.context() as during:
        during.setattr(interaction_hook, "tag_of", fail)
        with pytest.raises(AnswerError, match=r"^answer$"):
            scene.ray_intersect(ray)
    np.testing.assert_array_equal(vector(scene.ray_intersect(ray).n), expected)


# Lifetimes, variants and threads


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


@pytest.mark.usefixtures("variants_array_rgb")
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


@pytest.mark.usefixtures("variants_array_rgb")
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
    names = [name for name in mi.variants() if name in ("llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono")]
    shapes, found = {}, {}
    for name in names:
        mi.set_variant(name)
        shapes[name] = make()
    for name in reversed(names):
        mi.set_variant(name)
        found[name] = vector(interaction(shapes[name]).sh_frame.n)
    for normal in found.values():
        np.testing.assert_allclose(normal, found["llvm_ad_rgb"], atol=1e-6)


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_mitsubas_own_threads_ask_as_well():
    scene = scene_of(make(), "direct", size=24)
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
    monkeypatch.setattr(f"mitsuba_subdivision.shapes.mitsuba_3_9_hook.interaction_hook.{place}", value)
    with pytest.raises(RuntimeError, match=message):
        make()
    assert mi.load_dict({"type": "subdivision", **named_cages.cube().as_properties(mi)}).face_count() > 0


@pytest.mark.usefixtures("variant_llvm_ad_rgb", "_asked_again")
def test_a_shape_says_that_no_memory_can_be_executed(monkeypatch):
    def refuse(*_):
        raise OSError("refused")

    monkeypatch.setattr(interaction_hook, "_hooks", {})
    monkeypatch.setattr(machine_code, "_protect", refuse)
    with pytest.raises(RuntimeError, match="memory for machine code: refused"):
        make()


@pytest.mark.usefixtures("variants_array_rgb", "_asked_again")
def test_another_version_works_if_nothing_has_moved(monkeypatch):
    monkeypatch.setattr(interaction_hook, "_hooks", {})
    monkeypatch.setattr(mi, "__version__", "3.9.2")
    # A class's table keeps what the first hook has put there.
    monkeypatch.setattr(interaction_hook.InteractionHook, "_tag_groups", lambda _: None)
    assert interaction(make()).is_valid()


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("_virtual_functions", lambda *_: [0, 0, 0], "0 virtual functions compute_surface_interaction of the known"),
        ("_ATTRIBUTE_ARGUMENTS", "int", "0 virtual functions eval_attribute of the known arguments; expected one"),
        ("_INTERACTION_ARGUMENTS", "int", "0 virtual functions compute_surface_interaction of the known arguments"),
        ("trial_problem", lambda *_: "the sun is out", "virtual functions of Mitsuba 3.9; of those of 3.9.*, the sun"),
    ],
)
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_a_class_with_other_functions_is_rejected(monkeypatch, place, value, message):
    example = make(shading="vertex")
    monkeypatch.setattr(interaction_hook, place, value)
    with pytest.raises(RuntimeError, match=message):
        interaction_hook.InteractionHook(sys.modules["mitsuba"].llvm_ad_rgb, example)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("deaf", "compute_surface_interaction does not pass on its arguments, or its result"),
        ("hard of hearing", "compute_surface_interaction does not pass on its arguments, or its result"),
        ("mute", "compute_surface_interaction does not pass on its arguments, or its result"),
        ("forgetful", "eval_attribute does not pass on its arguments, or its result"),
        ("quiet", "an error in an answer is lost"),
    ],
)
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_the_trial_notices_what_differs(kind, message):
    make()
    hook = interaction_hook._hooks[mi.llvm_ad_rgb]

    class Answers:
        def __init__(self, trial):
            self.trial = trial

        def complete(self, si, hit):
            uv = mi.Point2f(si.uv)
            with contextlib.suppress(hook_trial.TrialError):
                self.trial.complete(si, hit._replace(flags=hit.flags + (kind == "hard of hearing")))
            if kind == "mute":
                si.uv = uv

        def attribute(self, *arguments):
            found = None
            with contextlib.suppress(hook_trial.TrialError):
                found = self.trial.attribute(*arguments)
            return None if kind == "forgetful" else found

    kept = []

    def attach(shape, trial):
        kept.append(Answers(trial))
        if kind != "deaf":
            hook.attach(shape, kept[0])

    assert hook_trial.trial_problem(mi.llvm_ad_rgb, attach) == message


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_code_longer_than_its_page_is_refused():
    make()
    with pytest.raises(OSError, match=r"^machine code of \d+ bytes; expected at most a page of \d+$"):
        machine_code._installed(bytes(mmap.PAGESIZE))


@pytest.mark.parametrize("current", ["scalar_rgb", None])
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_the_first_shape_of_a_variant_needs_it_to_be_set(current):
    """Mitsuba makes the group that is built upon in the variant that is set: it was of another class."""
    code = f"""
import mitsuba_subdivision as msub, mitsuba as mi
if {current!r}:
    mi.set_variant({current!r})
msub.register_variant("llvm_ad_rgb")
config = mi.parser.ParserConfig("llvm_ad_rgb")
shape = {{"type": "subdivision", "filename": msub.example_file("cages/rook.obj"), "shading": "exact"}}
state = mi.parser.parse_dict(config, shape)
mi.parser.transform_all(config, state)
mi.parser.instantiate(config, state)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f'made while {current or "no variant"} was set; expected mi.set_variant("llvm_ad_rgb") before' in done.stderr
