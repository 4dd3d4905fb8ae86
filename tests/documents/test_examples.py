"""Every block of code and every command in the README, the guide and the page for contributors works.

The blocks of a page run in order, in one folder that has the repository's scenes; blocks of Python share their names.
A comment above a block says where it runs in another way here:

- ``in the tests: add ARGUMENTS`` appends arguments to each command of the block, so that it takes less time;
- ``in the tests: "A" is "B"`` replaces text, for the same reason;
- ``in the tests: needs PACKAGE`` leaves the block out where a package has no wheel;
- ``in the tests: options only`` checks commands that take minutes, or are run elsewhere: that they load, and have the
  options; so are all scripts of the tests;
- ``pytest`` says that the block is a file of tests;
- ``test command`` is for `.ci/run`.
"""

import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import mitsuba_subdivision
import numpy as np
import pytest
from documents.pages import CONFIGURATION, GUIDE, PLUGIN, PROJECT, ROOT, quoted, read, rows_below, without_blocks
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage.contents import RULES
from mitsuba_subdivision.figures import FIGURES
from mitsuba_subdivision.files.formats import FORMATS
from mitsuba_subdivision.files.obj import read_obj
from mitsuba_subdivision.regression.tiers import TIERS
from mitsuba_subdivision.shapes.parameter_table import PARAMETERS, STATE_PARAMETERS

PAGES = [ROOT / "README.md", *sorted(GUIDE.glob("*.md")), PLUGIN / "CONTRIBUTING.md"]
PAGES += sorted((ROOT / ".github").glob("*.md"))
EVERY_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
BLOCK = re.compile(
    r"^(?: *<!-- (?P<mark>[^\n]+) -->\n)? *```(?P<language>\w*)\n(?P<text>.*?)^ *```$", flags=re.MULTILINE | re.DOTALL
)
MARK = re.compile(r'(in the tests: (add .+|".+" is ".+"|needs \w+|options only)|pytest|test command)?')
EXTRAS = PROJECT["optional-dependencies"]
MARKERS = [line.split(":")[0] for line in CONFIGURATION["tool"]["pytest"]["ini_options"]["markers"]]
OURS, OPTIONS_ONLY = "mitsuba-subdivision", "options only"
# Files that the examples of a page leave, among others.
WRITTEN = {
    "README": {"artifact.png", "human.png", "rook.png"},
    "blender": {"mug.blend", "mug.usda", "mug.png", "mug.obj", "turn.gif", "film_0002.png"},
    "comparing-renders": {"valence5.exr", "reference.exr", "index.html", "rook.exr"},
    "figures": {"creases.png", "whole.png", "inset.png"},
    "files": {"barrel.usda", "human.ply", "barrel.ply"},
    "fitting": {"found.obj", "fit.npz"},
    "python": {"barrel.obj"},
    "render": {"human.png", "jar.png", "rook.exr", "rook.xml", "edited.png", "warm.png", "turn_0003.png", "turn.gif"},
}
# References are written, and compared.
PYTEST_TWICE = """import pytest
for option in ("--render-update-all", "--render-report=none"):
    pytest.main(["-q", "-p", "no:cacheprovider", "-p", "no:hypothesispytest", option])
"""
# Prints the help of a script, if it has one.
HELP = """import os, runpy, sys
path, name = sys.argv[1:]
sys.argv = [path, "--help"]
sys.path.insert(0, os.path.dirname(path))
runpy.run_path(path, run_name=name)
"""


class Block(NamedTuple):
    page: Path
    line: int
    mark: str
    language: str
    text: str

    def __str__(self):
        return f"{self.page.name}:{self.line}"

    @property
    def is_left_out(self):
        needed = re.fullmatch(r"in the tests: needs (\w+)", self.mark)
        return bool(needed and find_spec(needed[1]) is None)

    @property
    def commands(self):
        """Words of each command, with those that a comment adds; commands that ``&&`` joins are several."""
        if self.is_left_out:
            return
        added = self.mark.partition("in the tests: add ")[2]
        for line in self.text.replace("\\\n", " ").splitlines():
            for command in line.split("&&"):
                words = shlex.split(command, comments=True)
                if words:
                    words[0] = words[0].removeprefix(".venv/bin/")
                    yield [*words, *shlex.split(added)] if added and words[0] == OURS else words


def blocks(page):
    text = page.read_text(encoding="utf-8")
    result = []
    for match in BLOCK.finditer(text):
        line, mark = text.count("\n", 0, match.start("text")) + 1, match["mark"] or ""
        result.append(Block(page, line, mark, match["language"], textwrap.dedent(match["text"])))
    assert [block.mark for block in result if not MARK.fullmatch(block.mark)] == []
    # None was missed.
    assert 2 * len(result) == len(re.findall(r"^ *```", text, flags=re.MULTILINE))
    return result


