"""Scenes of many shapes: any number loads, and shapes share all that does not depend on positions."""

import gc
import os
import threading
import time
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import Attribute, CageWarning, ControlCage
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.files.formats import FORMATS
from mitsuba_subdivision.shapes import registration
from reference.refined_cages import tagged
from shapes.cages import cube, described
from shapes.updates import update
from shapes.variants import every_array_variant, every_variant, exact, exact_llvm, llvm

pytestmark = pytest.mark.threads

# Four frames of Python for each of so many shapes on two threads are more than a stack may have, were they nested.
MANY = 600
# Of what takes longer; enough that constructors go on in other threads several times.
SOME = 3 * registration.DEEPEST
BUFFERS = ("vertex_positions", "vertex_normals", "vertex_colour", "faces", "face_element")
# Vertices that were placed at once, or with others: sums in single precision, in another order.
SINGLE = 1e-6
# A file that has not changed for long, in nanoseconds before now.
LONG_AGO = 3_600 * 10**9


def coloured(cage, seed=0, **attributes):
    rng = np.random.default_rng(seed)
    texcoords = Attribute(rng.random((len(cage.face_vertices), 2)), "face_varying")
    return tagged(cage, texcoords=texcoords, attributes={"colour": rng.random((cage.vertex_count, 3)), **attributes})


def of(cage, **parameters):
    rate = {} if "tessellation" in parameters else {"tessellation_rate": 2}
    return described(cage, **rate, **parameters)


def made(cage, **parameters):
    return mi.load_dict(of(cage, **parameters))


def buffers(shape):
    parameters = mi.traverse(shape)
    return {name: np.array(parameters[name]) for name in BUFFERS if name in parameters}


