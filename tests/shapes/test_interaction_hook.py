import contextlib
import gc
import itertools
import mmap
import re
import traceback
import weakref
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import upload
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.shapes import exact_shading, interaction_hook, machine_code
from reference.refined_cages import sheet
from shapes.cages import described, load
from shapes.scenes import down, hit, perspective, rows, scene_with
from shapes.updates import differentiated
from shapes.variants import every_array_variant, llvm, printed

pytestmark = pytest.mark.threads

if interaction_hook.hook_problem():
    pytest.skip(str(interaction_hook.hook_problem()), allow_module_level=True)

# The cube's top, away from the triangles' corners.
TOP = (0.13, 0.21, 4)


def cube(**parameters):
    return described(named_cages.cube(), **{"tessellation_rate": 2, "shading": "exact", **parameters})


def make(**parameters):
    return mi.load_dict(cube(**parameters))


class AnswerError(OSError):
    """Of these tests."""


def fail(*_):
    raise AnswerError("answer")


def interrupt(*_):
    raise KeyboardInterrupt("answer")


@contextlib.contextmanager
def raises_answer(kind=AnswerError):
    """As it is, or as the cause of Dr.Jit's own error."""
    with pytest.raises((kind, RuntimeError)) as caught:
        yield
    error = caught.value
    while type(error) is RuntimeError:
        error = error.__cause__
    assert type(error) is kind
    assert str(error) == "answer"


def complete_by(monkeypatch, function):
    monkeypatch.setattr(exact_shading.ExactShading, "complete", function)


def scene_of(shape, integrator="path"):
    sensor = perspective(16, [1, 2, 3])
    return scene_with(integrator={"type": integrator}, sky={"type": "constant"}, sensor=sensor, shape=shape)


BEGIN = """
import mitsuba_subdivision as msub, mitsuba as mi, drjit as dr
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.shapes import exact_shading
mi.set_variant('llvm_ad_rgb')
def shape(shading):
    cage = named_cages.cube().as_properties(mi)
    return {'type': 'subdivision', **cage, 'tessellation_rate': 2, 'shading': shading}
"""


@every_array_variant
def test_an_error_is_raised_once_by_its_cause(monkeypatch, capfd):
    shape = make(vertex_heat=upload(mi.TensorXf, np.arange(8.0)[:, None]))
    scene, si = scene_of(shape), hit(shape, *TOP)
    instances = scene_with(group=members(0, 1), instance=instance("group", 1))
    exact = exact_shading.ExactShading
    for owner, name, ask in (
        (exact, "complete", lambda: hit(shape, *TOP).n),
        (exact, "complete", lambda: mi.render(scene, spp=1, seed=3)),
        (exact, "attribute", lambda: shape.eval_attribute("vertex_heat", si)),
        (exact, "attribute", lambda: shape.eval_attribute_1("vertex_heat", si)),
        (interaction_hook, "tag_of", lambda: instances.ray_intersect(down(2.13, 0.21, 9)).n),
    ):
        expected = np.array(ask())
        assert np.isfinite(expected).all()
        with monkeypatch.context() as during:
            for answer, error in ((fail, AnswerError), (fail, AnswerError), (interrupt, KeyboardInterrupt)):
                during.setattr(owner, name, answer)
                with raises_answer(error):
                    ask()
        np.testing.assert_array_equal(np.array(ask()), expected)
    assert capfd.readouterr().err == ""


@llvm
def test_errors_pass_through_loops_and_derivatives(monkeypatch):
    scene = scene_of(make(), "prb")
    parameters = mi.traverse(scene)
    differentiated(parameters, "shape.control_points")
    picture = mi.render(scene, parameters, spp=1)
    complete_by(monkeypatch, fail)
    with raises_answer():
        dr.backward(dr.mean(picture))
    with raises_answer():
        mi.render(scene, parameters, spp=1)
    # Inside a loop of the answer, too.
    complete_by(monkeypatch, lambda _, si, *__: dr.while_loop((mi.UInt32(si.prim_index),), lambda i: i < 3, fail))
    with raises_answer():
        hit(make(), *TOP)


