"""The studio: framing by the camera, scenes of models, and scenes as XML."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mitsuba_subdivision.cage import CageError, cage_of, named_cages
from mitsuba_subdivision.cage.errors import CageWarning
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.regression.scene import load_scene
from mitsuba_subdivision.studio import studio, studio_entries, studio_scene
from mitsuba_subdivision.studio.cage_scenes import Model
from mitsuba_subdivision.studio.saving import save_scene
from mitsuba_subdivision.studio.studio_entries import MARGIN, NEAREST, VIEWS, camera_axes, framed, outermost, sampler

llvm, scalar = (pytest.mark.usefixtures(f"variant_{name}") for name in ("llvm_ad_rgb", "scalar_rgb"))
CAGES = Path(msub.example_file("human.xml")).parent / "cages"
# How far outside the margin rounding may put a point, in parts of the picture.
ROUNDING = 1e-9
SMALL = {"size": (24, 18), "spp": 16, "rate": 2}


def in_picture(points, origin, axes, size):
    """Places of points, from -1 to 1 in each direction of the picture, by the definition of a perspective camera."""
    x, y, z = ((points - origin) @ axes).T
    assert (z > 0).all()
    half = np.tan(np.radians(studio_entries.FIELD_OF_VIEW / 2)) * np.array(size) / max(size)
    return np.stack([x, y], axis=1) / (z[:, None] * half)


@pytest.mark.core
@given(
    seed=st.integers(0, 2**32 - 1),
    azimuth=st.floats(-720, 720),
    elevation=st.floats(-90, 90),
    size=st.tuples(st.integers(1, 2000), st.integers(1, 2000)),
    scale=st.floats(1e-4, 1e5),
)
@settings(max_examples=60, deadline=None)
def test_all_points_are_in_the_picture_and_fill_it(seed, azimuth, elevation, size, scale):
    rng = np.random.default_rng(seed)
    points = scale * (rng.normal(size=(40, 3)) * rng.uniform(0.01, 3, 3) + rng.normal(size=3))
    axes, (origin, _) = camera_axes(azimuth, elevation), framed(points, azimuth, elevation, size)
    places = in_picture(points, origin, axes, size)
    reach = np.abs(places).max(axis=0)
    assert (reach <= 1 - 2 * MARGIN + ROUNDING).all()
    depth = (points - origin) @ axes[:, 2]
    assert depth.min() >= np.ptp(depth) * (NEAREST - ROUNDING)
    if depth.min() > np.ptp(depth) * (NEAREST + ROUNDING):
        assert reach.max() >= 1 - 2 * MARGIN - ROUNDING
        tight = reach.argmax()
        np.testing.assert_allclose(places[:, tight].max(), -places[:, tight].min(), rtol=1e-6)
    # The few outermost points ask for the same camera.
    again, _ = framed(outermost(points, "z", (azimuth, elevation), size), azimuth, elevation, size)
    np.testing.assert_allclose(again, origin, atol=1e-9 * scale)


@pytest.fixture(scope="module")
def human():
    surface = msub.LimitSurface(msub.ControlCage.from_file(CAGES / "human.obj"))
    return surface.cage, surface.tessellate(3).positions


@pytest.mark.parametrize(("view", "up"), [*zip([*VIEWS, (200, 40), (-60, -30)], "yzyzyzy", strict=True)])
@llvm
def test_mitsubas_sensor_has_every_limit_point_on_its_film(human, up, view):
    cage, points = human
    reach, place = [], mi.Interaction3f()
    place.p = upload(mi.Point3f, points)
    for size in ((64, 48), (20, 90), (200, 10)):
        sensor = mi.load_dict(studio_scene(cage, view=view, up=up, size=size)["sensor"])
        places = np.array(sensor.sample_direction(place, mi.Point2f(0))[0].uv).T / size
        assert (places > MARGIN / 2).all()
        assert (places < 1 - MARGIN / 2).all()
        reach.append(np.ptp(places, axis=0).max())
    assert reach[0] > 1 - 2.2 * MARGIN


def picture(scene, **options):
    return np.array(mi.render(load_scene(scene).scene, **options))


@scalar
def test_pictures_of_any_size_of_model_are_the_same_and_not_clipped():
    cage = named_cages.extraordinary(5, closed=False)
    scenes = [studio_scene(cage.with_positions(scale * cage.positions), **SMALL) for scale in (1, 1e-3, 1e4)]
    image, *others = map(picture, scenes)
    for other in others:
        # But for noise.
        assert np.abs(image - other).mean() < 0.02
        np.testing.assert_allclose(image.mean(axis=(0, 1)), other.mean(axis=(0, 1)), rtol=0.02)
        # Neither black nor burnt, as an open cage is seen from both sides.
        assert np.percentile(other, 1) > 0.05
        assert np.percentile(other, 99) < 1
    alone = {name: scenes[1][name] for name in ("type", "integrator", "sensor", "surface")}
    film = {**alone["sensor"]["film"], "pixel_format": "rgba", "rfilter": {"type": "box"}}
    alpha = picture({**alone, "sensor": {**alone["sensor"], "film": film}})[..., 3]
    assert np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]]).max() == 0
    assert alpha.max() > 0.9


@scalar
def test_y_up_and_z_up_are_the_same_picture():
    cage = msub.ControlCage.from_file(CAGES / "rook.obj")
    turned = cage.with_positions(cage.positions @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]))
    a, b = (picture(studio_scene(model, up=up, **SMALL), spp=256) for model, up in ((cage, "z"), (turned, "y")))
    # But for noise.
    assert np.abs(a - b).mean() < 0.01


@scalar
@pytest.mark.parametrize("view", ["three-quarter", (20, -20)])
def test_a_saved_scene_renders_to_the_same_picture(tmp_path, view):
    look = {"up": "z", "view": view, "checker": True, "cage": True}
    scene = studio_scene(CAGES / "barrel.obj", scheme="catmull_clark", **look, **SMALL)
    written = save_scene(scene, tmp_path / "deep" / "scene.xml")
    assert [path.name for path in written][-1] == "scene.xml"
    # As the command loads them: Mitsuba itself may merge meshes, and then shuffles lights.
    a, b = (np.array(mi.render(loaded.scene)) for loaded in (load_scene(scene), load_scene(written[-1])))
    assert np.abs(a - b).max() < 5e-3
    root = ElementTree.parse(written[-1]).getroot()
    names = {node.get("name") for node in root} & {"surface", "cage", "key_light", "sensor", "ground"}
    assert names >= {"surface", "cage", "key_light", "sensor"}
    assert ("ground" in names) == (view == "three-quarter")
    files = [node.get("value") for node in root.iter("string") if node.get("name") == "filename"]
    assert [name for name in files if name.startswith("/")] == []
    # Lights are placed by where they look.
    assert root.find(".//matrix") is None


@scalar
def test_saved_transforms_are_the_same(tmp_path):
    turned = mi.ScalarTransform4f().translate([1, 2, 300]).rotate([0.6, 0, 0.8], 50)
    placed = [turned, *(turned.scale(sides) for sides in ([2, 1, 0.5], [1, 1, -1]))]
    placed += [turned.scale([2, 1, 1]).rotate([0, 0, 1], 30), mi.ScalarTransform4f().scale([2, 1, -1])]
    scene = {f"shape{number}": {"type": "rectangle", "to_world": to_world} for number, to_world in enumerate(placed)}
    saved = mi.load_file(str(save_scene({"type": "scene", **scene}, tmp_path / "s.xml")[-1]), optimize=False)
    for shape, expected in zip(saved.shapes(), placed, strict=True):
        np.testing.assert_allclose(mi.traverse(shape)["to_world"].matrix, expected.matrix, atol=1e-5)


@scalar
def test_a_scene_of_arrays_is_saved_with_its_cages(tmp_path):
    scene = studio_scene(named_cages.cube(), **SMALL)
    assert {path.name for path in save_scene(scene, tmp_path / "a.xml")} == {"a_surface.obj", "a_ground.obj", "a.xml"}
    (tmp_path / "c_ground.obj").write_bytes((CAGES / "rook.obj").read_bytes())
    with pytest.raises(ValueError, match="is an input as well"):
        save_scene(studio_scene(tmp_path / "c_ground.obj"), tmp_path / "c.xml")
    with pytest.raises(ValueError, match=r"expected a name ending in \.xml"):
        save_scene(scene, tmp_path / "a.png")


def _with(**more):
    return cage_of(named_cages.cube().contents, **more)


VALUES, CORNERS = np.linspace(0.25, 1, 16).reshape(8, 2), np.linspace(0.25, 1, 72).reshape(24, 3)
TEXCOORDS, HEAT = msub.Attribute(VALUES), {"heat": msub.Attribute(VALUES[:, :1])}
TINT = {"tint": msub.Attribute(CORNERS, "face_varying")}
TAGS = {"creases": np.array([[0, 1, 2.5]]), "corners": np.array([[3, 4.0]]), "holes": np.array([0])}
CAGES_WITH_DATA = {
    "texcoords at corners": (msub.ControlCage.from_file(CAGES / "barrel.obj"), ".obj"),
    "vertex": (_with(texcoords=TEXCOORDS, attributes=HEAT), ".ply"),
    "varying": (_with(texcoords=msub.Attribute(VALUES, "varying")), ".usda"),
    "all": (_with(**TAGS, texcoords=TEXCOORDS, attributes=TINT), ".usda"),
    "rules": (_with(**TAGS, attributes=HEAT, crease_method="chaikin", boundary="edge_only"), ".usda"),
    "rules at vertices": (_with(attributes=HEAT, triangle_rule="smooth"), ".ply"),
}


@pytest.mark.parametrize(("cage", "suffix"), CAGES_WITH_DATA.values(), ids=CAGES_WITH_DATA)
@scalar
def test_cages_in_memory_are_read_back_from_a_saved_scene(tmp_path, cage, suffix):
    """In the plainest format that holds them."""
    pytest.importorskip("pxr")
    pytest.importorskip("plyfile")
    scene = studio_scene(cage, **SMALL)
    *_, written = save_scene(scene, tmp_path / "s.xml")
    assert (tmp_path / f"s_surface{suffix}").is_file()
    shapes = [
        result
        for source in (scene, written)
        for result in map(mi.traverse, load_scene(source).scene.shapes())
        if "control_points" in result and len(result["control_points"]) == cage.positions.size
    ]
    keys = [set(result.keys()) for result in shapes]
    assert keys[0] == keys[1]
    for key in (key for key in keys[0] if key.startswith(("control_points", "cage_", "vertex_", "faces"))):
        np.testing.assert_allclose(*(np.array(result[key]) for result in shapes), atol=1e-6, err_msg=key)


@scalar
def test_unstorable_cages_are_refused_before_writing(tmp_path, monkeypatch):
    pytest.importorskip("pxr")
    values = msub.Attribute(np.linspace(0.25, 1, 24).reshape(24, 1), "face_varying")
    bad, good = (_with(attributes={name: values}) for name in ("a b", "ab"))
    no_dictionary = studio_scene(named_cages.cube(), **SMALL)
    no_dictionary["surface"]["bsdf"] = mi.load_dict({"type": "diffuse"})
    with pytest.raises(CageError, match='attribute "a b" of "surface" cannot be written to a file; expected a name of'):
        save_scene(studio_scene(bad, **SMALL), tmp_path / "s.xml")
    message = '"bsdf" of "surface" is an object of Mitsuba, BSDF; expected a dictionary to save'
    with pytest.raises(ValueError, match=message):
        save_scene(no_dictionary, tmp_path / "s.xml")
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    message = '"ab" of "surface" cannot be written to an OBJ file; expected the package usd-core'
    with pytest.raises(CageError, match=message):
        save_scene(studio_scene(good, **SMALL), tmp_path / "s.xml")
    assert list(tmp_path.iterdir()) == []


def test_rods_and_balls_lie_around_edges_and_vertices():
    cage = named_cages.cube()
    model = Model(cage)
    radius, wire = model.wire_radius, model.wire_cage
    drawn = msub.LimitSurface(wire).tessellate(4)
    p, n = drawn.positions, drawn.normals
    from_vertex = np.linalg.norm(p[:, None] - cage.positions, axis=2).min(axis=1)
    is_rod = from_vertex > 2.3 * radius
    assert is_rod.sum() > 100
    assert from_vertex[~is_rod].min() > 0.9 * radius
    start, end = cage.positions[cage.edges[:, 0]], cage.positions[cage.edges[:, 1]]
    along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    away = p[is_rod, None] - start
    away -= (away * along).sum(axis=2, keepdims=True) * along
    distance = np.linalg.norm(away, axis=2)
    nearest = distance.argmin(axis=1)
    np.testing.assert_allclose(distance.min(axis=1), radius, rtol=0.04)
    assert (away[np.arange(len(away)), nearest] * n[is_rod]).sum(axis=1).min() > 0
    shift = np.array([1.0, 2, 3])
    np.testing.assert_allclose(model.wire_points(cage.positions + shift), wire.positions + shift, atol=1e-12)


@scalar
def test_the_up_axis_is_the_one_of_the_file(tmp_path):
    pytest.importorskip("pxr")
    pytest.importorskip("plyfile")
    for suffix, axis in ((".obj", "y"), (".ply", "z")):
        assert Model(named_cages.cube(), tmp_path / f"a{suffix}").up == axis
    for axis in ("Y", "Z"):
        (tmp_path / f"{axis}.usda").write_text(f'#usda 1.0\n( upAxis = "{axis}" )\n')
        assert Model(named_cages.cube(), tmp_path / f"{axis}.usda").up == axis.lower()


@scalar
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"view": "left"}, 'view "left"; expected one of front, side, back, top, three-quarter'),
        ({"view": (1, 2, 3)}, "expected one of front"),
        ({"view": (0, 91)}, "elevation 91; expected -90 to 90 degrees"),
        # It differs from what was expected.
        ({"view": (0, 90.00000001)}, "elevation 90.00000001; expected -90 to 90"),
        ({"up": "x"}, 'up axis "x"; expected y or z'),
        ({"shading": "glossy"}, 'shading "glossy"; expected one of vertex, exact, auto'),
        ({"size": (0, 4)}, "expected width and height"),
        ({"spp": 0}, "expected 1 or more samples per pixel"),
        ({"checker": True}, "has no texture coordinates"),
        ({"prim": "/a"}, "prim or time was given"),
    ],
)
def test_errors_name_the_expected_values(arguments, message):
    with pytest.raises((ValueError, CageError), match=message):
        studio_scene(named_cages.cube(), **arguments)


@pytest.mark.parametrize(
    "bounds", [[[0, 0, 0], [0, 0, 0]], [[1, 0, 0], [0, 1, 1]], [[0, 0, 0]], [[0, 0, 0], [1, 1, np.inf]]]
)
@scalar
def test_invalid_bounds_are_refused(bounds):
    with pytest.raises(ValueError, match="bounds"):
        studio(bounds)


def test_mitsuba_renders_the_given_number_of_samples():
    """It would round other numbers up, and warn."""
    counts = [sampler(spp)["sample_count"] for spp in range(1, 101)]
    assert [mi.load_dict(sampler(spp)).sample_count() for spp in range(1, 101)] == counts
    assert all(spp <= count <= spp + np.sqrt(spp) for spp, count in enumerate(counts, 1))


def coloured(attribute, **more):
    """A cube, red at vertices with x above 0, blue at others."""
    cage = named_cages.cube()
    colours = np.where(cage.positions[:, :1] > 0, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    return _with(attributes={attribute: msub.Attribute(colours), "weight": msub.Attribute(np.ones((8, 1)))}, **more)


@scalar
def test_vertex_colours_are_shown_without_a_checkerboard(tmp_path):
    """Red is on the right and blue on the left, from a file and from memory."""
    pytest.importorskip("plyfile")
    coloured("color").save(tmp_path / "cube.ply")
    for model in (coloured("color"), coloured("displayColor"), tmp_path / "cube.ply"):
        image = picture(studio_scene(model, view="front", up="z", **SMALL))
        left, right = (image[8:11, columns].mean(axis=(0, 1)) for columns in (slice(6, 9), slice(15, 18)))
        # Subdivision mixes the colours of the corners.
        assert left[2] > 1.5 * left[0]
        assert right[0] > 1.5 * right[2]

    def kind(cage, **more):
        return studio_scene(cage, **more, **SMALL)["surface"]["bsdf"]["bsdf"]["base_color"]["type"]

    assert kind(coloured("color", texcoords=msub.Attribute(np.zeros((8, 2)))), checker=True) == "checkerboard"
    assert kind(_with(attributes={"color": msub.Attribute(np.zeros((8, 1)))})) == "rgb"


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (0, "bounds from (1, 1, 1) to (1, 1, 1); expected a box with a size, below 1e+37"),
        (1e300, "bounds from (-8.3"),
        (1e-12, "units large; expected 1e-09 to 5e+08"),
        (1e12, "units large; expected 1e-09 to 5e+08"),
    ],
)
@scalar
def test_unrenderable_sizes_are_errors_that_name_the_file(tmp_path, scale, message):
    cage, is_error = _with(positions=named_cages.cube().positions * scale + (scale == 0)), scale in (0, 1e300)
    cage.save(tmp_path / "cube.obj")
    for model, name in ((cage, ""), (tmp_path / "cube.obj", 'cube.obj": ')):
        match = f"{name}(a model [0-9.e+-]+ )?{re.escape(message)}"
        with pytest.raises(ValueError, match=match) if is_error else pytest.warns(CageWarning, match=match):
            studio_scene(model, **SMALL)