def placed(shape, i):
    return {**shape, "to_world": mi.ScalarTransform4f().translate([i % 8, i // 8 % 8, i // 64])}


def load(shape, count, **options):
    scene = mi.load_dict({"type": "scene", **{f"s{i:04}": placed(shape, i) for i in range(count)}}, **options)
    return scene.shapes()


def assert_as_if_alone(shape, found, i):
    expected = buffers(mi.load_dict(placed(shape, i)))
    loaded = buffers(found[i])
    assert loaded.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_allclose(loaded[name], values, rtol=0, atol=SINGLE, err_msg=name)


@llvm
@pytest.mark.parametrize(("count", "parallel"), [(MANY, True), (SOME, False)], ids=["parallel", "one by one"])
def test_many_shapes_load(count, parallel):
    shape = of(cube())
    found = load(shape, count, parallel=parallel)
    assert len(found) == count
    for i in (0, count // 2, count - 1):
        assert_as_if_alone(shape, found, i)


@exact_llvm
def test_what_waits_within_constructors_loads():
    """All kinds inside each other."""
    kinds = [
        {"shading": "exact"},
        {"displacement": "vertex_height", "displacement_scale": 0.1},
        {"displacement": {"type": "checkerboard"}, "shading": "exact"},
        {"tessellation": "adaptive", "chord_error": 0.05},
        {"evaluator": "stam", "sample_offset": 1e-3},
    ]
    cage = coloured(cube(), height=np.linspace(0, 1, 8)[:, None])
    shapes = [of(cage, **kinds[i % len(kinds)]) for i in range(SOME)]
    scene = {"type": "scene", **{f"s{i:03}": placed(shape, i) for i, shape in enumerate(shapes)}}
    found = mi.load_dict(scene).shapes()
    assert len(found) == SOME
    for i in range(SOME - len(kinds), SOME):
        assert_as_if_alone(shapes[i], found, i)


@llvm
@pytest.mark.parametrize("parallel", [True, False], ids=["parallel", "one by one"])
def test_many_shapes_load_from_xml(parallel, tmp_path):
    cube().save(tmp_path / "cube.obj")
    shape = (
        '<shape type="subdivision"><string name="filename" value="cube.obj"/>'
        '<integer name="tessellation_rate" value="2"/><transform name="to_world"><translate x="{}"/></transform>'
        "</shape>"
    )
    text = "".join(map(shape.format, range(SOME)))
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{text}</scene>')
    assert len(mi.load_file(str(tmp_path / "scene.xml"), parallel=parallel).shapes()) == SOME


@llvm
def test_an_error_in_one_of_many_shapes_is_that_of_the_load():
    shape = of(cube())
    scene = {f"s{i:03}": placed(shape, i) for i in range(SOME)} | {"wrong": {**shape, "tessellation_rate": 0}}
    with pytest.raises(RuntimeError, match='parameter "tessellation_rate" is 0; expected 1 to'):
        mi.load_dict({"type": "scene", **scene})


def test_a_constructor_too_deep_runs_in_its_own_thread():
    threads, depths = [], []

    @registration.on_shallow_stack
    def begin(left):
        threads.append(threading.get_ident())
        depths.append(registration._stack.depth)
        if not left:
            raise KeyError("innermost")
        begin(left - 1)

    with pytest.raises(KeyError, match="innermost"):
        begin(3 * registration.DEEPEST - 1)
    assert len(set(threads)) == 3
    assert depths == 3 * list(range(1, registration.DEEPEST + 1))
    # Nothing is left on the stack.
    depths.clear()
    with pytest.raises(KeyError):
        begin(0)
    assert depths == [1]


# Sharing


def tables(shape):
    """What shapes of one topology share; that of exact shading only where it has been asked for."""
    surface = shape._parameters.surface
    found = [surface.cage.structure, surface.patches, shape._triangles.table, shape._triangles.layout]
    found += [surface.channel(name).layout for name in surface.attribute_names]
    return [*found, surface.pieces()] if shape._exact is not None else found


def device_arrays(shape):
    parameters = mi.traverse(shape)
    return [parameters[name].index for name in ("faces", "face_element")]


@exact
@every_variant
@pytest.mark.parametrize("shading", ["vertex", "exact"])
@pytest.mark.parametrize("rate", [1, 3])
def test_shapes_of_equal_topology_share_all_but_positions(shading, rate, tmp_path, np_rng):
    cage = coloured(cube())
    moved = cage.with_positions(cage.positions + np_rng.normal(size=cage.positions.shape) * 0.1)
    paths = [str(tmp_path / f"{name}.obj") for name in ("one", "other")]
    # An OBJ file has no place for colours.
    for path, each in zip(paths, (cage, moved), strict=True):
        with pytest.warns(CageWarning, match="no place for attribute"):
            each.save(path)
    options = {"shading": shading, "tessellation_rate": rate}
    from_arrays = [mi.load_dict({**of(each), **options}) for each in (cage, moved, coloured(cage, 1))]
    files = [from_file(path, **options) for path in (*paths, paths[0])]
    for first, *others in (from_arrays, files):
        for shape in others:
            assert all(a is b for a, b in zip(tables(first), tables(shape), strict=True))
            if dr.is_jit_v(mi.Float):
                assert device_arrays(shape) == device_arrays(first)
        assert not np.array_equal(buffers(first)["vertex_positions"], buffers(others[0])["vertex_positions"])
    assert files[0]._parameters.surface.patches is from_arrays[0]._parameters.surface.patches
    assert files[0]._triangles.table is from_arrays[0]._triangles.table


@every_variant
@pytest.mark.parametrize(
    "change",
    [
        {"creases": [(0, 1, 3.0)]},
        {"creases": [(0, 1, 10.0)]},
        {"corners": [(0, 2.0)]},
        {"holes": [2]},
        {"boundary": "edge_only"},
        {"triangle_rule": "smooth"},
        {"crease_method": "chaikin"},
        {"face_varying": "all"},
    ],
    ids=str,
)
def test_shapes_of_other_tags_or_rules_share_no_patches(change):
    one, two = (made(cage) for cage in (cube(), cube(**change)))
    assert one._parameters.surface.patches is not two._parameters.surface.patches
    assert one._triangles.table is not two._triangles.table


@every_variant
def test_shapes_of_another_rate_or_scheme_share_no_tessellation():
    one, two, three = (
        made(cube()),
        mi.load_dict({**of(cube()), "tessellation_rate": 3}),
        made(cube(), scheme="doo_sabin"),
    )
    assert one._parameters.surface.patches is two._parameters.surface.patches
    assert len({id(each._triangles.table) for each in (one, two, three)}) == 3
    assert one._parameters.surface.patches is not three._parameters.surface.patches


@exact
@every_array_variant
def test_nothing_is_kept_when_the_last_shape_has_gone():
    shape = of(coloured(named_cages.torus(4, 3)), shading="exact")
    one, two = mi.load_dict(shape), mi.load_dict(shape)
    seen = [weakref.ref(each) for each in tables(one)]
    del one
    gc.collect()
    assert None not in [each() for each in seen]
    del two
    gc.collect()
    assert [each() for each in seen] == [None] * len(seen)


# Files


def written(cage, path, age=LONG_AGO, more=""):
    """Write a cage to a file as if that had been so many nanoseconds ago."""
    cage.save(path)
    path.write_text(path.read_text() + more)
    then = time.time_ns() - age
    os.utime(path, ns=(then, then))
    return str(path)


def from_file(path, **more):
    return mi.load_dict({"type": "subdivision", "filename": path, "tessellation_rate": 2, **more})


def cage_of(shape):
    return shape._parameters.surface.cage


@every_variant
def test_a_file_is_read_once_until_it_changes(tmp_path, monkeypatch):
    path = written(cube(), tmp_path / "cube.obj")
    one = from_file(path)
    with monkeypatch.context() as patched:
        patched.setattr(ControlCage, "from_file", None)
        two = from_file(path)
    assert cage_of(one) is cage_of(two)
    # Of the same size.
    shifted = cube().with_positions(cube().positions[::-1])
    three = from_file(written(shifted, tmp_path / "cube.obj", LONG_AGO // 2))
    np.testing.assert_array_equal(cage_of(three).positions, shifted.positions)
    # Other options, another cage.
    assert cage_of(from_file(path, boundary="none", strict=True)).boundary == "none"


@every_variant
def test_a_file_that_has_just_changed_is_read_again(tmp_path):
    """Times of files are too coarse to tell whether it has changed once more."""
    shapes = []
    for positions in (cube().positions, cube().positions[::-1]):
        shapes.append(from_file(written(cube().with_positions(positions), tmp_path / "cube.obj", age=0)))
        np.testing.assert_array_equal(cage_of(shapes[-1]).positions, positions)
    assert cage_of(from_file(str(tmp_path / "cube.obj"))) is not cage_of(shapes[-1])


@every_variant
def test_each_shape_warns_of_its_file(tmp_path):
    path, shapes = written(cube(), tmp_path / "cube.obj", more="v 9 9 9\n"), []
    for _ in range(2):
        with pytest.warns(CageWarning, match="used by no face"):
            shapes.append(from_file(path))
    assert cage_of(shapes[0]) is cage_of(shapes[1])


def test_names_of_formats_that_refer_to_no_other_files():
    """USD files do, and these may change alone."""
    assert {suffix for suffix, each in FORMATS.items() if not each.refers_to_files} == {".obj", ".ply"}


@llvm
def test_triangles_that_are_chosen_anew_keep_derivatives():
    shape = made(cube())
    dr.enable_grad(mi.traverse(shape)["control_points"])
    shape.retessellate()
    dr.backward(dr.sum(mi.traverse(shape)["vertex_positions"]))
    assert np.array(dr.grad(shape.control_points)).any()


@llvm
def test_shapes_of_equal_attributes_share_them_on_the_device():
    cage = coloured(cube())
    one, two, other = (made(each) for each in (cage, cage.with_positions(-cage.positions), coloured(cage, 1)))
    for name in ("vertex_colour", "vertex_texcoords"):
        index = [mi.traverse(shape)[name].index for shape in (one, two, other)]
        assert index[0] == index[1] != index[2]
    # What one of them is given is its own.
    update(one, cage_colour=mi.traverse(one)["cage_colour"] * 2)
    before, after = (np.array(mi.traverse(shape)["vertex_colour"]) for shape in (two, one))
    np.testing.assert_allclose(after, 2 * before, rtol=SINGLE)
