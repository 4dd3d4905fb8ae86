import gc
import os
import threading
import time
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import Attribute, CageWarning, ControlCage, LimitSurface
from mitsuba_subdivision.files.formats import FORMATS
from mitsuba_subdivision.shapes import device_state, subdivision_shape
from mitsuba_subdivision.shapes.device_state import paused_collection
from patches.closed_cages import torus
from reference.refined_cages import tagged
from shapes.cages import RING, cube, described, load
from shapes.updates import update
from shapes.variants import every_array_variant, every_variant, exact, llvm, scalar, shadings

pytestmark = pytest.mark.threads

# Four frames of Python for each of so many shapes on two threads are more than a stack may have, were they nested.
MANY = pytest.param(600, True, [{}], marks=pytest.mark.long)
# Number of shapes whose constructors continue in several other threads.
SOME = 3 * device_state.DEEPEST
BUFFERS = ("vertex_positions", "vertex_normals", "vertex_colour", "faces", "face_element")
# Vertices that were placed at once, or with others: sums in single precision, in another order.
SINGLE = 1e-6
# A file that has not changed for long, in nanoseconds before now.
LONG_AGO = 3_600 * 10**9


def coloured(cage, seed=0, **attributes):
    rng = np.random.default_rng(seed)
    texcoords = Attribute(rng.random((len(cage.face_vertices), 2)), "face_varying")
    return tagged(cage, texcoords=texcoords, attributes={"colour": rng.random((cage.vertex_count, 3)), **attributes})


def buffers(shape):
    parameters = mi.traverse(shape)
    return {name: np.array(parameters[name]) for name in BUFFERS if name in parameters}


