import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import upload
from shapes.cages import cube, load
from shapes.scenes import vertices
from shapes.updates import update
from shapes.variants import every_variant

CAGE = cube(attributes={"height": np.ones((8, 1)), "tint": np.ones((8, 3))})
OF_CAGE = ("positions", "face_sizes", "face_vertices", "vertex_height", "vertex_tint")
OF_HEIGHTS = {"displacement": "vertex_height"}
ADAPTIVE = {"tessellation": "adaptive"}
CHORD = {**ADAPTIVE, "chord_error": 1.0}
STAM = {"evaluator": "stam", "sample_offset": 0.1}
FOUR_TEXCOORDS = {"texcoords": np.zeros((4, 2))}


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"tesselation_rate": 3}, 'unknown parameter "tesselation_rate", did you mean "tessellation_rate"?'),
        ({"colour": "red"}, 'unknown parameter "colour"; known parameters: filename, positions, face_sizes'),
        ({"tessellation_rate": 0}, 'parameter "tessellation_rate" is 0; expected 1 to 1024'),
        ({"tessellation_rate": 2.5}, 'parameter "tessellation_rate" is 2.5; expected an integer'),
        ({"scheme": "butterfly"}, 'parameter "scheme": unknown scheme "butterfly"; known schemes: catmull_clark'),
        ({"scheme": ""}, 'parameter "scheme": unknown scheme ""; known schemes: catmull_clark'),
        ({"scheme": 3}, 'parameter "scheme" is 3; expected a string'),
        ({"shading": "automatic"}, 'parameter "shading" is "automatic"; expected one of vertex, exact, auto'),
        ({"flip_normals": "yes"}, "parameter \"flip_normals\" is 'yes'; expected true or false"),
        ({"filename": "cage.obj"}, 'parameters "filename" and "positions" contradict each other'),
        ({"face_sizes": None}, 'no control cage: expected "filename", or "face_sizes" as well'),
        (dict.fromkeys(OF_CAGE), 'no control cage: expected "filename", or "positions", "face_sizes"'),
        ({"positions": "here"}, "parameter \"positions\" is 'here'; expected a tensor"),
        ({"positions": np.zeros((8, 2))}, 'parameter "positions" has shape (8, 2); expected (n, 3)'),
        ({"face_sizes": np.full(6, 4.5)}, 'parameter "face_sizes" has values that are not integers'),
        ({"face_vertices": np.arange(24)}, "vertex"),
        ({"time": 1.0}, 'parameter "time" needs a USD file'),
        ({"to_world": np.diag([1.0, 1, 0, 1])}, 'parameter "to_world" has the determinant 0.0'),
        ({"shown_faces": np.array([6])}, 'parameter "shown_faces" has 6; expected 0 to 5'),
        ({"shown_faces": "0-2 4-9"}, 'parameter "shown_faces" has 9; expected 0 to 5'),
        ({"shown_faces": "1, 2"}, 'parameter "shown_faces" is "1, 2"; expected ranges such as "0-5 8"'),
        # Mitsuba would render no other shape of the scene beside one without triangles.
        ({"shown_faces": np.arange(0)}, 'parameter "shown_faces" shows no face; expected one at least'),
        ({"shown_faces": np.array([1]), "scheme": "doo_sabin"}, 'none for the scheme "doo_sabin", whose surface'),
        ({"texcoords": np.zeros((8, 3))}, 'parameter "texcoords" has shape (8, 3); expected (n, 2)'),
        ({"texcoord_indices": np.zeros(24)}, 'parameter "texcoord_indices" needs "texcoords"'),
        ({**FOUR_TEXCOORDS, "texcoord_indices": np.full(24, 4)}, 'index 4 into attribute "texcoords"; expected 0 to 3'),
        ({**FOUR_TEXCOORDS, "texcoord_indices": np.arange(24) % 4, "scheme": "doo_sabin"}, "has no rules for seams"),
        ({"texcoords": np.zeros((8, 2)), "varying_texcoords": np.zeros((8, 2))}, '"texcoords" a second time'),
        ({"vertex_c": np.zeros((8, 3)), "varying_c": np.zeros((8, 3))}, '"c" a second time; expected one'),
        ({"vertex_normals": np.zeros((8, 3))}, 'parameter "vertex_normals" names an attribute "normals"'),
        ({"vertex_c": np.zeros(8)}, 'parameter "vertex_c" has shape (8,); expected (n, k)'),
        ({"vertex_c": "red"}, "parameter \"vertex_c\" is 'red'; expected a tensor"),
        (
            {"filename": "cage.obj", "texcoords": np.zeros((8, 2)), **dict.fromkeys(OF_CAGE)},
            'parameters "filename" and "texcoords" contradict each other',
        ),
        ({"displacement": "height"}, 'no attribute "height"; expected one of "vertex_height", or a texture'),
        ({"displacement": "vertex_tint"}, "3 numbers per value; expected an attribute of one"),
        ({"displacement": 0.5}, '"displacement" is 0.5; expected a texture, or the name of an attribute'),
        ({"displacement": {"type": "diffuse"}}, '"displacement" is SmoothDiffuse; expected a texture, or the name'),
        ({"displacement": {"type": "checkerboard"}}, '"displacement": a texture was given, and control cage has no'),
        ({"displacement_scale": 0.5}, '"displacement_scale" needs "displacement"'),
        ({**OF_HEIGHTS, "displacement_scale": "high"}, "\"displacement_scale\" is 'high'; expected a number"),
        ({**OF_HEIGHTS, **STAM}, '"displacement" and "evaluator" contradict each other'),
        ({"shading": "exact", **STAM}, '"shading" and "evaluator" contradict each other'),
        ({**OF_HEIGHTS, "sample_offset": 0.1}, '"displacement" and "sample_offset" contradict each other'),
        (ADAPTIVE, "no limit; expected exactly one of chord_error, pixel_error, max_edge"),
        ({**CHORD, "max_edge": 1.0}, "chord_error and max_edge"),
        ({"tessellation": "uniform", "chord_error": 1.0}, '"chord_error" needs "tessellation" = "adaptive"'),
        ({"tessellation": "adaptiv"}, "expected one of uniform, adaptive"),
        ({**CHORD, "tessellation_rate": 4}, '"tessellation_rate" needs "tessellation" = "uniform"'),
        ({**ADAPTIVE, "pixel_error": 1.0}, '"sensor_to_world" is missing'),
        ({**CHORD, "outline": "sensor"}, '"outline" needs a sensor'),
        ({**CHORD, "outline": "all"}, "expected one of none, sensor"),
        ({**CHORD, "sensor_fov": 40.0}, '"sensor_fov" needs "pixel_error"'),
        ({**ADAPTIVE, "max_edge": 1e-9, "max_rate": 1024}, "expected a larger"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, dict) else "",
)
@every_variant
def test_errors_name_the_expected_values(parameters, message):
    given = {"type": "subdivision", **CAGE.as_properties(mi)}
    for name, value in parameters.items():
        if isinstance(value, np.ndarray):
            kind = mi.TensorXf if value.dtype == float else mi.TensorXu
            value = mi.ScalarTransform4f(value) if name == "to_world" else upload(kind, value)  # noqa: PLW2901
        given[name] = value
    with pytest.raises((ValueError, RuntimeError, MemoryError), match=re.escape(message)):
        mi.load_dict({name: value for name, value in given.items() if value is not None})


