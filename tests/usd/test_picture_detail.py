"""Detail of pictures: segments, points that a camera frames, copies as one shape, and smaller images."""

import struct
import warnings
import zlib
from dataclasses import replace

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mitsuba_subdivision.cage import Attribute, CageWarning, cage_of, named_cages
from mitsuba_subdivision.cage.contents import CageContents
from mitsuba_subdivision.mitsuba_mesh import points_at
from mitsuba_subdivision.srgb import decoded
from mitsuba_subdivision.studio.cage_scenes import frame_table
from mitsuba_subdivision.studio.picture import ERRORS, FINEST_RATE, MOST_TRIANGLES, highest_rate, outline_for
from mitsuba_usd import contents, copies
from mitsuba_usd.contents import InstanceContents, NodeContents, SceneContents, ShapeContents, TextureContents
from mitsuba_usd.copies import LARGE, LEAST_INSTANCES, with_copies, with_large_copies
from mitsuba_usd.picture_detail import TEXELS_PER_PIXEL, segments_of, texels_for_pictures, triangles_for_picture
from mitsuba_usd.scene_entries import DENSE, Surfaces, subdivision
from mitsuba_usd.stage_warnings import StageWarnings
from mitsuba_usd.texture_image import read_texture_image, reduced
from mitsuba_usd.textures import Textures
from patches.closed_cages import torus
from usd.stages import FOV, WIDTH, sensor_at

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")


def _shape(cage, matrix=None, name="/shape"):
    return ShapeContents(name, replace(cage.contents, scheme="catmull_clark"), np.eye(4) if matrix is None else matrix)


def _segments(contents, sensor, shading):
    segments = segments_of(contents, Surfaces(), outline_for(sensor), sensor["near_clip"], shading)
    return {shape: of_copies.max() for shape, of_copies in segments.items()}


def _rate(shape, sensor, shading="exact"):
    return _segments(SceneContents(shapes=[shape]), sensor, shading)[shape]


def _triangles(contents, sensor, shading="exact", **parameters):
    parameters = {"shading": shading, "tessellation_rate": 8, **parameters}
    outline = outline_for(sensor)
    segments = segments_of(contents, Surfaces(), outline, sensor["near_clip"], shading)
    return triangles_for_picture(contents, segments, outline, parameters)


def _moved(*offset, scale=1.0):
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = offset
    return matrix