@every_array_variant
def test_errors_keep_no_objects_of_c_and_go_with_their_last_name(monkeypatch):
    """And with them, what their frames hold; not when the collector comes by."""
    scene, alive = scene_of(make()), []

    def complete(_, si, *others):
        del others
        error = AnswerError(type(si).__name__)
        alive.append(weakref.ref(error))
        raise error

    complete_by(monkeypatch, complete)
    with pytest.raises(AnswerError) as caught:
        hit(make(), *TOP)
    frames = {frame.f_code.co_name: frame for frame, _ in traceback.walk_tb(caught.value.__traceback__)}
    assert all(not dict(frames[name].f_locals) for name in ("complete", "_complete"))
    del caught, frames
    gc.disable()
    try:
        with contextlib.suppress(AnswerError, RuntimeError):
            mi.render(scene, spp=1)
        assert {reference() for reference in alive} == {None}
    finally:
        gc.enable()


@llvm
def test_shapes_made_in_parallel_share_a_hook_and_errors_leave_no_variables():
    """Mitsuba makes the shapes of a scene in parallel; the table of one hook must not be given up for another's."""
    code = """
import contextlib
scene = mi.load_dict({'type': 'scene', **{f's{i}': shape('exact') for i in range(12)}})
def ask():
    with contextlib.suppress(ValueError):
        print(scene.ray_intersect(mi.Ray3f(mi.Point3f(dr.arange(mi.Float, 2), 0.1, 4), [0, 0, -1])).is_valid())
    return dr.whos(as_string=True).count('\\n')
def fail(self, si, *_):
    si.uv = mi.Point2f(3 * si.p.x, si.p.y)
    raise ValueError
ask()
exact_shading.ExactShading.complete = fail
print(len({ask() for _ in range(3)}))
"""
    assert printed(BEGIN + code) == "[True, False]\n1\n"


@llvm
def test_mitsuba_errors_are_the_same_in_both_shadings():
    """An exception of C++ passes by Python: flags, sizes and indices that do not fit are errors, and no crash."""
    rays, top = down([0.13, 0, 0.1], 0.21, 4), down(*TOP)
    flags = mi.RayFlags.DetachShape | mi.RayFlags.FollowShape

    def errors(shading):
        shape = make(shading=shading)
        scene = scene_with(shape=shape)
        preliminary, outside = (scene.ray_intersect_preliminary(ray) for ray in (rays, top))
        outside.prim_index = mi.UInt32(100000)
        for ask in (
            lambda: shape.compute_surface_interaction(rays, preliminary, flags),
            lambda: shape.compute_surface_interaction(rays, preliminary, active=mi.Mask([True, False])),
            lambda: shape.compute_surface_interaction(top, outside),
            lambda: shape.eval_attribute_1("face_element", scene.ray_intersect(rays), mi.Mask([True, False])),
        ):
            with pytest.raises(RuntimeError) as caught:
                ask()
            yield re.sub("r[0-9]+", "", str(caught.value))

    assert list(errors("exact")) == list(errors("vertex"))


INTERRUPTED = """
import os, signal, threading, time
# What runs in the background of a shell ignores interruptions otherwise.
signal.signal(signal.SIGINT, signal.default_int_handler)
def chain(error):
    return [] if error is None else [type(error).__name__, *chain(error.__cause__)]
def interrupt():
    global sent
    sent = time.monotonic()
    os.kill(os.getpid(), signal.SIGINT)
mi.set_log_level(mi.LogLevel.Error)
sensor = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
sensor["to_world"] = mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 0], [0, 0, 1])
for shading in ("vertex", "exact"):
    shapes = {f"shape{i}": shape(shading) for i in range(15)}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": sensor, **shapes})
    mi.render(scene, spp=1)
    for turn in range(2):
        threading.Timer(0.1 + 0.05 * turn, interrupt).start()
        try:
            while True:
                mi.render(scene, spp=1)
        except BaseException as error:
            took, kinds = time.monotonic() - sent, chain(error)
        assert kinds[-1] == "KeyboardInterrupt" and took < 1, (shading, turn, kinds, took)
        # It does not come again.
        time.sleep(0.05)
        print(shading, *kinds)
"""


