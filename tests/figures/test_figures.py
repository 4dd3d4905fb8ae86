"""Every figure draws, and the numbers in them are those of the surfaces."""

import csv
import hashlib
import json
import re
import warnings
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import CageWarning, ControlCage, LimitSurface, __version__, example_file
from mitsuba_subdivision.__main__ import parser
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.figures import (
    FIGURES,
    FigureError,
    FigureOptions,
    cages,
    characteristic,
    fit,
    normal_error,
    peers,
    scenes,
    staging,
)
from mitsuba_subdivision.figures.output import rows_of, write_figure
from mitsuba_subdivision.figures.staging import around_vertices, frame, load_stage, motion, project, visible
from mitsuba_subdivision.mitsuba_mesh import points_at
from mitsuba_subdivision.regression.image import read_channels
from mitsuba_subdivision.schemes import scheme_named
from patches.closed_cages import extraordinary_triangles, torus
from PIL import Image
from scipy.spatial import cKDTree

# Small enough that all together take seconds.
RESOLUTION, SPP = 12, 1
# These are one picture, wider than those that share a figure, without text.
STAND_ALONE = ("hero", "displacement")
# The narrowest figures in millimetres, and points of their smallest text, indices and exponents included.
COLUMN, LEAST_TEXT = 84, 6


@pytest.fixture
def options(tmp_path):
    return lambda **other: FigureOptions(tmp_path, **{"resolution": RESOLUTION, "spp": SPP, **other})


@pytest.fixture
def coarse(monkeypatch, few_pixels):  # noqa: ARG001
    """Figures without the pixels, triangles and steps that a printer needs: most of the time goes into these."""
    monkeypatch.setitem(write_figure.__kwdefaults__, "layouts", 1)
    constants = {
        "cages": {"CREASE_RATE": 3},
        "normal_error": {"VALENCES": (3,), "OFFSETS": (0,), "LEVELS": np.arange(3), "TURNS": normal_error.TURNS[:2]},
        "scenes": {"COLUMNS": 96, "ROWS": 96},
        "zebra": {"FINE_LEVEL": 3, "OWN_LEVEL": 3, "STRIPE_PIXELS": 256},
        "fit": {"STEPS": 2, "CREASE_STEPS": 1, "RATE": 4, "PIXELS": 12, "BOX_PIXELS": 12, "VIEWS": 2, "SPP": 1}
        | {"TARGET_SPP": 1, "SAMPLES": 500, "FINE": 3, "DENSE": 3},
    }
    for module, values in constants.items():
        for name, value in values.items():
            monkeypatch.setattr(f"mitsuba_subdivision.figures.{module}.{name}", value)


def test_command_line_and_table_list_every_figure():
    for name in (*FIGURES, "all"):
        assert parser().parse_args(["figure", name]).name == name
    paths = Path(peers.__file__).parent.glob("*.py")
    pattern = re.compile(r"^def draw_(\w+)\(options: FigureOptions\)", re.MULTILINE)
    functions = {(path.stem, name) for path in paths for name in pattern.findall(path.read_text())}
    assert {(figure.module, name) for name, figure in FIGURES.items()} == functions


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("width", [84, 178])
def test_all_panels_have_a_place(tmp_path, width, count):
    assert 0 <= np.prod(rows_of(FigureOptions(tmp_path, width=width), count)) - count < 2


def test_figures_of_users_do_not_change_a_checkout():
    """The first command of the README draws to a folder that git ignores, as long as nobody names another one."""
    output = parser().parse_args(["figure", "artifact"]).output
    root = Path(__file__).resolve().parents[2]
    assert f"{output.as_posix()}/" in (root / ".gitignore").read_text(encoding="utf-8").splitlines()
    assert f"`{output.as_posix()}/`" in (root / "README.md").read_text(encoding="utf-8")


# One function renders the pictures of all figures, and one writes their plots: these figures are drawn twice.
RENDERED_TWICE, WRITTEN_TWICE = "shading", "refinement"