@pytest.mark.parametrize(("shading", "columns"), [("exact", 8), ("exact", 60), ("vertex", 8), ("vertex", 20)])
def test_triangles_meet_the_pictures_error_closely(columns, shading):
    cage = torus(columns, columns // 2)
    surface, rate = msub.LimitSurface(cage), _rate(_shape(cage), sensor_at(12.0), shading)

    def error(rate):
        """Of the middles of triangles and of their edges, as the nearest part of the torus shows it."""
        mesh = surface.tessellate(rate=rate)
        corners = np.asarray(mesh.positions)[np.asarray(mesh.triangles)[::29]]
        places = np.concatenate([corners.mean(axis=1), (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3) / 2])
        distance = surface.closest_point(places).distance.max()
        return distance * WIDTH / (2 * np.tan(np.radians(FOV / 2)) * (12 - 1))

    assert error(rate) < ERRORS[shading]
    assert rate == 1 or error(max(1, rate // 2)) > ERRORS[shading]


@pytest.mark.core
def test_segments_follow_the_size_in_the_picture():
    shape = _shape(torus(8, 5))
    near, far, larger = (_rate(shape, sensor) for sensor in (sensor_at(8), sensor_at(80), sensor_at(8, 2560)))
    assert far < near < larger
    # Around the camera, a picture may show any part from near.
    assert _rate(shape, sensor_at(0)) == FINEST_RATE
    # Four times the size, four times as far away.
    assert _rate(replace(shape, to_world=_moved(0, 0, 24, scale=4)), sensor_at(8)) == near
    wide = mi.ScalarTransform4f().translate([0, 0, -8]).scale([3, 3, 1])
    film = {"type": "hdrfilm", "width": WIDTH, "height": WIDTH}
    flat = {"type": "orthographic", "to_world": wide, "film": film, "near_clip": 0.01}
    assert _rate(shape, flat) == _rate(replace(shape, to_world=_moved(0, 0, 100)), flat) > 1
    # The nearest instance decides.
    places = [InstanceContents(f"/{z}", 0, _moved(0, 0, z)) for z in (0, 40, 400)]

    def rate(instances):
        return _segments(SceneContents(groups=[[shape]], instances=instances), sensor_at(8), "exact")[shape]

    assert rate(places) == rate(places[:1]) == near > rate(places[1:]) > rate(places[2:])
    # A dense part does not hide what a coarse one needs; a tenth of the size may have ten times the error.
    for size, least in ((1, 0.9), (0.1, 0.1**0.5)):
        coarse = torus(8, 5).with_positions(size * torus(8, 5).positions)
        alone, beside = _shape(coarse), _shape(msub.joined_cage([coarse, torus(96, 60)]))
        assert _rate(beside, sensor_at(8)) >= least * _rate(alone, sensor_at(8))


def test_still_pictures_have_adaptive_triangles_where_these_are_fewer():
    cage, sensor = torus(24, 16), sensor_at(5.0)
    shape, group, dense = _shape(cage), _shape(cage, name="/group"), _shape(torus(300, 200))
    contents = SceneContents(shapes=[shape, dense], groups=[[group]], instances=[InstanceContents("/i", 0, np.eye(4))])
    segments = _segments(contents, sensor, "exact")
    triangles = _triangles(contents, sensor)
    expected = {**outline_for(sensor), "max_rate": FINEST_RATE}
    assert {**triangles[shape], "sensor_to_world": None} == {**expected, "sensor_to_world": None}
    assert segments[dense] == 1
    assert triangles[dense] == {"tessellation_rate": 1}
    # Instances are seen from several sides, and displaced surfaces have unknown outlines.
    assert triangles[group] == {"tessellation_rate": min(segments[group], 8)}
    assert _triangles(contents, sensor, displacement="vertex_height")[shape] == triangles[group]
    assert _triangles(contents, sensor, tessellation_rate=2)[group] == {"tessellation_rate": 2}
    assert set(_triangles(contents, sensor, "vertex")[shape]) == {"tessellation_rate"}
    # A few uniform triangles need no choice.
    far = sensor_at(40.0)
    assert _triangles(contents, far)[shape] == {"tessellation_rate": _rate(shape, far)}


@pytest.mark.core
@given(st.lists(st.tuples(st.integers(1, 64), st.integers(3, 4_000_000)), min_size=1))
def test_rates_end_where_there_are_most_triangles(cages):
    segments, corners = np.array(cages).T
    highest = highest_rate(segments, corners)
    assert 1 <= highest <= FINEST_RATE
    assert highest == 1 or (np.minimum(segments, highest) ** 2 * corners).sum() // 2 <= MOST_TRIANGLES
    more = min(highest + 1, FINEST_RATE)
    assert highest == more or (np.minimum(segments, more) ** 2 * corners).sum() // 2 > MOST_TRIANGLES


def test_dense_cages_are_framed_by_points_around_the_surface():
    """None of which is far from it; unused vertices and those of holes do not count."""
    cage = torus(80, 40)
    assert cage.face_count >= DENSE
    points = np.concatenate([cage.positions, [[1e3, 0, 0]]])
    contents = replace(cage.contents, positions=points, holes=np.arange(40), scheme="catmull_clark")
    with pytest.warns(CageWarning, match="used by no face"):
        surface = msub.LimitSurface(cage_of(contents))
    points = Surfaces().points(SceneContents(shapes=[ShapeContents("/shape", contents, _moved(1, 2, 3))]))
    exact = points_at(frame_table(surface).apply(surface.cage.positions)[0], _moved(1, 2, 3))
    for direction in np.random.default_rng(0).normal(size=(50, 3)):
        unit = direction / np.linalg.norm(direction)
        assert 0 <= (points @ unit).max() - (exact @ unit).max() < 0.01


def test_equal_cages_are_made_once_and_warn_by_their_own_names():
    contents = named_cages.cube().contents
    contents = replace(contents, positions=np.concatenate([contents.positions, np.ones((1, 3))]))
    one, other = (replace(contents, source=replace(contents.source, name=name)) for name in ("/left", "/right"))
    moved = replace(other, positions=other.positions + np.array([0, 0, 1.0]))
    surfaces, entries = Surfaces(), []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert surfaces.of(one) is surfaces.of(other)
        assert surfaces.of(one) not in (surfaces.of(moved), surfaces.of(replace(one, scheme="doo_sabin")))
    for cage in (one, other, moved):
        notes = StageWarnings()
        entries.append(subdivision(ShapeContents(cage.source.name, cage, np.eye(4)), surfaces, {}, None, {}, notes))
        with pytest.warns(CageWarning, match=f"^{cage.source.name}: 1 of 9 vertices"):
            notes.warn("stage")
    first, second, third = entries
    assert first["face_vertices"] is second["face_vertices"]
    assert not np.array_equal(np.array(first["positions"]), np.array(third["positions"]))


CUBE = named_cages.cube().contents
POINTS, COUNT = CUBE.positions, LEAST_INSTANCES + 6


def cube_shape(name="/cube", to_world=None, **changes):
    cage = replace(CUBE, **{"scheme": "catmull_clark", **changes})
    return ShapeContents(name, cage, np.eye(4) if to_world is None else to_world)


def placed(number):
    matrix = np.diag([1.0, 2.0, 1.0, 1.0])
    matrix[0, 3] = number
    return matrix


def scene(shapes=(), group=(), count=COUNT):
    instances = [InstanceContents(f"/i{number}", 0, placed(number)) for number in range(count)]
    return SceneContents(shapes=[*shapes], groups=[[*group]], instances=instances)


def rates_of(shape):
    """Of two kinds, as for copies near the camera and others."""
    return {shape: np.where(np.arange(COUNT) < 10, 3, 1)}


def copied(contents, rates=None, shading="exact", notes=None, **more):
    return with_copies(contents, rates or {}, shading, notes or StageWarnings(), **more)


def test_copies_of_one_rate_are_one_shape():
    shape, alone = cube_shape(), cube_shape("/alone")
    contents, rates = copied(scene([alone], [shape]), rates_of(shape))
    first, many, few = contents.shapes
    assert (contents.groups, contents.instances, first) == ([], [], alone)
    assert (rates[many], rates[few], len(few.cage.face_sizes)) == (1, 3, 6 * 10)
    expected = [POINTS * [1, 2, 1] + [number, 0, 0] for number in range(10)]
    np.testing.assert_allclose(few.cage.positions, np.concatenate(expected))
    # Those of a part show its faces only.
    (part,) = copied(scene(group=[replace(shape, shown_faces=np.array([1, 4]))]))[0].shapes
    np.testing.assert_array_equal(part.shown_faces, np.add.outer(6 * np.arange(COUNT), [1, 4]).ravel())


@pytest.mark.parametrize("shading", ["vertex", "exact"])
def test_the_highest_rate_gives_way_to_memory(monkeypatch, shading):
    """Twice as many triangles along each side of 10 cubes do not fit."""
    triangles, shape = 12 * (10 * 2**2 + (COUNT - 10)), cube_shape()
    fits = copies.TRIANGLE_BYTES * triangles + copies.FACE_BYTES[shading] * 6 * COUNT
    for allowed, expected in ((fits, [1, 2]), (fits - 1, [1])):
        monkeypatch.setattr(copies, "MOST_BYTES", allowed)
        assert [*copied(scene(group=[shape]), rates_of(shape), shading)[1].values()] == expected
    # Rates that are chosen do not give way.
    assert copied(scene(group=[shape]), rates_of(shape), shading, lowest=3)[1] == {}


def test_few_or_too_large_instances_stay_and_large_ones_warn_with_numbers(monkeypatch):
    shape, notes = cube_shape(), StageWarnings()
    few, contents = (scene(group=[shape], count=count) for count in (LEAST_INSTANCES - 1, COUNT))
    assert copied(few) == (few, {})
    # None where the system does not report it
    for available, are_copied in ((None, True), (1, False)):
        monkeypatch.setattr(copies, "available_memory", lambda available=available: available)
        assert bool(copied(contents, rates_of(shape), notes=notes)[1]) is are_copied
    with pytest.warns(UserWarning, match=rf"copies with {6 * COUNT:,} faces .* GB, and stay {COUNT} instances"):
        notes.warn("stage")


def across(cage):
    """Normals of quadrilaterals, as long as their areas."""
    a, b, c, _ = np.moveaxis(cage.positions[cage.face_vertices].reshape(-1, 4, 3), 1, 0)
    return np.cross(b - a, c - b)


def test_copies_other_than_instances_are_merged_too():
    """With attributes, which Mitsuba looks up in the wrong place of instances."""
    kinds = {"heat": (8, "vertex"), "paint": (24, "face_varying")}
    attributes = {name: Attribute(np.arange(1.0 * count)[:, None], kind) for name, (count, kind) in kinds.items()}
    shape, mirrored, sheared = cube_shape(scheme=None, attributes=attributes), np.diag([-1.0, 1, 1, 1]), np.eye(4)
    sheared[0, 1] = 0.5
    shape = replace(shape, normals=np.repeat(across(CUBE), 4, axis=0))
    shapes = [replace(shape, to_world=(mirrored if k else np.eye(4)) @ placed(k) @ sheared) for k in range(COUNT)]
    (joined,) = copied(scene(shapes, count=0))[0].shapes
    normals, expected = joined.normals.reshape(-1, 4, 3), across(joined.cage)[:, None]
    np.testing.assert_allclose(np.cross(normals, expected), 0, atol=1e-12)
    assert ((normals * expected).sum(axis=2) > 0).all()
    heat, paint = (joined.cage.attributes[name] for name in ("heat", "paint"))
    np.testing.assert_array_equal(heat.values.ravel(), np.tile(np.arange(8.0), COUNT))
    # Faces of mirrored copies are turned over, with what their corners have.
    faces, corners = np.arange(24) // 4, zip(np.arange(24) // 4, CUBE.face_vertices, strict=True)
    at_vertices = dict(zip(corners, np.arange(24.0), strict=True))
    vertices = joined.cage.face_vertices[24:48] - 8
    values = paint.values[paint.indices[24:48], 0]
    assert [at_vertices[place] for place in zip(faces, vertices, strict=True)] == values.tolist()


def strip(faces):
    """Quadrilaterals in a row."""
    points = np.array([[k // 2, k % 2, 0.0] for k in range(2 * faces + 2)])
    corners = np.add.outer(2 * np.arange(faces), [0, 2, 3, 1])
    return CageContents(points, np.full(faces, 4), corners.ravel(), scheme="catmull_clark")


def test_large_copies_are_separate_shapes_with_a_shared_cage(monkeypatch):
    shape = ShapeContents("/strip", strip(LARGE), 2 * np.eye(4))
    contents = scene(group=[shape])
    separate = with_large_copies(contents)
    assert (separate.groups, separate.instances) == ([[]], [])
    assert [copy.name for copy in separate.shapes[:2]] == ["/i0/strip", "/i1/strip"]
    assert all(copy.cage is shape.cage for copy in separate.shapes)
    np.testing.assert_array_equal([copy.to_world for copy in separate.shapes], [2 * placed(k) for k in range(COUNT)])
    assert copied(separate) == (separate, {})
    monkeypatch.setattr(copies, "MOST_BYTES", copies.TRIANGLE_BYTES * 2 * LARGE * COUNT - 1)
    assert with_large_copies(contents) is contents
    # Nor are small ones, or few.
    small = ShapeContents("/strip", strip(LARGE - 1), np.eye(4))
    for contents in (scene(group=[small]), scene(group=[shape], count=LEAST_INSTANCES - 1)):
        assert [*with_large_copies(contents).instances] == contents.instances


DISTANCE = 10.0
# Half a level of 8 bits, and one where two roundings meet.
LEVEL = 1.01 / 255
# The depth of a flat square is known but for single precision.
ROUNDED = 1e-5
# In steps of 8-bit values. Chroma of neighbouring pixels is interpolated before a full image is halved.
JPEG_LEVELS = 4


def texture(file="a.png", **changes):
    return TextureContents(file, **{"channel": "rgb", "color_space": "sRGB", **changes})


def square(side=1.0, uv_side=1.0, to_world=None, *, has_texcoords=True):
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    texcoords = Attribute(uv_side * corners[:, :2], "vertex") if has_texcoords else None
    cage = CageContents(side * (corners - [0.5, 0.5, 0]), np.array([4]), np.arange(4), texcoords=texcoords)
    return ShapeContents("/square", cage, np.eye(4) if to_world is None else to_world)


def needed_for(*shapes, inputs, groups=(), **more):
    material = contents.MaterialContents("/m", inputs)
    shapes, *groups = ([replace(shape, material=material) for shape in part] for part in (shapes, *groups))
    return texels_for_pictures(SceneContents(shapes=shapes, groups=groups, **more), [sensor_at(DISTANCE)])


def pixels_of_unit(distance=DISTANCE):
    return WIDTH / (2 * distance * np.tan(np.radians(FOV / 2)))


@pytest.mark.parametrize("side", [0.1, 2.0])
@pytest.mark.parametrize("uv_side", [1.0, 4.0])
def test_texels_follow_from_pixels(side, uv_side):
    needed = needed_for(square(side, uv_side), inputs={"base_color": texture()})
    assert needed == {"a.png": pytest.approx(TEXELS_PER_PIXEL * pixels_of_unit() * side / uv_side, rel=ROUNDED)}


def test_results_do_not_depend_on_the_first_corner_of_a_face():
    """Every edge has its own density of texels, the one from the last corner to the first, too."""
    texcoords, shape, needed = Attribute(np.array([[0, 0], [1, 0], [0.8, 0.5], [0, 0.3]]), "vertex"), square(), []
    for turn in range(4):
        cage = replace(shape.cage, face_vertices=np.roll(np.arange(4), turn), texcoords=texcoords)
        needed.append(needed_for(replace(shape, cage=cage), inputs={"base_color": texture()})["a.png"])
    assert needed == pytest.approx([needed[0]] * 4, rel=ROUNDED)


def test_the_largest_copy_in_the_picture_decides():
    near = np.eye(4)
    near[2, 3] = -DISTANCE / 2
    copies = {"groups": [[square()]], "instances": [InstanceContents("/i", 0, near)]}
    needed = needed_for(square(), inputs={"base_color": texture()}, **copies)["a.png"]
    assert needed == pytest.approx(TEXELS_PER_PIXEL * pixels_of_unit(DISTANCE / 2), rel=ROUNDED)


def test_images_of_unknown_detail_keep_their_size():
    assert needed_for(square(has_texcoords=False), inputs={"base_color": texture()}) == {"a.png": np.inf}
    texcoord = NodeContents("texcoord", "vector2", {})
    elsewhere = NodeContents("image", "color3", {"file": texture(), "texcoord": texcoord})
    assert needed_for(square(), inputs={"base_color": elsewhere}) == {}


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 4]), st.booleans())
def test_reduced_images_have_the_same_mean_light(seed, channels, is_srgb):
    pixels = np.random.default_rng(seed).integers(0, 256, (16, 32, channels), dtype=np.uint8)
    is_srgb = is_srgb and channels >= 3
    small = reduced(pixels, 4, is_srgb=is_srgb)
    assert small.shape == (4, 8, channels)
    expected = linear(pixels, is_srgb).reshape(4, 4, 8, 4, channels).mean(axis=(1, 3))
    if is_srgb:
        color = expected[..., :3]
        expected[..., :3] = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(small / 255, expected, rtol=0, atol=LEVEL)


def linear(pixels, is_srgb):
    values = pixels / 255
    if is_srgb:
        color = values[..., :3]
        values[..., :3] = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return values


NEEDED = [(np.inf, 64), (65, 64), (33, 64), (32, 32), (17, 32), (1, 1), (0, 1)]
CASES = [((64, 128), [needed], (side, 2 * side)) for needed, side in NEEDED]
CASES += [((63, 64), [np.inf, 33], (32, 32)), ((64, 64), [np.inf, 64], (64, 64)), ((5, 3), [np.inf, 1], (1, 1))]


@pytest.mark.parametrize(("size", "limits", "expected"), CASES)
def test_images_keep_the_needed_pixels_up_to_a_limit(size, limits, expected):
    small = reduced(np.full((*size, 3), 200, dtype=np.uint8), *limits, is_srgb=True)
    assert small.shape == (*expected, 3)
    assert (small == 200).all()


def test_a_picture_that_repeats_needs_fewer_texels():
    """Where two uses of a file repeat it differently, the one that shows most of it decides."""
    often, once = (texture(to_uv=np.diag([repeats, repeats, 1.0])) for repeats in (4, 1))
    of_both = needed_for(square(), inputs={"base_color": often, "emission": once})["a.png"]
    assert of_both == pytest.approx(4 * needed_for(square(), inputs={"base_color": often})["a.png"])
    # Along u, the image of one unit is 5 long.
    slanted = texture(to_uv=np.array([[4.0, 0, 0], [3, 1, 0], [0, 0, 1]]))
    assert of_both == pytest.approx(5 * needed_for(square(), inputs={"base_color": slanted})["a.png"])


@pytest.mark.parametrize("dtype", [np.uint16, np.float16, np.float32])
@pytest.mark.parametrize("is_srgb", [True, False])
def test_images_of_other_types_are_halved_as_bytes_are(dtype, is_srgb):
    pixels = np.random.default_rng(0).integers(0, 256, (16, 8, 4), dtype=np.uint8)
    others = pixels * np.uint16(257) if dtype == np.uint16 else (pixels / 255).astype(dtype)
    small = reduced(others, 4, is_srgb=is_srgb) / (65535 if dtype == np.uint16 else 1)
    np.testing.assert_allclose(small, reduced(pixels, 4, is_srgb=is_srgb) / 255, rtol=0, atol=LEVEL)


@pytest.mark.parametrize(("channels", "space"), [(1, "auto"), (3, "auto"), (3, "raw")])
def test_jpeg_files_are_decoded_at_a_scale(tmp_path, channels, space):
    """As files that are decoded in full and halved then, but for what a scaled transform leaves out."""
    x, y = np.meshgrid(np.linspace(0, 9, 256), np.linspace(0, 5, 128))
    waves = np.stack([np.sin(x), np.cos(y), np.sin(x + y)][:channels], axis=-1)
    path = str(tmp_path / "a.jpg")
    mi.Bitmap(np.uint8(127 + 120 * waves)).write(path, quality=95)
    full = read_texture_image(path).pixels
    assert full.shape == (128, 256, channels)
    for needed in (64, 17, 8):
        small = read_texture_image(path, space, needed).pixels
        expected = reduced(full, needed, is_srgb=space == "auto" and channels == 3)
        assert small.shape == expected.shape
        np.testing.assert_allclose(small.astype(float), expected, rtol=0, atol=JPEG_LEVELS)


@pytest.mark.parametrize("name", [b"sRGB", "sRGB".encode("utf-16-be"), b"Display P3", None])
def test_sixteen_bits_are_decoded_where_the_file_names_srgb(tmp_path, name):
    """As the rule of UsdUVTexture says: by a chunk, or by the name in the colour profile."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header, rows = struct.pack(">IIBBBBB", 1, 1, 16, 2, 0, 0, 0), b"\0" + struct.pack(">HHH", 0x8000, 0x8000, 0x8000)
    profile = chunk(b"sRGB", b"\0") if name is None else chunk(b"iCCP", b"any\0\0" + zlib.compress(b"desc" + name))
    parts = [chunk(b"IHDR", header), profile, chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    path = tmp_path / "a.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    expected = 0x8000 if name == b"Display P3" else decoded(0x8000 / 65535)
    np.testing.assert_allclose(read_texture_image(str(path)).pixels, np.full((1, 1, 3), expected), rtol=1e-6)
    np.testing.assert_array_equal(read_texture_image(str(path), "raw").pixels, 0x8000)


def test_jpeg_files_of_inks_are_colours(tmp_path):
    path = str(tmp_path / "a.jpg")
    pytest.importorskip("PIL.Image").new("CMYK", (8, 8), (255, 0, 0, 0)).save(path)
    np.testing.assert_allclose(read_texture_image(path).pixels, np.broadcast_to([0, 255, 255], (8, 8, 3)), atol=2)


def test_one_file_is_read_for_each_of_its_uses(tmp_path):
    """What is halved as colours is another picture than that halved as numbers; a light needs the whole of it."""
    x, y = np.meshgrid(np.arange(64), np.arange(64))
    stripes, path = np.uint8(255 * ((x + y) % 2))[..., None].repeat(3, axis=2), str(tmp_path / "a.png")
    mi.Bitmap(stripes).write(path)
    uses = texture(path), texture(path, color_space="raw")
    for order in (uses, uses[::-1]):
        textures = Textures(StageWarnings(), {path: 8.0})
        textures.read(order)
        for use in uses:
            np.testing.assert_allclose(textures.mean(use), 0.5, rtol=0, atol=0.01)
        assert textures.radiance(path, np.ones(3)).size().x == 64


def test_a_jpeg_of_many_pixels_is_no_attack(tmp_path, monkeypatch):
    image = pytest.importorskip("PIL.Image")
    path = str(tmp_path / "a.jpg")
    mi.Bitmap(np.full((64, 64, 3), 127, np.uint8)).write(path)
    monkeypatch.setattr(image, "MAX_IMAGE_PIXELS", 100)
    assert read_texture_image(path, "sRGB", 8).pixels.shape == (8, 8, 3)


def test_two_components_are_red_and_green(monkeypatch):
    values = np.random.default_rng(1).random((4, 4, 2)).astype(np.float32)
    monkeypatch.setattr("mitsuba_usd.textures.baked", lambda *_: (values, np.eye(3), "repeat"))
    given = NodeContents("texcoord", "vector2", {"name": "st"})
    color = np.array(Textures(StageWarnings()).color(given)["bitmap"])
    np.testing.assert_array_equal(color, np.pad(values, ((0, 0), (0, 0), (0, 1))))


def test_tiles_are_read_smaller_each(tmp_path):
    for number in (1001, 1002):
        mi.Bitmap(np.full((64, 64, 3), number - 1000, np.uint8)).write(str(tmp_path / f"a.{number}.png"))
    for limits, shape in (([20], (32, 64, 3)), ([20, 16], (16, 32, 3))):
        assert read_texture_image(str(tmp_path / "a.<UDIM>.png"), "raw", *limits).pixels.shape == shape