# Many renders, which take most of their time in answers.
@llvm
def test_an_interruption_is_raised_after_mitsuba_returns():
    assert [turn.split()[0] for turn in printed(BEGIN + INTERRUPTED).splitlines()] == ["vertex"] * 2 + ["exact"] * 2


@pytest.fixture
def asked(monkeypatch, no_other_scene):  # noqa: ARG001
    """Shapes that are asked for interactions, one after the other. Shapes of earlier scenes would be asked as well."""
    shadings, complete = [], exact_shading.ExactShading.complete

    def note(shading, *arguments):
        shadings.append(shading)
        complete(shading, *arguments)

    complete_by(monkeypatch, note)
    return shadings


def placement(place):
    return mi.ScalarTransform4f().translate([2 * place, 0, 0]).rotate([0, 0, 1], 10 * place).scale([1, 0.9, 1.1])


def instance(group, place):
    return {"type": "instance", "to_world": placement(place), "group": {"type": "ref", "id": group}}


def shapes_of(number, count, within=None):
    place = (within or mi.ScalarTransform4f()).translate
    shapes = {f"m{number}_{k}": cube(to_world=place([0, 0, 2 * k]).scale(1 + 0.1 * number)) for k in range(count)}
    shapes[f"flat{number}"] = {"type": "rectangle", "to_world": place([0, 0, -2]).scale(0.5)}
    return {**shapes, f"vertex{number}": cube(shading="vertex", face_normals=True, to_world=place([0, 0, -4]))}


def members(number, count):
    return {"type": "shapegroup", **shapes_of(number, count)}


@llvm
def test_instances_evaluate_only_shapes_of_their_group(asked):
    """Those in groups answer twice, for themselves and their group, and once in each instance; others once."""
    counts = [(1, 1, 1, 4), (1, 1, 3, 4), (1, 2, 3, 1), (2, 1, 1, 0), (2, 2, 3, 0), (3, 2, 2, 1)]
    for groups, count, instances, outside in counts:
        scene = {f"group{g}": members(g, count) for g in range(groups)} | {f"o{i}": cube() for i in range(outside)}
        scene |= {f"of{g}_{i}": instance(f"group{g}", g + i) for g in range(groups) for i in range(instances)}
        asked.clear()
        scene_with(**scene).ray_intersect(down(*TOP))
        assert len(asked) == groups * count * (2 + instances) + outside