@pytest.mark.usefixtures("variant_llvm_ad_rgb", "coarse")
@pytest.mark.parametrize("name", FIGURES)
def test_figures_are_drawn_without_warnings_and_fit_for_print(name, options):
    """In a column, where its PDF has text of 6 points, embedded fonts and the pixels that were rendered."""
    figure = FIGURES[name]

    def drawn(formats):
        files = figure(options(formats=formats, width=COLUMN))
        return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}

    first = drawn(figure.formats)
    files = {f"{name}.{suffix}" for suffix in figure.formats}
    assert set(first) == {path.name for path in options().output.iterdir()} == files
    again = {RENDERED_TWICE: ("exr",), WRITTEN_TWICE: figure.formats}.get(name, ())
    if again:
        assert drawn(again).items() <= first.items()
    page = pytest.importorskip("pypdf").PdfReader(options().output / f"{name}.pdf").pages[0]
    assert float(page.mediabox.width) == pytest.approx(COLUMN / 25.4 * 72)
    sizes = []
    page.extract_text(visitor_text=lambda text, _cm, _tm, _font, size: sizes.append(size) if text.strip() else None)
    assert bool(sizes) == (name not in STAND_ALONE)
    assert min(sizes, default=LEAST_TEXT) >= LEAST_TEXT
    for font in page["/Resources"]["/Font"].values():
        assert "/FontFile2" in font.get("/DescendantFonts", [font])[0]["/FontDescriptor"]
    if "exr" in figure.formats:
        expected = round(2.25 * RESOLUTION) if name in STAND_ALONE else RESOLUTION
        assert max(image.image.width for image in page.images) == expected


@pytest.fixture
def users_cage(tmp_path):
    """A bent box with two creases, far from the origin and not of the size of any figure."""
    positions = 30 * cube().positions * [1, 0.7, 1.5] + [50, -20, 10] + np.random.default_rng(3).normal(size=(8, 3))
    faces = cube().face_vertices.reshape(-1, 4)
    ControlCage(positions, faces, creases=[[*cube().edges[0], 2.5], [*cube().edges[1], 10]]).save(tmp_path / "own.obj")
    return tmp_path / "own.obj"


def test_cages_around_a_vertex_have_it_first_and_at_the_given_place(users_cage):
    ((name, cage),) = around_vertices(users_cage, 3).items()
    assert (name, cage.topology.vertex_face_count[0]) == ("valence 3", 3)
    assert cage.face_vertices.reshape(-1, 4)[:3, 0].tolist() == [0] * 3
    assert len(cage.holes) < cage.face_count
    # It is the refined cage where that lies, in another order.
    original = ControlCage.from_file(users_cage)
    while original.face_count < cage.face_count:
        original = original.refined()
    np.testing.assert_array_equal(*(np.sort(each.positions, axis=0) for each in (cage, original)))
    like = frame(LimitSurface(extraordinary(5)))
    placed = cage.with_positions(points_at(cage.positions, motion(frame(LimitSurface(cage)), like)))
    for result, expected in zip(frame(LimitSurface(placed)), like, strict=True):
        np.testing.assert_allclose(result, expected, atol=1e-9)


def test_centres_of_faces_count_only_if_a_cage_has_no_other_extraordinary_vertex(tmp_path):
    ends = np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    of_cages = {"valence 6, valence 7": extraordinary_triangles(7), "centre of a face of 3": ControlCage(ends, faces)}
    for expected, cage in of_cages.items():
        cage.save(tmp_path / "own.obj")
        assert ", ".join(around_vertices(tmp_path / "own.obj", 2)) == expected


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_the_whole_cage_is_in_the_picture_of_creases():
    sensor = load_stage("creases", width=20, height=31).sensors()[0]
    for shape in ([1, 1, 1], [9, 1, 1], [1, 9, 0.1], [0.1, 0.1, 9]):
        shown = staging.in_view(cube().with_positions(7 + cube().positions * shape), sensor)
        x, y = project(sensor, shown.positions).T
        assert min(x.min(), y.min(), 20 - x.max(), 31 - y.max()) > 0
        # It fills the picture in one direction, but for the margin and a step of its sizes.
        assert max(np.ptp(x) / 20, np.ptp(y) / 31) > 0.4
        assert shown.positions[:, 2].min() == 0


