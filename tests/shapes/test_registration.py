from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.llvm import llvm_problem, require_llvm
from mitsuba_subdivision.shapes import interaction_hook, register_variant
from mitsuba_subdivision.shapes.interaction_hook import exact_shading_problem, hook_problem
from shapes.cages import cube, described, load
from shapes.scenes import down, scene_with, vertices
from shapes.updates import update
from shapes.variants import every_variant, exact_llvm, llvm, printed, scalar

STAR = Path(__file__).parents[2] / "scenes/cages/star.obj"
# In a process of its own: other tests use the variant where Mitsuba looks types up.
BEGIN = """
def cube():
    from mitsuba_subdivision.cage import named_cages
    return {"type": "subdivision", **named_cages.cube().as_properties(mi)}
def faces():
    return [shape.face_count() for shape in mi.load_dict({"type": "scene", "s": cube()}).shapes()]
"""
ORDERS = {
    "import last": "import mitsuba as mi; mi.set_variant('scalar_rgb'); import mitsuba_subdivision",
    "import between": "import mitsuba as mi; import mitsuba_subdivision; mi.set_variant('scalar_rgb')",
    "import first": "import mitsuba_subdivision; import mitsuba as mi; mi.set_variant('scalar_rgb')",
}
needs_llvm = pytest.mark.skipif(llvm_problem() is not None, reason="no usable LLVM")


@pytest.mark.parametrize("order", ORDERS)
def test_the_shape_is_there_in_any_order_of_imports_and_variants(order):
    llvm = [] if llvm_problem() else ["llvm_ad_rgb", "scalar_rgb", "llvm_ad_spectral"]
    again = "mitsuba_subdivision.register()\nassert faces() == [768], faces()\n"
    for variant in (*llvm, "scalar_spectral", "scalar_rgb") if order == "import between" else ():
        again += f"mi.set_variant('{variant}'); assert faces() == [768], '{variant}'\n"
    printed(f"{BEGIN}{ORDERS[order]}\nassert faces() == [768], faces()\n{again}")


def test_every_variant(variants_all):
    shape = load(cube(), tessellation_rate=2)
    assert shape.face_count() == 6 * 2 * 4
    assert isinstance(shape, register_variant(variants_all))


@every_variant
def test_a_missing_llvm_affects_only_llvm_variants(monkeypatch):
    monkeypatch.setattr("mitsuba_subdivision.llvm.llvm_problem", lambda: "no LLVM here")
    require_llvm.cache_clear()
    if mi.variant().startswith("llvm"):
        with pytest.raises(RuntimeError, match="no LLVM here"):
            load(cube(), tessellation_rate=1)
    else:
        assert load(cube(), tessellation_rate=1).face_count() == 12


@needs_llvm
def test_aborting_libraries_warn_only_where_an_llvm_variant_is_set(monkeypatch):
    mi.set_variant("scalar_rgb")
    monkeypatch.setattr("mitsuba_subdivision.llvm.llvm_problem", lambda: "this LLVM aborts")
    with pytest.warns(RuntimeWarning, match="this LLVM aborts"):
        mi.set_variant("llvm_ad_rgb")
    # A warning would be an error.
    mi.set_variant("scalar_rgb")


@scalar
def test_known_variants_are_registered_once_from_many_threads():
    before = register_variant("scalar_rgb")
    msub.register()
    assert register_variant("scalar_rgb") is before
    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(register_variant, ["scalar_spectral"] * 8))) == 1
    with pytest.raises(ValueError, match=r'unknown variant "scalar_grb"; expected one of .*scalar_rgb'):
        register_variant("scalar_grb")


