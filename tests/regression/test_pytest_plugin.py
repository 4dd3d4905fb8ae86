import json
import os
from pathlib import Path

import flip_evaluator  # noqa: F401
import matplotlib.pyplot  # noqa: F401
import mitsuba as mi
import numpy.fft  # noqa: F401
import PIL.PngImagePlugin  # noqa: F401
import pytest
import scipy.ndimage  # noqa: F401
from mitsuba_subdivision import variants
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.regression import fixture, renders, report  # noqa: F401
from mitsuba_subdivision.regression.image import load_image

pytest_plugins = ["pytester"]

SCENE = (Path(__file__).parents[1] / "data" / "ball.xml").read_text()
TEST = """
def test_ball(render_regression):
    render_regression("ball.xml", spp=32, reference_spp=512, batch=16, variant="scalar_rgb")
"""


@pytest.fixture(autouse=True, scope="module")
def loaded():
    """Load all modules first: pytester forgets what is imported in its runs, and compiled ones load only once."""
    mi.set_variant("scalar_rgb")


@pytest.fixture
def project(pytester, monkeypatch):
    # Of its pictures see `test_report`.
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)
    pytester.makefile(".xml", ball=SCENE)
    pytester.makepyfile(TEST)
    # Hypothesis would be imported again, and its asserts rewritten, in every run.
    folders = "render_references = references\nrender_results = failures"
    pytester.makeini(f"[pytest]\n{folders}\naddopts = -p no:hypothesispytest\n")
    return pytester


def failing(project, *options):
    result = project.runpytest(*options)
    result.assert_outcomes(failed=1)
    return result


@pytest.fixture(scope="module")
def written():
    """Bytes of the reference, which are made once."""
    return []


@pytest.fixture
def with_reference(project, written):
    path = reference(project)
    if not written:
        project.runpytest("--render-update-all").assert_outcomes(passed=1)
        written.append(path.read_bytes())
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(written[0])
    return project


def make_brighter(project):
    project.makefile(".xml", ball=SCENE.replace('"0.5"', '"0.6"'))


def reference(project):
    return project.path / "references" / "ball.exr"


def test_the_command_of_a_reference_gives_the_same_bytes(with_reference, monkeypatch):
    path = reference(with_reference)
    written, command = path.read_bytes(), load_image(path).metadata["command"]
    path.unlink()
    monkeypatch.chdir(path.parent)
    assert main(command.split()[1:]) == 0
    assert path.read_bytes() == written


def test_update_writes_references_that_are_missing_or_damaged_or_of_another_size(project):
    path = reference(project)

    def update(problem):
        existed = path.exists()
        failing(project).stdout.fnmatch_lines([problem])
        assert path.exists() == existed
        failing(project, "--render-update")
        project.runpytest().assert_outcomes(passed=1)

    update("there is no reference*ball.exr*make it with: pytest *::test_ball --render-update")
    path.write_bytes(path.read_bytes()[:-100])
    update("*ball.exr* is truncated, or damaged; make it with: pytest *")
    project.makefile(".xml", ball=SCENE.replace('"16"', '"12"'))
    update("*12 x 12 pixels*16 x 16;*")


def test_failures_are_printed_once_even_without_a_writable_folder(with_reference):
    make_brighter(with_reference)
    (with_reference.path / "failures").write_text("a file")
    result = failing(with_reference)
    result.stdout.fnmatch_lines(["*no report: *failures*"])
    # Where the variable CI is set, pytest repeats the message in its summary.
    lines = [line for line in result.outlines if "same samples, but" in line and not line.startswith("FAILED")]
    assert len(lines) == 1 + ("CI" in os.environ)


def test_a_difference_fails_with_a_report_and_update_writes_only_differences(with_reference):
    before = reference(with_reference).read_bytes()
    with_reference.runpytest("--render-update").assert_outcomes(passed=1)
    assert reference(with_reference).read_bytes() == before
    make_brighter(with_reference)
    lines = ["*paired *fail*same samples*", "*changed since the reference was made: ball.xml*"]
    failing(with_reference).stdout.fnmatch_lines([*lines, "*worst pixel*of shape 0*", "*report: *index.html*"])
    (folder,) = [path for path in (with_reference.path / "failures").iterdir() if path.is_dir()]
    assert {path.name for path in folder.iterdir()} == {"index.html", "comparison.json", "maps.exr", "test.exr"}
    assert json.loads((folder / "comparison.json").read_text())["status"] == "fail"
    assert folder.name in (with_reference.path / "failures" / "index.html").read_text()
    told = failing(with_reference, "--render-update", "--render-report=none").stdout
    told.fnmatch_lines(["*wrote the reference*again*"])
    with_reference.runpytest().assert_outcomes(passed=1)


