"""The pytest plugin of mitsuba-subdivision: the fixture ``render_regression`` and its options.

It is outside the package, which imports Mitsuba, as pytest imports plugins in every project of an environment.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from mitsuba_subdivision.regression.fixture import RenderRegression


class RenderWarning(pytest.PytestWarning):
    """A comparison of renders left something undecided."""


_REPORTED = pytest.StashKey[Path]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options ``--render-..``, and ``render_..`` in the configuration file."""
    add = parser.getgroup("render differences", "render-difference tests (mitsuba-subdivision)").addoption
    update: dict[str, Any] = {"dest": "render_update", "action": "store_const"}
    text = "write the references that are missing or do not match, and fail their tests"
    add("--render-update", const="failing", default="no", help=text, **update)
    add("--render-update-all", const="all", help="write all references, and compare nothing", **update)
    text = "factor on the samples per pixel of tests, not of references (default: %(default)s)"
    add("--render-spp-scale", type=_positive, default=1.0, metavar="FACTOR", help=text)
    add("--render-results", metavar="DIR", help="folder for the renders and reports of comparisons")
    text = "which comparisons get a report: page, numbers and maps (default: %(default)s)"
    add("--render-report", choices=["failures", "all", "none"], default="failures", help=text)
    text = "folder of the references, relative to the root folder"
    parser.addini("render_references", text, default="renders/references")
    text = "folder for renders and reports of comparisons, relative to the root folder"
    parser.addini("render_results", text, default="renders/failures")


def _positive(text: str) -> float:
    factor = float(text)
    if not 0 < factor < float("inf"):
        raise ValueError(f"{text} is no factor above 0")
    return factor


@pytest.fixture
def render_regression(request: pytest.FixtureRequest) -> Iterator[RenderRegression]:
    """Compare a render of a scene with its reference: ``render_regression("scene.xml", parameters={..}, tiers=..)``.

    If there is no reference, the test fails with the command that makes one. For all arguments, see
    `mitsuba_subdivision.regression.fixture.RenderRegression`.
    """
    from mitsuba_subdivision.regression.fixture import RenderRegression

    fixture = RenderRegression(request.config, request.node)
    yield fixture
    if fixture.reported:
        request.config.stash[_REPORTED] = fixture.results


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """List undecided comparisons, and after an update unused references."""
    reports = [report for kind in terminalreporter.stats.values() for report in kind]
    found = dict.fromkeys((r.nodeid, *entry) for r in reports for entry in getattr(r, "user_properties", ()))
    undecided = [f"{nodeid}: {text}" for nodeid, key, text in found if key == "render_undecided"]
    references = config.rootpath / config.getini("render_references")
    used = {references / text for _, key, text in found if key == "render_reference"}
    is_update = used and config.getoption("render_update") != "no"
    unused = sorted(map(str, {*references.rglob("*.exr")} - used)) if is_update else []
    for title, lines in (("not decided", undecided), ("references that no test of this run used", unused)):
        if lines:
            terminalreporter.section(f"render differences: {title}")
            terminalreporter.write_line("\n".join(lines))


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write a page with links to all reports."""
    results = session.config.stash.get(_REPORTED, None)
    if results:
        from mitsuba_subdivision.regression.report import write_index

        write_index(results)
