import json
import re
import sys

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import variants
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.regression.image import load_image, read_channels, write_channels, write_exr
from regression.defects import SCENES

SCENE = str(SCENES / "valence3.xml")
SMALL = ["-D", "resolution=16", "--variant", "scalar_rgb"]
PASS = "--spp 64 --batch 8 --filter box --variant scalar_rgb -D resolution=8"
RANGES = "expected a seed, the samples of a batch, and ranges"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path, small = tmp_path_factory.mktemp("images"), [*SMALL, "--batch", "16"]
    assert main(["render", SCENE, "-o", str(path / "reference.exr"), "--reference", "--spp", "512", *small]) == 0
    stam = ["-D", "evaluator=stam", "-D", "sample_offset=1e-6"]
    assert main(["render", SCENE, "-o", str(path / "stam.exr"), "--reference", "--spp", "32", *small, *stam]) == 0
    write_exr(path / "plain.exr", load_image(path / "reference.exr").pixels)
    write_exr(path / "darker.exr", 0.9 * load_image(path / "reference.exr").pixels)
    return path


def compare(folder, *words):
    return main(["compare", *(str(folder / word) if word.endswith(".exr") else word for word in words)])


def merge(output, *paths):
    return main(["merge", *map(str, paths), "-o", str(output)])


def test_a_scene_against_its_reference(folder, capsys):
    assert compare(folder, "reference.exr", SCENE, "--spp", "64") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("PASS")
    assert [line.split()[:2] for line in lines[1:4]] == [["probe", "pass"], ["paired", "pass"], ["tile", "pass"]]


def test_different_images_fail_with_their_place_even_without_a_report(folder, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)
    words = ["reference.exr", "stam.exr", "--html", str(tmp_path / "report")]
    assert compare(folder, *words) == 2
    assert re.search(r"worst pixel \(probe\)(.|\n)*\(u, v\) = \(", capsys.readouterr().out)
    assert (tmp_path / "report" / "index.html").is_file()
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert compare(folder, *words) == 3
    printed, told = capsys.readouterr()
    assert printed.startswith("FAIL: ")
    assert "reports need matplotlib" in told


def test_json_on_standard_output_or_in_a_file(folder, capsys, tmp_path):
    assert compare(folder, "reference.exr", "reference.exr", "--json", "-") == 0
    printed = json.loads(capsys.readouterr().out)
    compare(folder, "reference.exr", "reference.exr", "--json", str(tmp_path / "found.json"))
    assert json.loads((tmp_path / "found.json").read_text()) == printed
    assert printed["status"] == "pass"


def test_warnings_have_their_own_exit_status(folder, tmp_path, monkeypatch):
    # The scene has changed, and so has the machine: the tile tier cannot tell, at this tolerance.
    monkeypatch.setattr(variants, "_processor", lambda: "another")
    changed = (SCENES / "valence3.xml").read_text().replace('value="0.72, 0.66', 'value="0.7201, 0.66')
    (tmp_path / "scene.xml").write_text(changed.replace("cages/valence3", str(SCENES / "cages/valence3")))
    assert compare(folder, "reference.exr", str(tmp_path / "scene.xml"), "--tiers", "paired", "--spp", "32") == 1