def test_options_place_results_and_reports(with_reference):
    with_reference.runpytest("--render-results=elsewhere").assert_outcomes(passed=1)
    assert not (with_reference.path / "elsewhere").exists()
    with_reference.runpytest("--render-results=elsewhere", "--render-report=all").assert_outcomes(passed=1)
    assert (with_reference.path / "elsewhere" / "index.html").exists()
    make_brighter(with_reference)
    failing(with_reference, "--render-report=none")
    assert not (with_reference.path / "failures").exists()


def test_samples_are_scaled_and_other_parameters_than_the_reference_are_an_error(with_reference):
    with_reference.runpytest("--render-spp-scale=4", "--render-report=all").assert_outcomes(passed=1)
    (path,) = with_reference.path.glob("failures/*/comparison.json")
    assert json.loads(path.read_text())["tiers"]["tile"]["samples"] == 4 * 32
    assert with_reference.runpytest("--render-spp-scale=0").ret == pytest.ExitCode.USAGE_ERROR
    with_reference.makepyfile(TEST.replace("spp=32", "spp=32, parameters={'albedo': 0.6}, name='ball'"))
    told = "*was made with parameters {} and sensor 0; this test has parameters {'albedo': '0.6'} and sensor 0*"
    failing(with_reference).stdout.fnmatch_lines([told])


SETTINGS = 'spp=4, reference_spp=64, batch=16, variant="scalar_rgb"'
LENS = SCENE[SCENE.index("    <sensor") : SCENE.index("</sensor>") + len("</sensor>")]


def test_references_are_named_by_path_parameters_and_sensor_and_old_names_work(with_reference):
    """Two scenes of one file name, one scene with two values, and its second sensor: of four tests, none shares one."""
    old = reference(with_reference).read_bytes()
    for folder, albedo in (("red", "0.3"), ("blue", "0.8")):
        with_reference.mkdir(folder)
        two = SCENE.replace('"0.5"', f'"{albedo}"').replace(LENS, LENS + LENS.replace("<sensor", '<sensor id="b"'))
        (with_reference.path / folder / "ball.xml").write_text(two)
    with_reference.makepyfile(
        TEST
        + f"""
def test_others(render_regression):
    for scene, options in (("red/ball.xml", {{}}), ("blue/ball.xml", {{}}),
                           ("red/ball.xml", {{"parameters": {{"albedo": "0.4"}}}}), ("red/ball.xml", {{"sensor": 1}})):
        render_regression(scene, {SETTINGS}, **options)
"""
    )
    with_reference.runpytest("--render-update-all", "-k", "others").assert_outcomes(passed=1, deselected=1)
    written = {str(path.relative_to(with_reference.path)) for path in with_reference.path.rglob("*.exr")}
    expected = {"ball", "red/ball", "blue/ball", "red/ball-albedo=0.4", "red/ball-sensor=1"}
    assert written == {f"references/{name}.exr" for name in expected}
    result = with_reference.runpytest("-W", "default")
    result.assert_outcomes(passed=2, warnings=3)
    result.stdout.fnmatch_lines(["*sensor 0 of 2 was compared; sensor=1 compares another*"])
    assert reference(with_reference).read_bytes() == old
    result = with_reference.runpytest("--render-update", "-k", "test_ball")
    result.stdout.fnmatch_lines(["*references that no test of this run used*", "*blue*ball.exr"])
    # One name for two scenes: both are told, in one run and in two.
    both = f"render_regression(scene, name='both', {SETTINGS})"
    with_reference.makepyfile(f"""
def test_red(render_regression): scene = "red/ball.xml"; {both}
def test_blue(render_regression): scene = "blue/ball.xml"; {both}
""")
    result = with_reference.runpytest("--render-update-all")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(['*reference of "red*ball.xml" in *test_red, and of "blue*ball.xml" here; *name=..*'])
    told = failing(with_reference, "--render-update", "-k", "blue").stdout
    told.fnmatch_lines(["*is the reference of *red*ball.xml*, this test renders *blue*ball.xml*"])


def test_undecided_comparisons_are_in_warnings_summary_and_junit(with_reference, monkeypatch):
    monkeypatch.setattr(variants, "_processor", lambda: "another")
    with_reference.makefile(".xml", ball=SCENE.replace('"0.5"', '"0.50002"'))
    result = with_reference.runpytest("--junitxml=junit.xml", "-W", "default")
    result.assert_outcomes(passed=1, warnings=1)
    # Too little, beside the errors of single precision.
    told = "*paired: same samples, but *processor another here*the tile tier decides instead*"
    result.stdout.fnmatch_lines(["*warnings summary*", told, "*render differences: not decided*", told])
    assert "processor another here" in (with_reference.path / "junit.xml").read_text()
    # A change is a failure in spite of that.
    with_reference.makefile(".xml", ball=SCENE.replace('"0.5"', '"0.505"'))
    failing(with_reference).stdout.fnmatch_lines(["*tile *fail*", "*compared all samples of the reference*"])


