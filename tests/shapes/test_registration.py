"""The plugin is there in every variant, whatever the order of import and `set_variant`."""

import subprocess
import sys
import threading
from pathlib import Path

import mitsuba as mi
import mitsuba_subdivision as msub
import pytest
from mitsuba_subdivision.llvm import llvm_problem, require_llvm
from mitsuba_subdivision.shapes import register_variant
from shapes.cages import cube, load
from shapes.variants import every_variant, scalar

STAR = Path(__file__).parents[2] / "scenes/cages/star.obj"
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


def run(code):
    """In a process of its own: other tests use the variant where Mitsuba looks types up."""
    command = [sys.executable, "-W", "error", "-c", BEGIN + code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("order", ORDERS)
def test_order_of_import(order):
    again = "mitsuba_subdivision.register()\nassert faces() == [768], faces()"
    run(f"{ORDERS[order]}\nassert faces() == [768], faces()\n{again}")


@needs_llvm
def test_switching_back_and_forth():
    code = "import mitsuba as mi, mitsuba_subdivision\n"
    for variant in ("scalar_rgb", "llvm_ad_rgb", "scalar_rgb", "scalar_spectral", "llvm_ad_rgb", "llvm_ad_spectral"):
        code += f"mi.set_variant('{variant}'); assert faces() == [768], '{variant}'\n"
    run(code)


def test_every_variant(variants_all):
    shape = load(cube(), tessellation_rate=2)
    assert shape.face_count() == 6 * 2 * 4
    assert isinstance(shape, register_variant(variants_all))


@every_variant
def test_a_missing_llvm_matters_to_its_own_variants_only(monkeypatch):
    monkeypatch.setattr("mitsuba_subdivision.llvm.llvm_problem", lambda: "no LLVM here")
    require_llvm.cache_clear()
    if mi.variant().startswith("llvm"):
        with pytest.raises(RuntimeError, match="no LLVM here"):
            load(cube(), tessellation_rate=1)
    else:
        assert load(cube(), tessellation_rate=1).face_count() == 12


@needs_llvm
def test_a_library_that_aborts_is_warned_of_where_an_llvm_variant_is_set_and_nowhere_else(monkeypatch):
    mi.set_variant("scalar_rgb")
    monkeypatch.setattr("mitsuba_subdivision.llvm.llvm_problem", lambda: "this LLVM aborts")
    with pytest.warns(RuntimeWarning, match="this LLVM aborts"):
        mi.set_variant("llvm_ad_rgb")
    # A warning would be an error.
    mi.set_variant("scalar_rgb")


@scalar
def test_registers_once():
    before = register_variant("scalar_rgb")
    msub.register()
    assert register_variant("scalar_rgb") is before


@scalar
def test_registers_once_from_many_threads():
    found = []
    threads = [threading.Thread(target=lambda: found.append(register_variant("scalar_spectral"))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert len(set(found)) == 1


@pytest.mark.parametrize("variant", ["scalar_rgb", pytest.param("llvm_ad_rgb", marks=needs_llvm)])
def test_equal_shapes_of_a_dict_stay_two(variant):
    code = """
scene = mi.load_dict({'type': 'scene', 'left': cube(), 'right': cube()})
assert sorted(shape.id() for shape in scene.shapes()) == ['left', 'right']
assert {'left.control_points', 'right.control_points'} <= set(mi.traverse(scene).keys())
# Whether or not objects of a scene are merged.
one = cube()
assert len(mi.load_dict({'type': 'scene', 'a': one, 'b': one}, optimize=False).shapes()) == 2
"""
    run(f"import mitsuba_subdivision, mitsuba as mi; mi.set_variant('{variant}')\n{code}")


@needs_llvm
def test_a_dict_can_be_written_as_xml():
    run("""
import mitsuba_subdivision, mitsuba as mi; mi.set_variant('llvm_ad_rgb')
scene = {'type': 'scene', 'left': {'type': 'subdivision', 'filename': 'cage.obj', 'tessellation_rate': 3}}
state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), scene)
text = mi.parser.write_string(state)
assert '<shape type="subdivision" name="left">' in text, text
assert '<integer name="tessellation_rate" value="3"' in text, text
""")


def test_unknown_variant_is_an_error():
    with pytest.raises(ValueError, match=r'unknown variant "scalar_grb"; expected one of .*scalar_rgb'):
        register_variant("scalar_grb")


def test_a_first_picture_imports_little():
    # What Mitsuba itself has imported costs nothing more. These take longest of the rest.
    run(f"""
import sys, mitsuba as mi, numpy
there = set(sys.modules)
import mitsuba_subdivision
assert "mitsuba.scalar_rgb" not in sys.modules
mi.set_variant("scalar_rgb")
scene = {{"type": "scene", "cage": {{"type": "subdivision", "filename": {str(STAR)!r}}}}}
mi.render(mi.load_dict(scene | {{"sensor": {{"type": "perspective"}}, "integrator": {{"type": "direct"}}}}), spp=1)
heavy = {{"scipy", "pathlib", "argparse"}}
assert not heavy & (set(sys.modules) - there), heavy & (set(sys.modules) - there)
""")