@pytest.mark.usefixtures("variant_llvm_ad_rgb", "coarse")
@pytest.mark.parametrize("name", ["artifact", "error", "creases", "subdivision", "curvature", "zebra"])
def test_figures_take_cages_of_users(name, options, users_cage):
    (path,) = FIGURES[name](options(formats=("png",), cage=users_cage))
    first = np.array(Image.open(path))
    FIGURES[name](options(formats=("png",)))
    assert not np.array_equal(np.array(Image.open(path)), first)


def test_figures_contain_version_command_and_cage(variant_llvm_ad_rgb, coarse, options, users_cage, monkeypatch):  # noqa: ARG001
    pypdf = pytest.importorskip("pypdf")
    monkeypatch.chdir(users_cage.parent)
    paths = FIGURES["subdivision"](options(cage=Path("own.obj"), width=COLUMN))
    command = "mitsuba-subdivision figure subdivision --width 84mm --resolution 12 --cage own.obj --spp 1"
    expected = [
        f"mitsuba-subdivision {__version__}",
        f"{command} --variant llvm_ad_rgb",
        f"own.obj, SHA-256 {hashlib.sha256(users_cage.read_bytes()).hexdigest()}",
    ]
    with Image.open(paths[0]) as image:
        assert [image.info[key] for key in ("Software", "Description", "Source")] == expected
    information = pypdf.PdfReader(paths[1]).metadata
    assert [information[f"/{key}"] for key in ("Creator", "Subject", "Keywords")] == expected
    metadata = read_channels(paths[2])[1]
    assert [metadata[key] for key in ("version", "command", "cage")] == expected
    assert parser().parse_args(metadata["command"].split()[1:]).cage == Path("own.obj")


@pytest.mark.usefixtures("variant_llvm_ad_rgb", "coarse")
def test_numbers_of_curvature_are_in_the_units_of_the_cage(options, users_cage, tmp_path):
    """Of a cage ten times as large, curvature is a tenth, and a figure of one vertex is no tall page."""
    cage = ControlCage.from_file(users_cage)
    cage.with_positions(10 * cage.positions).save(tmp_path / "large.obj")
    columns = []
    for path in (users_cage, tmp_path / "large.obj"):
        png, table = FIGURES["curvature"](options(formats=("png", "csv"), cage=path))
        with table.open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file))
        assert [(line["vertex"], int(line["level"])) for line in lines] == [("valence 3", n) for n in range(41)]
        columns.append([float(line["largest curvature"]) for line in lines])
        with Image.open(png) as image:
            assert image.height < image.width
    np.testing.assert_allclose(columns[0], 10 * np.array(columns[1]), rtol=1e-6)


@pytest.mark.usefixtures("variant_llvm_ad_rgb", "coarse")
def test_a_cage_causes_its_warning_once(options, tmp_path):
    """Two cubes that share a corner: no manifold there."""
    faces = cube().face_vertices.reshape(-1, 4)
    shared = np.array([7, *range(8, 15)])
    with pytest.warns(CageWarning, match="no manifold"):
        cage = ControlCage([*cube().positions, *(cube().positions[1:] + 2)], [*faces, *shared[faces]])
    cage.save(tmp_path / "own.obj")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for name in ("subdivision", "curvature", "error"):
            FIGURES[name](options(formats=("png",), cage=tmp_path / "own.obj"))
    (warning,) = (w for w in caught if issubclass(w.category, CageWarning))
    assert "own.obj" in str(warning.message)


@pytest.mark.usefixtures("variant_llvm_ad_rgb", "coarse")
def test_unsuitable_cages_for_figures_are_errors(options, tmp_path):
    torus(5, 4).save(tmp_path / "torus.obj")
    # A regular cage is suitable for this one, and so is a vertex that no face uses.
    assert FIGURES["subdivision"](options(formats=("png",), cage=tmp_path / "torus.obj"))
    (tmp_path / "unused.obj").write_text("v 9 9 9\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 2 3 4 5\n")
    with pytest.warns(CageWarning, match="1 of 5 vertices are used by no face"):
        assert FIGURES["subdivision"](options(formats=("png",), cage=tmp_path / "unused.obj"))
    for name, message in (("error", "no extraordinary vertex"), ("creases", "no creases")):
        with pytest.raises(FigureError, match=f'torus.obj" has {message}'):
            FIGURES[name](options(cage=tmp_path / "torus.obj"))