def placed(shape, i):
    return {**shape, "to_world": mi.ScalarTransform4f().translate([i % 8, i // 8 % 8, i // 64])}


def loaded_together(shapes, **options):
    named = {f"s{i:04}": placed(shape, i) for i, shape in enumerate(shapes)}
    return mi.load_dict({"type": "scene", **named}, **options).shapes()


@exact
@llvm
def test_loaded_shapes_keep_no_tables_of_their_patches():
    surface = LimitSurface(coloured(cube()))
    shape = load(surface.cage, shading="exact")
    for patches in (surface.patches, surface.channel("texcoords").layout.patches):
        assert not {"classes", "rings", "refined"} & set(vars(patches))
    assert shape.is_mesh()


WAITING = [
    {"shading": "exact"},
    {"displacement": "vertex_height", "displacement_scale": 0.1},
    {"displacement": {"type": "checkerboard"}, "shading": "exact"},
    {"tessellation": "adaptive", "chord_error": 0.05},
    {"evaluator": "stam", "sample_offset": 1e-3},
]


@llvm
@pytest.mark.parametrize(
    ("count", "parallel", "kinds"),
    [MANY, (SOME, False, [{}]), pytest.param(SOME, True, WAITING, marks=exact)],
    ids=["parallel", "one by one", "what waits within constructors"],
)
def test_many_shapes_load(count, parallel, kinds):
    cage = coloured(cube(), height=np.linspace(0, 1, 8)[:, None]) if len(kinds) > 1 else cube()
    shapes = [described(cage, **kinds[i % len(kinds)]) for i in range(count)]
    loaded = loaded_together(shapes, parallel=parallel)
    assert len(loaded) == count
    for i in (0, count // 2, *range(count - len(kinds), count)):
        expected, buffers_ = buffers(mi.load_dict(placed(shapes[i], i))), buffers(loaded[i])
        assert buffers_.keys() == expected.keys()
        for name, values in expected.items():
            np.testing.assert_allclose(buffers_[name], values, rtol=0, atol=SINGLE, err_msg=name)


@llvm
def test_an_error_of_one_shape_is_raised_by_the_load():
    with pytest.raises(RuntimeError, match='parameter "tessellation_rate" is 0; expected 1 to'):
        loaded_together([*[described(cube())] * SOME, {**described(cube()), "tessellation_rate": 0}])


def test_a_constructor_too_deep_runs_in_its_own_thread():
    threads, depths = [], []

    @device_state.on_shallow_stack
    def begin(left):
        threads.append(threading.get_ident())
        depths.append(device_state._stack.depth)
        if not left:
            raise KeyError("innermost")
        begin(left - 1)

    with pytest.raises(KeyError, match="innermost"):
        begin(3 * device_state.DEEPEST - 1)
    assert len(set(threads)) == 3
    assert depths == 3 * list(range(1, device_state.DEEPEST + 1))
    # Nothing is left on the stack.
    depths.clear()
    with pytest.raises(KeyError):
        begin(0)
    assert depths == [1]


@scalar
def test_the_collector_pauses_while_a_shape_is_made(monkeypatch):
    read_parameters, enabled = subdivision_shape.read_parameters, []

    def noted(props):
        enabled.append(gc.isenabled())
        return read_parameters(props)

    monkeypatch.setattr(subdivision_shape, "read_parameters", noted)
    load(cube())
    assert gc.isenabled()
    # Also after a shape that is refused, and where it was off.
    with pytest.raises(RuntimeError, match="filename"):
        mi.load_dict({"type": "subdivision"})
    assert gc.isenabled()
    gc.disable()
    try:
        load(cube())
        assert not gc.isenabled()
    finally:
        gc.enable()
    assert enabled == [False] * 3


def test_the_collector_runs_again_after_pauses_that_overlap():
    begun, ended = threading.Event(), threading.Event()

    @paused_collection()
    def longer():
        begun.set()
        ended.wait()

    thread = threading.Thread(target=longer)
    with paused_collection():
        thread.start()
        begun.wait()
    # The first pause is over, and the other, which began within it, leaves the collector as it is.
    ended.set()
    thread.join()
    assert gc.isenabled()


def tables(shape):
    """What shapes of one topology share; that of exact shading only where it has been asked for."""
    surface = shape._parameters.surface
    shared = [surface.cage.structure, surface.patches, shape._mesh.table, shape._mesh.layout]
    shared += [surface.channel(name).layout for name in surface.attribute_names]
    return [*shared, surface.pieces()] if shape._exact is not None else shared


@every_variant
@shadings
def test_shapes_of_equal_topology_share_all_but_positions(shading, tmp_path, np_rng):
    cage = coloured(cube())
    moved = cage.with_positions(cage.positions + np_rng.normal(size=cage.positions.shape) * 0.1)
    paths = [str(tmp_path / f"{name}.obj") for name in ("one", "other")]
    # An OBJ file has no place for colours.
    for path, given in zip(paths, (cage, moved), strict=True):
        with pytest.warns(CageWarning, match="no place for attribute"):
            given.save(path)
    options = {"shading": shading, "tessellation_rate": 3}
    from_arrays = [mi.load_dict({**described(given), **options}) for given in (cage, moved, coloured(cage, 1))]
    files = [from_file(path, **options) for path in (*paths, paths[0])]
    for first, *others in (from_arrays, files):
        for shape in others:
            assert all(a is b for a, b in zip(tables(first), tables(shape), strict=True))
            for name in ("faces", "face_element") if dr.is_jit_v(mi.Float) else ():
                assert mi.traverse(shape)[name].index == mi.traverse(first)[name].index
        assert not np.array_equal(buffers(first)["vertex_positions"], buffers(others[0])["vertex_positions"])
    assert files[0]._parameters.surface.patches is from_arrays[0]._parameters.surface.patches
    assert files[0]._mesh.table is from_arrays[0]._mesh.table


OTHER_TAGS = [{"creases": [(0, 1, 3.0)]}, {"creases": [(0, 1, 10.0)]}, {"corners": [(0, 2.0)]}, {"holes": [2]}]
OTHER_TAGS += [{"boundary": "edge_only"}, {"triangle_rule": "smooth"}, {"crease_method": "chaikin"}]
OTHER_TAGS += [{"face_varying": "all"}]


@scalar
@pytest.mark.parametrize("tags", OTHER_TAGS, ids=str)
def test_only_shapes_of_equal_topology_share_patches(tags):
    one, of_rate = load(cube()), load(cube(), tessellation_rate=3)
    for two in (load(cube(**tags)), load(cube(), scheme="doo_sabin"), of_rate):
        assert one._mesh.table is not two._mesh.table
        assert (one._parameters.surface.patches is two._parameters.surface.patches) == (two is of_rate)


@every_variant
@shadings
def test_shapes_of_equal_cages_share_arrays_until_an_update(shading):
    points, is_jit = cube().positions, dr.is_jit_v(mi.Float)
    cage = cube(creases=RING, texcoords=points[:, :2], attributes={"colour": points})
    given = cage, cage, cage.with_positions(-cage.positions)
    one, two, moved = (mi.traverse(load(cage, shading=shading)) for cage in given)
    # Normals, or what they come from.
    placed = ("vertex_positions", "shading_coefficients" if shading == "exact" else "vertex_normals")
    values = ("vertex_colour", "cage_colour", "cage_texcoords")
    for name in (*placed, *values) if is_jit else ():
        assert one[name].index == two[name].index
        assert (moved[name].index == two[name].index) == (name in values)
    before = {name: np.array(two[name]) for name in (*placed, *values)}
    # What one of them is given is its own, also in place.
    to_world = mi.ScalarTransform4f().scale(3)
    update(one, control_points=one["control_points"] * 2, cage_colour=one["cage_colour"] * 2, to_world=to_world)
    dr.scatter(one["cage_texcoords"], 7.0, dr.uint32_array_t(type(one["cage_texcoords"]))(0))
    one.update()
    assert np.array(one["cage_texcoords"])[0] == 7
    for name, factor in (("vertex_positions", 6), ("vertex_colour", 2)):
        np.testing.assert_allclose(np.array(one[name]), factor * before[name], atol=10 * SINGLE)
    if is_jit:
        dr.scatter(two["vertex_positions"], 7.0, dr.uint32_array_t(type(two["vertex_positions"]))(0))
    anew = mi.traverse(load(cage, shading=shading))
    for name, expected in before.items():
        np.testing.assert_array_equal(np.array(anew[name]), expected)
        if name != "vertex_positions":
            np.testing.assert_array_equal(np.array(two[name]), expected)


@exact
@every_array_variant
def test_nothing_is_kept_when_the_last_shape_has_gone():
    shape = described(coloured(torus(4, 3)), shading="exact")
    one, two = mi.load_dict(shape), mi.load_dict(shape)
    seen = [weakref.ref(reference) for reference in tables(one)]
    del one
    gc.collect()
    assert None not in [reference() for reference in seen]
    del two
    gc.collect()
    assert [reference() for reference in seen] == [None] * len(seen)


def written(cage, path, age=LONG_AGO, more=""):
    """Write a cage to a file as if that had been so many nanoseconds ago; the file is the same as before."""
    cage.save(path.with_name("saved.obj"))
    path.write_text(path.with_name("saved.obj").read_text() + more)
    then = time.time_ns() - age
    os.utime(path, ns=(then, then))


def from_file(path, **more):
    return mi.load_dict({"type": "subdivision", "filename": path, "tessellation_rate": 4, **more})


@every_variant
def test_a_file_is_read_once_until_it_changes_and_each_shape_warns(tmp_path, monkeypatch):
    path, unused = tmp_path / "cube.obj", "v 9 9 9\n"

    def warned(**options):
        with pytest.warns(CageWarning, match="used by no face"):
            return from_file(str(path), **options)._parameters.surface.cage

    written(cube(), path, more=unused)
    cages = [warned()]
    with monkeypatch.context() as patched:
        patched.setattr(ControlCage, "from_file", None)
        assert warned() is cages[0]
    assert warned(boundary="none", strict=True).boundary == "none"
    # Of the same size; and then at once again, as times of files are too coarse to tell whether it has changed since.
    for turn, age in ((-1, LONG_AGO // 2), (1, 0), (-1, 0)):
        positions = cube().positions[::turn]
        written(cube().with_positions(positions), path, age, unused)
        cages.append(warned())
        np.testing.assert_array_equal(cages[-1].positions[:8], positions)


def test_only_usd_files_refer_to_other_files():
    assert {suffix for suffix, file_format in FORMATS.items() if not file_format.refers_to_files} == {".obj", ".ply"}


@llvm
def test_retessellation_keeps_derivatives():
    shape = load(cube())
    dr.enable_grad(mi.traverse(shape)["control_points"])
    shape.retessellate()
    dr.backward(dr.sum(mi.traverse(shape)["vertex_positions"]))
    assert np.array(dr.grad(shape.control_points)).any()