@llvm
@pytest.mark.long
def test_instances_of_groups_side_by_side_are_as_placed_shapes():
    """Points, normals and their derivatives, of exact and of other shapes; in a frozen function, too."""
    x = np.linspace(-0.7, 0.7, 60, dtype=np.float32)
    origins = np.stack([6 + x, 0.3 * x, np.tile([5, -1, -3], len(x) // 3)], axis=1)
    ray = mi.Ray3f(upload(mi.Point3f, origins), mi.Vector3f(0.1, 0, -1))

    def met_in(scene, key):
        parameters = mi.traverse(scene)
        differentiated(parameters, key)
        si = scene.ray_intersect(ray)
        dr.backward(dr.sum(dr.select(si.is_valid(), dr.dot(si.p + si.sh_frame.n, mi.Vector3f(1, 2, 3)), 0)))
        values, gradient = (*si.p, *si.sh_frame.n, *si.dp_du, *si.uv, si.is_valid()), dr.grad(parameters[key])
        # In one kernel.
        dr.eval(values, gradient)
        return np.array([np.array(value) for value in values]), np.array(gradient)

    both = scene_with(group0=members(0, 1), group1=members(1, 1), of0=instance("group0", 0), of1=instance("group1", 3))
    normals = np.array(dr.freeze(lambda scene, ray: scene.ray_intersect(ray).sh_frame.n)(both, ray))
    values, gradient = met_in(both, "group1.m1_0.control_points")
    expected, expected_gradient = met_in(scene_with(**shapes_of(1, 1, placement(3))), "m1_0.control_points")
    assert expected[-1].mean() > 0.5
    assert np.abs(expected_gradient).max() > 0.1
    # Points of instances are rounded in the space of their group as well.
    np.testing.assert_allclose(values, expected, atol=1e-4)
    np.testing.assert_allclose(values[3:6], normals, atol=1e-6)
    np.testing.assert_allclose(gradient, expected_gradient, atol=1e-3)


@every_array_variant
def test_shapes_come_and_go():
    # Addresses are used again, so that answers kept for too long would be those of another cage.
    expected = rows(hit(make(), *TOP).sh_frame.n)
    for turn in range(120):
        shape = make(flip_normals=turn % 2 == 1)
        if turn % 40 < 2:
            sign = -1 if turn % 2 else 1
            np.testing.assert_allclose(rows(hit(shape, *TOP).sh_frame.n), sign * expected, atol=1e-6)
    plain = mi.load_dict({"type": "sphere"})
    assert rows(hit(plain, *TOP).p)[0, 2] == pytest.approx(np.sqrt(1 - 0.13**2 - 0.21**2), abs=1e-5)


@every_array_variant
def test_shapes_live_as_long_as_their_scenes():
    shapes = [make(), make()]
    scene, top = scene_with(a=shapes[0], b=shapes[1]), down(*TOP)
    before = rows(scene.ray_intersect(top).sh_frame.n)
    assert np.linalg.norm(before - [0, 0, 1]) > 0.05
    alive = [weakref.ref(reference) for shape in shapes for reference in (shape, shape._exact)]
    del shapes
    gc.collect()
    assert None not in [reference() for reference in alive]
    np.testing.assert_array_equal(rows(scene.ray_intersect(top).sh_frame.n), before)
    del scene
    gc.collect()
    assert [reference() for reference in alive] == [None] * 4


@llvm
def test_no_collection_comes_between_the_hits_of_a_kernel(monkeypatch):
    """It could free another scene, after which Dr.Jit defines functions of the kernel twice, and ends the process."""
    events, complete, given = [], exact_shading.ExactShading.complete, gc.get_threshold()

    def note(kind):
        events.append((dr.detail.launch_stats()[0], kind))

    def noted(*arguments):
        complete(*arguments)
        note("h")

    def step(threshold=None):
        """Hits and collections of each kernel, as letters."""
        scene = scene_of(cube(), "prb")
        parameters = mi.traverse(scene)
        differentiated(parameters, "shape.control_points")
        events.clear()
        if threshold is not None:
            gc.set_threshold(gc.get_count()[0] + threshold)
            gc.enable()
        dr.backward(dr.mean(mi.render(scene, parameters, spp=1), axis=None))
        gc.disable()
        kernels = itertools.groupby(events, key=lambda event: event[0])
        return ["".join(kind for _, kind in kernel) for _, kernel in kernels]

    complete_by(monkeypatch, noted)
    gc.callbacks.append(follow := lambda phase, _: note("c") if phase == "start" else None)
    try:
        gc.disable()
        gc.collect()
        step()
        kernels = [kernel for threshold in range(0, 400, 50) for kernel in step(threshold)]
        assert [kernel for kernel in kernels if not re.fullmatch("c*h*c*", kernel)] == []
        assert "hh" in "".join(kernels)
        assert "c" in "".join(kernels)
        gc.set_threshold(*given)
        step()
        gc.collect()
        # The user's threshold is back, and stays where it is set meanwhile.
        assert gc.get_threshold() == given
    finally:
        gc.callbacks.remove(follow)
        gc.set_threshold(*given)
        gc.enable()


@llvm
def test_inactive_lanes_may_have_any_triangle():
    shape, ray = make(), down([0.13, 0.21], [0.21, 9], 4)
    scene = scene_with(shape=shape)
    preliminary = scene.ray_intersect_preliminary(ray)
    is_hit = preliminary.is_valid()
    assert np.array(is_hit).tolist() == [True, False]
    preliminary.prim_index = dr.select(is_hit, preliminary.prim_index, 0xFFFFFFF0)
    si = shape.compute_surface_interaction(ray, preliminary, mi.RayFlags.All, is_hit)
    np.testing.assert_array_equal(rows(si.n)[0], rows(scene.ray_intersect(ray).n)[0])


@every_array_variant
def test_the_log_counts_all_hits(monkeypatch):
    """With the level Debug, by where they were found; the shape logs those before the latest."""
    shape = load(sheet(1, 1, boundary="edge_and_corner"), tessellation_rate=1, shading="exact")
    scene, count, logged = scene_with(shape=shape), 5, []
    monkeypatch.setattr(mi, "Log", lambda _level, text: logged.append(text))
    monkeypatch.setattr(mi, "log_level", lambda: mi.LogLevel.Debug)
    for _ in range(2):
        dr.eval(scene.ray_intersect(down([0.3] * count, 0.6, 3)).n)
    (text,) = logged
    assert f"of {count} hits, 100.00% are on the ray, 0.00% are along" in text


@pytest.fixture
def no_hooks(monkeypatch):
    """As before the first shape, asking again whether one can be hooked."""
    monkeypatch.setattr(interaction_hook, "_hooks", {})
    cached = (interaction_hook.hook_problem, machine_code.bindings)
    for function in cached:
        function.cache_clear()
    yield
    for function in cached:
        function.cache_clear()


ELSEWHERE = "CPython on Linux on x86-64, until Mitsuba 3.10; this is "
BY_NAMES = "needs the functions of Mitsuba's bindings by their names: .*no_such_function"


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("interaction_hook.sys.platform", "darwin", ELSEWHERE),
        ("interaction_hook.platform.machine", lambda: "aarch64", ELSEWHERE),
        ("machine_code._POINTER_OF", "no_such_function", BY_NAMES),
        ("machine_code._protect", fail, "memory for machine code: answer"),
    ],
)
@pytest.mark.usefixtures("variant_llvm_ad_rgb", "no_hooks")
def test_errors_state_why_a_shape_cannot_be_hooked(monkeypatch, place, value, message):
    monkeypatch.setattr(f"mitsuba_subdivision.shapes.{place}", value)
    with pytest.raises(RuntimeError, match=message):
        make()
    assert load(named_cages.cube()).face_count() > 0


@pytest.mark.parametrize("version", [mi.__version__, "3.9.2"])
@pytest.mark.parametrize("has_value_numbering", [True, False])
@pytest.mark.usefixtures("variants_array_rgb", "no_hooks")
def test_shapes_load_in_another_version_and_without_value_numbering(monkeypatch, version, has_value_numbering):
    monkeypatch.setattr(mi, "__version__", version)
    # A class's table keeps what the first hook has put there.
    monkeypatch.setattr(interaction_hook.InteractionHook, "_tag_groups", lambda _: None)
    with dr.scoped_set_flag(dr.JitFlag.ValueNumbering, has_value_numbering):
        assert hit(make(), *TOP).is_valid()


def triangle_with(name, changed):
    """Triangles of the trial with another override, which a function makes of the right one."""
    make = interaction_hook._triangle

    def made(variant):
        triangle = make(variant)
        setattr(type(triangle), name, changed(getattr(type(triangle), name)))
        return triangle

    return made


def hard_of_hearing(complete):
    return lambda triangle, si, *hit: complete(triangle, si, *hit[:2], hit[2] + 1, *hit[3:])


def mute(complete):
    return lambda triangle, _, *hit: complete(triangle, SimpleNamespace(), *hit)


def silent(_):
    return lambda *_: None


UNHEARD = "virtual functions of Mitsuba 3.9; of those of 3.9.*, {} does not pass on its arguments, or its result"
UNKNOWN = "0 virtual functions {} of the known arguments; expected one"


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("virtual_functions", lambda *_: [0, 0, 0], UNKNOWN.format("compute_surface_interaction")),
        ("_ATTRIBUTE_ARGUMENTS", "int", UNKNOWN.format("eval_attribute")),
        ("_OUTLINE_ARGUMENTS", "int", UNKNOWN.format("sample_silhouette")),
        ("_triangle", triangle_with("turn_outline", silent), UNHEARD.format("sample_silhouette")),
        ("_INTERACTION_ARGUMENTS", "int", UNKNOWN.format("compute_surface_interaction")),
        ("InteractionHook.attach", lambda *_: None, UNHEARD.format("compute_surface_interaction")),
        ("_triangle", triangle_with("complete", hard_of_hearing), UNHEARD.format("compute_surface_interaction")),
        ("_triangle", triangle_with("complete", mute), UNHEARD.format("compute_surface_interaction")),
        ("_triangle", triangle_with("attribute", silent), UNHEARD.format("eval_attribute")),
    ],
)
@llvm
def test_classes_with_other_functions_are_rejected(monkeypatch, place, value, message):
    monkeypatch.setattr(f"mitsuba_subdivision.shapes.interaction_hook.{place}", value)
    with pytest.raises(RuntimeError, match=message):
        interaction_hook.InteractionHook(mi.llvm_ad_rgb)