@pytest.mark.usefixtures("variant_scalar_rgb", "coarse")
def test_scalar_variants_draw_too_all_but_fits(options):
    """So do `artifact` and `creases`, by commands of the README and of the guide."""
    for name in ("subdivision", "zebra", "displacement"):
        assert len(FIGURES[name](options(formats=("png",)))) == 1
    with pytest.raises(FigureError, match="variant scalar_rgb; expected one with derivatives"):
        FIGURES["fit"](options())


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_the_distance_of_spheres_is_the_difference_of_their_radii():
    """But for gaps between samples."""
    inner, outer = (fit.ball_cage(4, radius) for radius in (0.5, 0.6))
    assert fit.distances(outer, [inner])[0] * fit.DIAGONAL == pytest.approx(0.1, rel=0.03)


def test_numbers_are_on_visible_edges():
    hidden = cube().positions[cube().edges[~fit.in_front(cube(), np.array([5.0, -6, 4]))]]
    # Those that meet in the corner across.
    assert len(hidden) == 3
    assert (hidden == [-1, 1, -1]).all(axis=2).any(axis=1).all()
    assert fit.in_front(cube(), np.array([5.0, 0, 0])).sum() == 4


@pytest.fixture
def no_programs(monkeypatch, tmp_path):
    monkeypatch.delenv(peers.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "none"))
    monkeypatch.setenv("PATH", str(tmp_path / "none"))


@pytest.fixture
def answering(tmp_path):
    """Function that writes a program of the shell, and returns its path.

    With data to answer, it copies what it is asked to a file `asked`.
    """

    def write(name, text, answers=None):
        program = tmp_path / name
        if answers is not None:
            (tmp_path / "answers").write_bytes(answers)
            text += f'\ncp "$1" {tmp_path}/asked; cp {tmp_path}/answers "$2"'
        program.write_text(f"#!/bin/sh\n{text}\n")
        program.chmod(0o755)
        return program

    return write


@pytest.mark.usefixtures("variant_llvm_ad_rgb", "coarse", "no_programs")
def test_missing_programs_are_omitted_from_figures_with_a_message(options, capsys):
    for name, pictures in (("zebra", (2, 1)), ("zoom", (4, 2))):
        (path,) = FIGURES[name](options(formats=("exr",)))
        height, width = read_channels(path)[0]["R"].shape
        assert (width, height) == tuple(RESOLUTION * count for count in pictures)
        assert 'no program "osd_peer"' in capsys.readouterr().err


def test_each_panel_of_creases_has_its_tags():
    cage = ControlCage.from_file(example_file("cages/rook.obj"))
    smooth, tagged, infinite = (cages._tagged(cage, name).tags.edges for name in cages.TITLES)
    assert not smooth.any()
    assert tagged is cage.tags.edges
    assert np.array_equal(infinite, np.where(tagged > 0, cages.INFINITE, 0))
    # The legend tells every sharpness there is.
    assert set(tagged[tagged > 0]) == {1.2, 1.5, 2, 3, 4, 10}
    assert list(cages.labels(tagged).values()) == ["1.2\u20132", "3\u20134", "∞"]


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_the_displaced_jar_has_no_step_at_its_seam_and_plain_ends():
    heights = scenes.quilt()
    assert heights.shape == (scenes.ROWS, scenes.COLUMNS)
    # The last column is as near to the first one as any two neighbours.
    assert np.abs(heights[:, 0] - heights[:, -1]).max() <= 1.01 * np.abs(np.diff(heights, axis=1)).max()
    along = (np.arange(scenes.ROWS) + 0.5) / scenes.ROWS
    assert not heights[(along < scenes.LOWEST) | (along > scenes.HIGHEST)].any()
    assert 0.9 < heights.max() <= 1
    assert set(ControlCage.from_file(example_file("cages/jar.obj")).tags.edges) == {0, 10}


@pytest.mark.core
@pytest.mark.parametrize("valence", [3, 5, 8])
def test_a_refinement_step_has_the_points_of_the_report(valence):
    patch = characteristic.patch_of_valence(scheme_named("catmull_clark"), valence)
    old, new, old_edges, new_edges = characteristic.refinement_step(patch, valence)
    assert len(old) == 2 * valence + 8
    assert len(new) == 2 * valence + 17
    # Neither set has two points in one place, and every new point has an edge.
    for points, edges in ((old, old_edges), (new, new_edges)):
        assert len(np.unique(points.round(6), axis=0)) == len(points)
        assert len(np.unique(edges.reshape(-1, 2).round(6), axis=0)) == len(points)