def test_any_two_images(folder):
    assert compare(folder, "plain.exr", "reference.exr") == 0
    assert compare(folder, "plain.exr", "darker.exr") == 2
    assert compare(folder, "plain.exr", "darker.exr", "--tolerance", "flip_mean=1", "--tolerance", "flip_p95=1") == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["reference.exr", "missing.exr"], "is not a file"),
        (["missing.exr", SCENE], "missing.exr --reference"),
        (["reference.exr", "plain.exr", "--seed", "0"], "--seed is for a scene"),
        (["reference.exr", "plain.exr", "--tiers", "probe"], 'tier "probe" cannot run'),
        (["reference.exr", "plain.exr", "--tolerance", "x=1"], 'unknown tolerance "x"'),
        (["plain.exr", SCENE], "does not say how it was rendered"),
        (["reference.exr", "/missing.xml"], "is not a file"),
        (["reference.exr", "plain.exr", "--spp", "1"], "--spp is for a scene"),
        (["reference.exr", "plain.exr", "--json", "/proc/a.json"], 'output "/proc/a.json": '),
        (["reference.exr", "plain.exr", "--html", "/proc/report"], 'folder "/proc/report" cannot be made: '),
    ],
)
def test_unusable_input_is_status_3(folder, capsys, words, message):
    assert compare(folder, *words) == 3
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("words", ["compare", "merge", "merge a -z", "compare a b --tolerance x", "compare a b -z"])
def test_unusable_options_are_status_3(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    assert stop.value.code == 3
    assert "usage:" in capsys.readouterr().err


def test_at_least_the_requested_samples_are_taken(tmp_path):
    path = tmp_path / "whole.exr"
    assert main(["render", SCENE, *SMALL, "--spp", "44", "--batch", "8", "-o", str(path), "--passes", "1"]) == 0
    assert (load_image(path).estimate.count == 48).all()
    # Each of many passes has a batch.
    assert main(["render", SCENE, *SMALL, "--spp", "8", "-o", str(path), "--passes", "8"]) == 0
    assert (load_image(path).estimate.count == 8).all()


@pytest.fixture(scope="module")
def passes(tmp_path_factory):
    """Passes 1 to 3 of 3, and ones that do not belong to them."""
    path = tmp_path_factory.mktemp("passes")
    for name, words in {
        **{number: f"--pass {number}/3" for number in "123"},
        "of_two": "--pass 2/2",
        "of_16": "--pass 2/3 --batch 16",
        "seed": "--pass 2/3 --seed 1",
        "larger": "--pass 2/3 -D resolution=9",
        "scene": "--pass 2/3",
        "tent": "--pass 2/3 --filter tent",
        "whole": "--passes 3",
    }.items():
        scene = str(SCENES / "valence5.xml") if name == "scene" else SCENE
        assert main(["render", scene, "-o", str(path / f"{name}.exr"), *f"{PASS} {words}".split()]) == 0
    return path


def test_merged_passes_equal_one_render(passes, tmp_path):
    assert merge(tmp_path / "merged.exr", *(passes / f"{i}.exr" for i in (3, 1, 2))) == 0
    assert (tmp_path / "merged.exr").read_bytes() == (passes / "whole.exr").read_bytes()


@pytest.mark.core
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["1", "of_two", "2"], "another pass has as well"),
        (["1", "1"], "has batch 0, which another pass has as well"),
        (["1", "of_16"], "batch is 8 and 16"),
        (["1", "seed"], "seed is 0 and 1"),
        (["1", "larger"], "size is [8, 8] and [9, 9]"),
        (["1", "scene"], "of the files, cages/valence3.obj, cages/valence5.obj, valence3.xml, valence5.xml differ"),
        (["1", "tent"], "filter is box and tent"),
        (["1", "missing"], "is not a file"),
    ],
)
def test_passes_of_other_images_are_status_3(passes, capsys, words, message):
    assert merge(passes / "merged.exr", *(passes / f"{word}.exr" for word in words)) == 3
    (told,) = capsys.readouterr().err.splitlines()
    assert message in told
    assert not (passes / "merged.exr").exists()


def test_a_missing_pass_warns(passes, capsys, tmp_path):
    for there, missing in (("13", "2"), ("2", "1, 3")):
        assert merge(tmp_path / "merged.exr", *(passes / f"{number}.exr" for number in there)) == 0
        assert capsys.readouterr().err == f"mitsuba-subdivision: warning: of 3 passes, these are missing: {missing}\n"


def test_non_finite_references_are_not_written(tmp_path, capsys, monkeypatch):
    pixels = np.ones((16, 16, 3), np.float32)
    pixels[3, 5, 1] = np.nan
    monkeypatch.setattr("mitsuba_subdivision.regression.renders.render_pixels", lambda *_, **__: pixels)
    assert main(["render", SCENE, "-o", str(tmp_path / "reference.exr"), "--reference", "--spp", "16", *SMALL]) == 1
    assert "is not finite: G = nan at x = 5, y = 3; channels G, variance.G" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_each_seed_has_other_samples(folder, tmp_path):
    report, samples = tmp_path / "found.json", []
    words = ["reference.exr", SCENE, "--spp", "16", "--tiers", "tile", "--json", str(report)]
    for seed in ([], ["--seed", "0"], ["--seed", "1"]):
        assert compare(folder, *words, *seed) == 0
        samples.append(json.loads(report.read_text())["relmse"])
    assert samples[0] == samples[1] != samples[2]