def test_wrong_files_are_one_line_errors_before_rendering(with_reference, monkeypatch):
    def told(line, *options):
        result = failing(with_reference, *options)
        result.stdout.fnmatch_lines([line])
        assert "Traceback" not in str(result.stdout)
        assert "During handling" not in str(result.stdout)

    path, whole = reference(with_reference), reference(with_reference).read_bytes()
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    told("*ball.exr* is a pointer of git-lfs *: git lfs pull")
    pointer = path.read_bytes()
    told("*git lfs pull*", "--render-update")
    assert path.read_bytes() == pointer
    path.write_bytes(whole)
    with_reference.makefile(".xml", ball=SCENE.replace('type="sphere"', 'type="spheer"'))
    told("At *ball.xml (line 9, *): failed to instantiate*spheer*")
    (with_reference.path / "ball.xml").unlink()
    told("scene * is not a file in *")
    # The test's folder is where its scene is, wherever pytest runs.
    (with_reference.path / "ball.xml").write_text(SCENE)
    with_reference.mkdir("elsewhere")
    monkeypatch.chdir(with_reference.path / "elsewhere")
    with_reference.runpytest("..").assert_outcomes(passed=1)
    monkeypatch.setattr(renders, "render_pass", None)
    elsewhere = "-o", "render_references=/proc/references", ".."
    told('folder "/proc/references" cannot be made*', "--render-update-all", *elsewhere)
    monkeypatch.setattr(fixture, "imported_too_late", lambda: True)
    with_reference.makepyfile(TEST.replace("scalar_rgb", "llvm_ad_rgb"))
    told('*add "import mitsuba_subdivision" above the first "import mitsuba"*', "..")


def test_the_pictures_of_a_failed_run_are_accepted_by_one_command(with_reference, monkeypatch, capsys):
    monkeypatch.chdir(with_reference.path)
    command = ["accept", "failures"]
    assert main(command) == 3
    assert "there is no report of a failed test in failures" in capsys.readouterr().err
    make_brighter(with_reference)
    failing(with_reference)
    assert main(command) == 0
    with_reference.runpytest("-W", "error").assert_outcomes(passed=1)
    # A test that passes takes its report away.
    assert not [path for path in (with_reference.path / "failures").rglob("*") if path.is_file()]
    samples = load_image(reference(with_reference)).metadata["sampling"]
    assert (samples["batches"], samples["batch"]) == ([[0, 32]], 16)
    accepted = reference(with_reference).read_bytes()
    with_reference.makefile(".xml", ball=SCENE)
    failing(with_reference)
    make_brighter(with_reference)
    assert main(command) == 3
    assert "has changed since the report" in capsys.readouterr().err
    assert reference(with_reference).read_bytes() == accepted


def test_scenes_of_any_kind_and_wrong_ones(project):
    project.makepyfile(
        """
        import mitsuba as mi, pytest

        def scene(albedo):
            film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
            ball = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": albedo}}
            camera = mi.ScalarTransform4f().look_at([0, -4, 1], [0, 0, 0], [0, 0, 1])
            return {"type": "scene", "i": {"type": "direct"}, "s": ball, "e": {"type": "constant"},
                    "c": {"type": "perspective", "film": film, "to_world": camera}}

        @pytest.fixture
        def check(render_regression):
            mi.set_variant("scalar_rgb")
            settings = dict(name="made", spp=32, reference_spp=512, batch=16, variant="scalar_rgb")
            return lambda given, **changes: render_regression(given, **{**settings, **changes})

        def test_dictionary(check):
            check(scene(0.5))

        def test_others(check):
            check(mi.load_dict(scene(0.5)))
            first, again, other = (check(scene(0.5), seed=seed).numbers["relmse"] for seed in (0, 0, 1))
            assert first == again != other
            check(scene(0.5001), tolerances={"paired_relative": 1, "alpha": 1e-300})
            with pytest.raises(pytest.fail.Exception):
                check(scene(0.6))

        @pytest.mark.parametrize(("given", "message"), [
            ({"name": None}, "has no name"),
            ({"name": "../x"}, "letters, digits"),
            ({"tiers": ["pixels"]}, "unknown tier"),
            ({"tolerances": {"x": 1}}, "unknown tolerance"),
            ({"variant": "scalar_x"}, "unknown variant"),
        ])
        def test_wrong(check, given, message):
            with pytest.raises(ValueError, match=message):
                check(scene(0.5), **given)
        """
    )
    project.runpytest("--render-update-all", "-k", "test_dictionary").assert_outcomes(passed=1, deselected=6)
    project.runpytest("-W", "error", "--render-report=none").assert_outcomes(passed=7)


def test_a_project_without_renders_imports_nothing_for_it(pytester):
    pytester.makepyfile(
        """
        import sys

        def test_light():
            loaded = {"mitsuba_subdivision", "mitsuba", "drjit", "OpenEXR", "scipy", "matplotlib"} & set(sys.modules)
            assert "pytest_mitsuba_subdivision" in sys.modules
            assert not loaded
        """
    )
    pytester.runpytest_subprocess("-p", "no:hypothesispytest").assert_outcomes(passed=1)