@pytest.mark.core
def test_the_characteristic_map_scales_by_the_subdominant_eigenvalue():
    for name in ("catmull_clark", "loop", "doo_sabin"):
        scheme = scheme_named(name)
        patch = characteristic.patch_of_valence(scheme, 5)
        points = characteristic.characteristic_points(patch, 5)
        image = partial(characteristic.on_patch, scheme, patch.signature, points)
        first, third = (image(characteristic.sub_domain(scheme.domain, level, 2)) for level in (0, 2))
        np.testing.assert_allclose(third, patch.basis.subdominant**2 * first, atol=1e-12)
        # One sector ends where the next begins.
        edge = np.array([(0.0, 0.7), (0.7, 0.0)])
        np.testing.assert_allclose(image(edge[:1]), characteristic.sector(image(edge[1:]), 1, 5), atol=1e-12)


def test_subdivision_keeps_the_number_of_extraordinary_points():
    cage = ControlCage.from_file(example_file("cages/propeller.obj"))
    assert set(cage.face_sizes) == {3, 4, 5, 6}
    shares = []
    for _ in range(3):
        surface = LimitSurface(cage)
        assert cages.extraordinary_count(cage.topology) == 20
        shares.append(cages.area_share(surface, cages.regular_elements(surface)))
        cage = cage.refined()
    assert shares[0] == 0 < shares[1] < shares[2] < 1
    # Every irregular patch of level 2 has one extraordinary vertex: as many as the vertices have corners.
    valences = surface.cage.topology.vertex_face_count
    assert (~cages.regular_elements(surface)).sum() == valences[valences != 4].sum()


@pytest.mark.usefixtures("variants_all_rgb")
def test_projected_points_are_where_pictures_show_them():
    to_world = mi.ScalarTransform4f().look_at([3, -4, 5], [0, 0, 0], [0, 0, 1])
    place = np.array([0.3, -0.2, 0.4])
    twice = to_world @ mi.ScalarTransform4f().scale(2)
    for sensor, transform in (({"type": "perspective", "fov": 30}, to_world), ({"type": "orthographic"}, twice)):
        film = {"type": "hdrfilm", "width": 64, "height": 64, "pixel_format": "rgba", "rfilter": {"type": "box"}}
        ball = {"type": "sphere", "center": place.tolist(), "radius": 0.1}
        light, integrator = {"type": "constant"}, {"type": "direct", "hide_emitters": True}
        sensor |= {"to_world": transform, "film": film}
        scene = mi.load_dict({"type": "scene", "i": integrator, "light": light, "sensor": sensor, "ball": ball})
        alpha = np.array(mi.render(scene, spp=64), dtype=np.float64)[..., 3]
        y, x = np.indices(alpha.shape) + 0.5
        centre = np.array([(alpha * x).sum(), (alpha * y).sum()]) / alpha.sum()
        np.testing.assert_allclose(project(scene.sensors()[0], place[None])[0], centre, atol=0.1)
    towards = np.array([3, -4, 5]) / np.sqrt(50)
    assert visible(scene, place + 0.1 * np.stack([towards, -towards])).tolist() == [True, False]


@pytest.mark.parametrize("valence", [3, 5, 8])
def test_curvature_grows_as_the_eigenvalues_say(valence):
    largest = characteristic.largest_by_level(characteristic.bent_ball(valence), valence)
    assert (largest[-1] / largest[-5]) ** (1 / 4) == pytest.approx(characteristic.growth(valence), abs=0.02)


def test_zoom_shows_the_errors_of_its_magnification(variant_llvm_ad_rgb):  # noqa: ARG001
    surface = LimitSurface(normal_error.offset_cage(extraordinary(normal_error.ZOOM_VALENCE), normal_error.ZOOM_OFFSET))
    for magnification, wrong in ((1, 1e-2), (1_000_000, 10)):
        samples = normal_error.panel_samples(surface, magnification, 8)
        # The elements at the point cover the picture, at every magnification.
        assert np.abs(samples[1][:, -1, :2]).max(axis=1).min() > 0.9
        stam, stabilised = (normal_error.normals_by(surface, samples, name)[2] for name in ("stam", "stabilized"))
        assert stabilised < 1e-4
        assert (stam > wrong) == (magnification > 1)