@llvm
def test_the_trial_leaves_nothing_for_scenes_to_call(monkeypatch):
    """Symbolic calls are traced for all shapes that exist, also before garbage is collected."""
    make()
    monkeypatch.setattr(interaction_hook.InteractionHook, "_tag_groups", lambda _: None)
    triangle, left = interaction_hook._triangle, []

    def kept_weakly(variant):
        shape = triangle(variant)
        left.append(weakref.ref(shape))
        return shape

    monkeypatch.setattr(interaction_hook, "_triangle", kept_weakly)
    gc.disable()
    try:
        assert not interaction_hook.InteractionHook(mi.llvm_ad_rgb)._answers
        assert [shape() for shape in left] == [None]
    finally:
        gc.enable()


@llvm
def test_code_longer_than_its_page_is_refused():
    make()
    with pytest.raises(OSError, match=r"^machine code of \d+ bytes; expected at most a page of \d+$"):
        machine_code._installed(bytes(mmap.PAGESIZE))


@llvm
def test_the_first_shape_of_a_variant_needs_it_to_be_set():
    """Mitsuba makes the group that is built upon in the variant that is set: it was of another class."""
    text = printed("""
import mitsuba as mi, mitsuba_subdivision as msub
msub.register_variant("llvm_ad_rgb")
config = mi.parser.ParserConfig("llvm_ad_rgb")
cage = {"type": "subdivision", "filename": msub.example_file("cages/rook.obj"), "shading": "exact"}
state = mi.parser.parse_dict(config, cage)
mi.parser.transform_all(config, state)
for current in (None, "scalar_rgb"):
    if current:
        mi.set_variant(current)
    try:
        mi.parser.instantiate(config, state)
    except RuntimeError as error:
        print(error)
""")
    for current in ("no variant", "scalar_rgb"):
        assert f'made while {current} was set; expected mi.set_variant("llvm_ad_rgb") before' in text
