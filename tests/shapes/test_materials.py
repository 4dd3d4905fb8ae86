"""Shapes of single materials of a cage: together they are the surface of all."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, upload
from shapes.cages import cube
from shapes.scenes import buffer
from shapes.variants import scalar

MATERIALS = {"": [0], "red": [1, 4], "dark blue": [2, 3, 5]}
# Sums of some hundred areas in single precision.
ROUNDING = 1e-6
TESSELLATIONS = [{"tessellation_rate": 3}, {"tessellation": "adaptive", "max_edge": 0.4}]


@pytest.fixture
def file(tmp_path):
    """A cube with materials, of which one is used twice, and a crease between two."""
    cube().save(tmp_path / "plain.obj")
    lines = (tmp_path / "plain.obj").read_text().splitlines()
    faces = [line for line in lines if line.startswith("f ")]
    names = {face: name for name, of_name in MATERIALS.items() for face in of_name}
    text = [line for line in lines if not line.startswith("f ")]
    for face, line in enumerate(faces):
        text += [*([f"  usemtl {names[face]} "] if names[face] else []), line]
    (tmp_path / "cube.obj").write_text("\n".join([*text, "t crease 2/1/0 0 1 10", ""]))
    return str(tmp_path / "cube.obj")


def shape(**parameters):
    return mi.load_dict({"type": "subdivision", **parameters})


def triangles(part):
    """Positions of the corners of all triangles, as numbers with all their bits, in one order."""
    corners = buffer(part, "vertex_positions")[buffer(part, "faces")].reshape(-1, 9)
    return corners[np.lexsort(corners.T)]


def test_files_name_the_material_of_each_face(file):
    cage = ControlCage.from_file(file)
    assert {name: faces.tolist() for name, faces in cage.materials.items()} == MATERIALS
    refined = cage.refined().materials
    assert {name: len(faces) for name, faces in refined.items()} == {"": 4, "red": 8, "dark blue": 12}


@scalar
@pytest.mark.parametrize("given", TESSELLATIONS, ids=["uniform", "adaptive"])
def test_materials_share_their_vertices_bit_by_bit(file, given):
    whole = shape(filename=file, **given)
    parts = [shape(filename=file, material=material, **given) for material in MATERIALS]
    together = np.concatenate([triangles(part) for part in parts])
    np.testing.assert_array_equal(together[np.lexsort(together.T)], triangles(whole))
    areas = [float(part.surface_area()) for part in parts]
    assert sum(areas) == pytest.approx(float(whole.surface_area()), rel=ROUNDING)
    assert min(areas) > 0


@scalar
def test_unknown_materials_and_faces_are_errors(file):
    with pytest.raises(RuntimeError, match='"material" is "green"; expected one of "", "red", "dark blue"'):
        shape(filename=file, material="green")
    with pytest.raises(RuntimeError, match='"material" and "shown_faces" contradict each other'):
        shape(filename=file, material="red", shown_faces=upload(mi.TensorXu, [1]))