@pytest.fixture
def folder(tmp_path, monkeypatch, few_pixels):  # noqa: ARG001
    """A working folder with the repository's scenes; schemes that examples register are forgotten."""
    from mitsuba_subdivision.schemes import scheme

    monkeypatch.setattr(scheme, "_SCHEMES", dict(scheme._SCHEMES))
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_python(block, names):
    """Run a block of Python in a namespace; errors name the page's line."""
    if block.is_left_out:
        return
    text = block.text
    replaced = re.fullmatch(r'in the tests: "(.+)" is "(.+)"', block.mark)
    if replaced:
        assert replaced[1] in text, block
        text = text.replace(replaced[1], replaced[2])
    exec(compile("\n" * (block.line - 1) + text, str(block.page), "exec"), names)


def run_as_tests(block, folder):
    """Run a block as a file of tests, which first write their references."""
    shutil.copy(ROOT / "tests" / "data" / "ball.xml", folder / "scenes" / "my_scene.xml")
    (folder / "test_example.py").write_text(block.text)
    command = [sys.executable, "-c", PYTEST_TWICE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.count("1 passed") == 2, done.stdout + done.stderr
    assert os.listdir(folder / "renders" / "references" / "scenes") == ["my_scene.exr"]


def check_script(path, *words):
    """Load a script, which takes long, and find the options of a command in its help."""
    program = ROOT / path / "__main__.py" if (ROOT / path).is_dir() else ROOT / path
    has_options = "argparse" in program.read_text(encoding="utf-8")
    command = [sys.executable, "-c", HELP, path, "__main__" if has_options else "imported"]
    wide = {**os.environ, "COLUMNS": "200"}
    done = subprocess.run(command, cwd=ROOT, env=wide, timeout=120, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [word for word in words if word.startswith("--") and word not in done.stdout] == [], path


def module(words):
    """Check a command that runs a module: whether it is there, and what it is told."""
    name, *arguments = words
    if name == "pip":
        assert arguments[0] == "install"
        wanted = [word for word in arguments[1:] if not word.startswith("-")]
        assert wanted
        for package, *extras in (re.findall(r"[\w.-]+", word) for word in wanted):
            assert package in (".", OURS, "build", "twine"), words
            assert {*extras} <= {*EXTRAS}, words
    elif name == "pytest":
        values = dict(itertools.pairwise(arguments))
        assert values.get("-m", MARKERS[0]) in MARKERS
        assert values.get("--dist", "worksteal") == "worksteal"
        paths = [word for word in arguments if word.startswith("tests/")]
        assert [path for path in paths if not (ROOT / path).exists()] == []
    else:
        assert name in ("venv", "build", "twine", "sphinx"), words


def run_commands(block):
    for words in block.commands:
        first, *rest = words
        if first == OURS and block.mark.endswith(OPTIONS_ONLY):
            with pytest.raises(SystemExit, match="0"):
                main([*rest, "--help"])
        elif first == OURS:
            assert main(rest) == 0, (str(block), words)
        elif first in ("python", "python3") and rest[0] == "-m":
            module(rest[1:])
        elif first == "python":
            if find_spec("resource"):  # Windows lacks it, and scripts that measure need it.
                check_script(*rest)
        elif first == "pip":
            module(words)
        elif first == "export":
            name = rest[0].partition("=")[0]
            assert any(name in path.read_text(encoding="utf-8") for path in PLUGIN.rglob("*.py")), name
        elif first == "blender":
            python = os.environ.get("BLENDER") or (find_spec("bpy") and sys.executable)
            if shutil.which(first) is None and not python:
                pytest.skip("there is neither the program blender nor the package bpy")
            command = words
            if shutil.which(first) is None:
                scene = [f"--blend={word}" for word in words[1:3] if word.endswith(".blend")]
                command = [python, words[words.index("--python") + 1], *words[words.index("--") :], *scene]
            here = {**os.environ, "PWD": os.getcwd()}  # Where Blender looks for the folder that it works in.
            done = subprocess.run(command, env=here, capture_output=True, text=True, timeout=100, check=False)
            assert done.returncode == 0, (str(block), done.stderr)
        elif "/" in first:
            assert os.access(ROOT / first, os.X_OK), words
        else:
            # A program of a package of an extra.
            assert f'"{first}' in read("pyproject.toml"), words


def run_blocks(page, folder):
    """Run all blocks of a page; returns the names that its Python has made."""
    names = {"__name__": "example"}
    for block in blocks(page):
        if block.mark == "pytest":
            run_as_tests(block, folder)
        elif block.language == "python":
            run_python(block, names)
        elif block.language == "xml":
            (folder / "example.xml").write_text(block.text)
            shapes = mi.load_file(str(folder / "example.xml")).shapes()
            assert [type(shape).__name__ for shape in shapes] == ["Subdivision"], block
        elif block.language == "sh":
            run_commands(block)
        else:
            assert block.language == "bibtex", block
    return names


@EVERY_PAGE
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_every_example_of_a_page_runs(page, folder):
    names = run_blocks(page, folder)
    assert {path.name for path in folder.rglob("*") if path.is_file()} >= WRITTEN.get(page.stem, set())
    if page.stem == "parameters":
        # One optimisation has found the size, the other the colours.
        points = np.array(mi.traverse(names["scene"])[names["key"]])
        assert 1.15 < np.linalg.norm(points) / np.linalg.norm(np.array(names["start"])) < 1.25
        assert names["error"] < 0.03


@EVERY_PAGE
def test_every_picture_of_a_page_is_there_and_every_option_in_its_text_is_one(page):
    """Of the command line, of pytest with this package, or of a script; other tests follow the links of Markdown."""
    sources = re.findall(r'<img src="([^"]+)"', page.read_text(encoding="utf-8"))
    assert [source for source in sources if not (page.parent / source).is_file()] == []
    text = without_blocks(page.read_text(encoding="utf-8"))
    options = {option for code in re.findall(r"`([^`]+)`", text) for option in re.findall(r"--[a-z-]+", code)}
    sources = [*PLUGIN.rglob("*.py"), *(ROOT / "tests").rglob("*.py"), ROOT / "scenes" / "export_cage.py"]
    known = {option for path in sources for option in re.findall(r'"(--[a-z-]+)"', path.read_text(encoding="utf-8"))}
    assert sorted(options - known) == []


@pytest.mark.parametrize(("mark", "parameters"), [("parameters", PARAMETERS), ("state parameters", STATE_PARAMETERS)])
def test_parameter_tables_match_the_shape(mark, parameters):
    lines = ["| Parameter | Type | Description | Flags |", "|---|---|---|---|"]
    signs = {"exposed": "P", "readonly": "R", "differentiable": "∂", "discontinuous": "D"}
    for parameter in parameters:
        flags = " ".join(signs[flag] for flag in parameter.flags)
        lines.append(f"| `{parameter.name}` | {parameter.type} | {parameter.text.replace('``', '`')} | {flags} |")
    expected = "\n".join(lines).replace("|  |", "| |")
    page = (GUIDE / "parameters.md").read_text(encoding="utf-8")
    assert f"<!-- {mark} -->\n{expected}\n\n" in page, f"expected in the page below <!-- {mark} -->:\n{expected}"


def test_the_table_of_formats_has_every_suffix_and_its_extra():
    rows = rows_below(GUIDE / "files.md", "formats")
    assert [suffix for row in rows for suffix in quoted(row[0])] == list(FORMATS)
    assert {extra for row in rows for extra in quoted(row[2])} <= set(EXTRAS)


def test_statements_of_the_table_of_tags_have_their_meanings(tmp_path):
    path = tmp_path / "cage.obj"

    def contents(*statements):
        path.write_text("\n".join(["v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", *statements]))
        return read_obj(path)

    statements = []
    for statement, meaning in rows_below(GUIDE / "files.md", "tags"):
        statements += quoted(statement)
        if "`" in meaning:
            rule, *values = quoted(meaning)
            assert contents(*statements).rules[rule] == values[-1]
            assert set(RULES[rule]) <= set(values)
    cage = contents(*statements)
    assert cage.creases.tolist() == [[0, 1, 3.5]]
    assert cage.corners.tolist() == [[7, 10]]
    assert cage.holes.tolist() == [5]
    assert cage.rules.keys() == RULES.keys()


def test_the_tables_of_tiers_and_of_figures_have_all_and_their_formats_and_options():
    assert [quoted(row[0])[0] for row in rows_below(GUIDE / "comparing-renders.md", "tiers")] == list(TIERS)
    stated = {}
    for name, _, formats, options in rows_below(GUIDE / "figures.md", "figures"):
        words = tuple(option.removeprefix("--") for option in quoted(options))
        stated[quoted(name)[0]] = tuple(formats.split(", ")), words
    assert stated == {name: (figure.formats, figure.options) for name, figure in FIGURES.items()}


def test_the_entry_for_the_software_states_the_version():
    (block,) = (block for block in blocks(ROOT / "README.md") if block.language == "bibtex")
    assert f"version = {{{mitsuba_subdivision.__version__}}}" in block.text
    assert block.text.count("{") == block.text.count("}")


def test_the_readme_is_a_landing_page():
    """Short enough to be read at once, and it leads to every page."""
    text = read("README.md")
    assert len(text.splitlines()) <= 120
    links = {(ROOT / target.partition("#")[0]).resolve() for target in re.findall(r"\]\((\w[^):]+)\)", text)}
    # Two pages of the documentation's site show the README and the changelog.
    assert links >= {page for page in PLUGIN.rglob("*.md") if page.name not in ("index.md", "changes.md")}