@every_variant
def test_equal_shapes_of_a_scene_stay_two_and_can_be_written_as_xml():
    shape = described(cube(), tessellation_rate=3, bsdf={"type": "ref", "id": "m"})
    aside = {"to_world": mi.ScalarTransform4f().translate([4, 0, 0])}
    scene = scene_with(m={"type": "diffuse", "id": "m"}, a=shape, b=shape, c={**shape, **aside})
    assert sorted(shape.id() for shape in scene.shapes()) == ["a", "b", "c"]
    # Whether or not objects of a scene are merged.
    equal = {"type": "scene", "a": described(cube()), "b": described(cube())}
    assert len(mi.load_dict(equal, optimize=False).shapes()) == 2
    parameters = mi.traverse(scene)
    update(parameters, {"a.control_points": parameters["a.control_points"] * 2})
    a, c = (scene.ray_intersect(down(x, 0.1, 9)) for x in (0.1, 4.1))
    assert dr.all(a.p.z > c.p.z + 0.5)
    of_file = {"type": "subdivision", "filename": "cage.obj", "tessellation_rate": 3}
    state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), {"type": "scene", "left": of_file})
    text = mi.parser.write_string(state)
    assert '<shape type="subdivision" name="left">' in text
    assert '<integer name="tessellation_rate" value="3"' in text


def test_a_first_picture_and_coarse_tessellations_import_little():
    # What Mitsuba itself has imported costs nothing more. These take longest of the rest: 10 ms and more.
    printed(f"""
import sys, mitsuba as mi, numpy
there = set(sys.modules)
import mitsuba_subdivision
assert "mitsuba.scalar_rgb" not in sys.modules
mi.set_variant("scalar_rgb")
scene = {{"type": "scene", "cage": {{"type": "subdivision", "filename": {str(STAR)!r}}}}}
mi.render(mi.load_dict(scene | {{"sensor": {{"type": "perspective"}}, "integrator": {{"type": "direct"}}}}), spp=1)
from mitsuba_subdivision import ControlCage, LimitSurface
tetrahedron = [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], [(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)]
for scheme in ("catmull_clark", "loop", "doo_sabin"):
    LimitSurface(ControlCage(*tetrahedron), scheme).tessellate(4)
heavy = {{"scipy", "argparse"}}
assert not heavy & (set(sys.modules) - there), heavy & (set(sys.modules) - there)
""")


def problem():
    return exact_shading_problem(getattr(mi, mi.variant()))


def shading_of(shape):
    (line,) = [line for line in str(shape).splitlines() if "shading = " in line]
    return line.strip(" ,").removeprefix("shading = ")


@every_variant
def test_a_shape_states_its_shading():
    expected = "exact" if problem() is None else "vertex"
    assert (expected == "exact") == (not mi.variant().startswith("scalar") and hook_problem() is None)
    automatic, given = (load(cube(), shading=shading) for shading in ("auto", expected))
    assert shading_of(automatic) == shading_of(given) == expected
    assert mi.traverse(automatic).keys() == mi.traverse(given).keys()
    assert shading_of(load(cube(), shading="auto", face_normals=True)) == shading_of(load(cube())) == "vertex"


@exact_llvm
def test_flat_faces_contradict_exact_shading():
    message = 'parameters "face_normals" and "shading" contradict each other; expected flat or exact shading'
    with pytest.raises(RuntimeError, match=message):
        load(cube(), shading="exact", face_normals=True)


@scalar
def test_the_error_of_exact_shading_in_scalar_variants_names_the_variant():
    assert problem() == "exact shading needs a variant of llvm or cuda"
    with pytest.raises(Exception, match='shading: "exact" in a scalar variant; expected "vertex", "auto"'):
        load(cube(), shading="exact")


@llvm
def test_without_the_hook_automatic_shading_uses_vertex_normals(monkeypatch):
    monkeypatch.setattr(interaction_hook, "hook_problem", lambda: "needs another computer")
    assert problem() == "exact shading needs another computer"
    automatic = load(cube(), shading="auto")
    assert shading_of(automatic) == "vertex"
    np.testing.assert_array_equal(vertices(automatic), vertices(load(cube())))
    # A trial that fails is a reason, too, and takes place once.
    tried = []

    def fail(variant):
        tried.append(variant)
        raise RuntimeError("needs the virtual functions of Mitsuba 3.9")

    monkeypatch.setattr(interaction_hook, "hook_problem", lambda: None)
    monkeypatch.setattr(interaction_hook, "_hooks", {})
    monkeypatch.setattr(interaction_hook, "InteractionHook", fail)
    assert [problem(), problem()] == ["exact shading needs the virtual functions of Mitsuba 3.9"] * 2
    assert len(tried) == 1