def points_with(*values):
    """Coordinates of the cube, of which those from the third vertex's y on are others."""
    points = cube().positions.ravel()
    return np.array([*points[:7], *values, *points[7 + len(values) :]])


VERTEX, FINITE = "control point 2 is", "expected finite numbers"
TEXTURED = cube(texcoords=cube().positions[:, :2], attributes={"tint": np.ones((8, 3))})
FAR = CAGE.with_positions(CAGE.positions + 1000)
PLAIN, AWAY, SEEN = ((cage, {"tessellation_rate": 2}) for cage in (CAGE, FAR, TEXTURED))


@pytest.mark.parametrize(
    ("made", "name", "value", "message"),
    [
        (PLAIN, "to_world", np.diag([1, 0, 1, 1]), "has the determinant 0.0; expected an invertible matrix"),
        (PLAIN, "to_world", np.diag([np.inf, 1, 1, 1]), "has the determinant inf; expected an invertible matrix"),
        (PLAIN, "to_world", 2 * np.eye(4), "has the last row (0.0, 0.0, 0.0, 2.0); expected (0, 0, 0, 1)"),
        (PLAIN, "control_points", points_with(np.nan), f"{VERTEX} (-1.0, nan, -1.0); {FINITE} (1 such in all)"),
        (
            *(PLAIN, "control_points", points_with(np.inf, -np.inf, np.nan, np.nan)),
            f"{VERTEX} (-1.0, inf, -inf); {FINITE} (2 such in all)",
        ),
        *((made, "control_points", np.zeros(21), "21 numbers; expected 24") for made in (PLAIN, AWAY)),
        (PLAIN, "cage_tint", np.ones(23), "23 numbers; expected 24, 3 for each of 8 values"),
        (PLAIN, "cage_tint", [*np.ones(22), np.inf, np.inf], f"value 7 is (1.0, inf, inf); {FINITE} (1 such in all)"),
        ((CAGE, OF_HEIGHTS), "displacement_scale", [np.nan], "[nan] was given; expected a finite number"),
        ((CAGE, {**ADAPTIVE, "chord_error": 0.1}), "chord_error", [-1.0], "is -1.0; expected a number above 0"),
        # Mitsuba would read and write beyond the end of these.
        (SEEN, "vertex_positions", np.zeros(10), "10 numbers; expected 78"),
        (SEEN, "vertex_normals", np.zeros(10), "10 numbers; expected 78"),
        (SEEN, "vertex_texcoords", np.zeros(10), "10 numbers; expected 52"),
    ],
)
@every_variant
def test_refused_updates_change_nothing(made, name, value, message):
    cage, parameters = made
    shape = load(cage, **parameters)
    shown = mi.traverse(shape)
    given, before = type(shown[name])(shown[name]), vertices(shape)
    if not dr.is_jit_v(mi.Float) and name != "to_world" and np.size(given) != len(value):
        pytest.skip("Mitsuba compares the values before it assigns them")
    wrong = type(given)(value) if name == "to_world" or not dr.is_array_v(given) else upload(type(given), value)
    with pytest.raises(ValueError, match=f'parameter "{name}":? {re.escape(message)}'):
        update(shown, {name: wrong})
    # Buffers are the user's own until they are given back.
    if not name.startswith("vertex_"):
        np.testing.assert_array_equal(vertices(shape), before)
    update(shown, {name: given})