@pytest.mark.posix
@pytest.mark.parametrize("name", ["osd_peer", "blender"])
@pytest.mark.usefixtures("no_programs")
def test_programs_are_found_where_the_user_says(name, tmp_path, monkeypatch, answering):
    assert getattr(peers, name)() is None
    program = answering(name, "exit 0")
    monkeypatch.setenv(peers.VARIABLE, str(tmp_path))
    assert getattr(peers, name)() == program


@pytest.mark.posix
def test_failing_programs_report_the_reason(answering):
    with pytest.raises(FigureError, match="osd_peer fails: no such cage"):
        peers.osd_samples(answering("osd_peer", "echo no such cage >&2; exit 1"), cube(), 0, [[0.0, 0.0]], "far", 2)
    for text in ("echo no such module >&2; exit 1", "echo no such module >&2"):
        with pytest.raises(FigureError, match="blender fails: no such module"):
            peers.blender_mesh(answering("blender", text), cube(), 2)


@pytest.mark.posix
def test_opensubdivs_samples_are_its_answers(tmp_path, answering):
    answers = {"p": [1.0, 2, 3, 4, 5, 6], "du": [2.0, 0, 0, 0, 0, 0], "dv": [0, 3.0, 0, 1, 0, 0]}
    answers = peers.as_bytes({name: np.array(values) for name, values in answers.items()})
    points, normals = peers.osd_samples(answering("osd_peer", "", answers), cube(), 3, [[0.5, 0.25], [1, 0]], "far", 2)
    assert np.array_equal(points, [[1, 2, 3], [4, 5, 6]])
    # Where a derivative vanishes there is no normal.
    assert np.array_equal(normals, [[0, 0, 1], [np.nan] * 3], equal_nan=True)
    asked = peers.from_bytes((tmp_path / "asked").read_bytes())
    assert np.array_equal(asked["face"], [3, 3])
    assert np.array_equal(asked["uv"], [0.5, 0.25, 1, 0])
    assert np.array_equal(asked["values"], cube().positions.ravel())


@pytest.mark.posix
def test_blenders_mesh_is_its_answer(tmp_path, answering):
    points, normals = np.arange(12.0), np.tile([0.0, 0, 1], 4)
    answers = {"p": points.tolist(), "n": normals.tolist(), "corners": [0, 1, 2, 3], "version": [3, 4, 1]}
    # The last three words are both files and the level.
    said = f'while [ $# -gt 3 ]; do echo "$1"; shift; done > {tmp_path}/words; echo "$3" >> {tmp_path}/words'
    result = peers.blender_mesh(answering("blender", said, json.dumps(answers).encode()), cube(), 5)
    assert np.array_equal(result[0], points.reshape(4, 3))
    assert np.array_equal(result[1], normals.reshape(4, 3))
    assert (result[2].tolist(), result[3]) == ([[0, 1, 2, 3]], "3.4")
    words = (tmp_path / "words").read_text().split()
    assert "--background" in words
    assert words[-3:] == [str(peers.BLENDER_SCRIPT), "--", "5"]
    asked = json.loads((tmp_path / "asked").read_text())
    assert np.array_equal(asked["positions"], cube().positions)
    assert np.array_equal(asked["corners"], cube().face_vertices)


def test_blender_has_the_cage_on_its_limit_surface():
    if peers.blender() is None:
        pytest.skip("no program blender")
    level = 4
    positions, normals, quads, _ = peers.blender_mesh(peers.blender(), cube(), level)
    exact = LimitSurface(cube()).tessellate(2**level)
    distance, nearest = cKDTree(exact.positions).query(positions)
    assert len(quads) == 6 * 4**level
    # Each has a point of its own; Blender approximates near the corners (measured: 6e-3 of the half edge).
    assert len(np.unique(nearest)) == len(positions)
    assert distance.max() < 0.01
    cosine = (normals * exact.normals[nearest]).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.5
