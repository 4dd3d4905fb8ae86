"""The documentation can be built. This test is slow and needs the extra `dev`; `.ci/run` runs it."""

import subprocess
import sys

import mitsuba_subdivision
from documents.pages import ROOT, read

SPHINX = "python -m sphinx -q -W plugin"


def test_the_documentation_is_built_without_warnings(tmp_path):
    """One site: the README begins it, and guide, formulas, notebooks and API reference lead to each other."""
    assert f"\n{SPHINX} " in read("plugin/CONTRIBUTING.md")
    *command, source = SPHINX.split()[1:]
    words = [sys.executable, *command, "-d", str(tmp_path / "doctrees"), source, str(tmp_path / "html")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr

    def page(name):
        return (tmp_path / "html" / f"{name}.html").read_text(encoding="utf-8")

    reference = page("reference/index")
    assert [name for name in mitsuba_subdivision.__all__ if f'id="mitsuba_subdivision.{name}"' not in reference] == []
    for name, parts in {
        "index": ['src="_images/hero.png"', 'href="guide/speed.html"', 'href="reference/index.html"'],
        "MATHEMATICS": ['class="math', 'href="ARCHITECTURE.html"'],
        "guide/python": ['href="../reference/index.html#mitsuba_subdivision.LimitSurface"', 'href="../index.html"'],
        "guide/notebooks/dark_spot": ['href="../../MATHEMATICS.html#the-equations"', "<img"],
        "reference/fit": ['href="../guide/fitting.html"'],
    }.items():
        assert [part for part in parts if part not in page(name)] == [], name