def test_merged_passes_need_an_openexr_file_other_than_their_inputs(passes, capsys, tmp_path):
    before = (passes / "1.exr").read_bytes()
    assert merge(tmp_path / "merged.png", passes / "1.exr") == 3
    assert 'merged.png"; expected a name ending in .exr' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert merge(passes / "1.exr", passes / "1.exr", passes / "2.exr") == 3
    assert "is an input as well; expected another file" in capsys.readouterr().err
    assert (passes / "1.exr").read_bytes() == before


def with_pixel(name, value):
    is_changed = np.zeros((8, 8), bool)
    is_changed[3, 4] = True
    return lambda channels, metadata: ({**channels, name: np.where(is_changed, value, channels[name])}, metadata)


def with_metadata(**changes):
    return lambda channels, metadata: (channels, {**metadata, **changes})


def with_sampling(**changes):
    return with_metadata(sampling={"seed": 0, "batch": 8, "batches": [[2, 5]], **changes})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, m: ({n: c[n] for n in c if "variance" not in n}, m), "is no pass: it has no variance"),
        (with_pixel("G", np.nan), "is not finite: G = nan at x = 4, y = 3"),
        (with_pixel("variance.R", np.inf), "is not finite: variance.R = inf at x = 4, y = 3"),
        (with_pixel("variance.R", -1), "has a variance of -1; expected at least 0"),
        (lambda c, m: ({**c, "N": c["N"] + np.float32(0.5)}, m), "channel N of image .* has numbers of type float32"),
        (with_metadata(sampling=[1]), r"sampling is \[1\]; expected a seed"),
        *((with_sampling(batches=wrong), RANGES) for wrong in ([[5, 2]], [], 3, [1, 2], [[2, 5], [6]])),
        *((with_sampling(**wrong), RANGES) for wrong in ({"batch": 0}, {"seed": "0"}, {"total": 4})),
        (with_sampling(total=8, passes=9), RANGES),
        (with_metadata(paired={"seed": 0}), "expected a seed and samples per pixel"),
        (with_metadata(paired={"spp": 4}), "expected a seed and samples per pixel"),
        (with_metadata(files=[1]), r"files is \[1\]; expected checksums by name"),
        (with_metadata(variant=7), "variant is 7; expected a name"),
    ],
)
def test_damaged_passes_are_status_3(passes, capsys, tmp_path, change, message):
    """So are images that cannot be loaded, see `test_exr`."""
    path = tmp_path / "damaged.exr"
    write_channels(path, *change(*read_channels(passes / "2.exr")[:2]))
    assert merge(tmp_path / "merged.exr", passes / "1.exr", path) == 3
    (told,) = capsys.readouterr().err.splitlines()
    assert re.search(message, told)
    assert not (tmp_path / "merged.exr").exists()


def test_damaged_files_are_status_3_and_one_line(folder, passes, tmp_path, np_rng, capfd):
    whole, path = (passes / "2.exr").read_bytes(), tmp_path / "damaged.exr"
    mi.Bitmap(np.zeros((8, 8, 3), dtype=np.uint8)).write(str(tmp_path / "a.png"))
    damaged = [b"", b"no image", (tmp_path / "a.png").read_bytes()]
    damaged += [whole[:length] for length in (1, 4, 100, len(whole) // 2, len(whole) - 1)]
    for data in damaged:
        path.write_bytes(data)
        problem = "is truncated, or damaged" if data[:4] == whole[:4] else "is not an OpenEXR file"
        for words in (
            ["merge", str(passes / "1.exr"), str(path), "-o", str(tmp_path / "merged.exr")],
            ["compare", str(folder / "reference.exr"), str(path)],
            ["compare", str(path), SCENE],
        ):
            assert main(words) == 3, words
            # Of the process, not of Python alone: OpenEXR writes there itself.
            printed, told = capfd.readouterr()
            assert (printed, told.count("\n")) == ("", 1)
            assert told.endswith(f'damaged.exr" {problem}\n')
    for _ in range(20):
        flipped = np.frombuffer(whole, dtype=np.uint8).copy()
        flipped[np_rng.integers(0, len(whole), 4)] = np_rng.integers(0, 256, 4)
        path.write_bytes(flipped.tobytes())
        assert merge(tmp_path / "merged.exr", path) in (0, 3)
        assert "Traceback" not in capfd.readouterr().err
