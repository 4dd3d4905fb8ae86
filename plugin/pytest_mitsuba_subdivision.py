"""The pytest plugin of mitsuba-subdivision: the fixture ``render_regression`` and its options.

A module of its own, outside the package: pytest imports its plugins in every project of an environment, and importing
the package would import Mitsuba there.
"""

from __future__ import annotations

from pathlib import Path

import pytest

_REPORTED = pytest.StashKey[Path]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options ``--render-..`` and the entries ``render_..`` of the configuration file."""
    group = parser.getgroup("render differences", "render-difference tests (mitsuba-subdivision)")
    group.addoption(
        "--render-update",
        dest="render_update",
        action="store_const",
        const="failing",
        default="no",
        help="write references that are missing or do not match, and fail their tests",
    )
    group.addoption(
        "--render-update-all",
        dest="render_update",
        action="store_const",
        const="all",
        help="write every reference, and compare nothing",
    )
    group.addoption(
        "--render-spp-scale",
        type=_positive,
        default=1.0,
        metavar="FACTOR",
        help="factor on the samples per pixel of tests; references keep theirs (default: %(default)s)",
    )
    group.addoption("--render-results", metavar="DIR", help="folder for what failed comparisons leave behind")
    group.addoption(
        "--render-report",
        choices=["failures", "all", "none"],
        default="failures",
        help="comparisons to write an HTML page, numbers and maps for (default: %(default)s)",
    )
    parser.addini("render_references", "folder of the references, from the root folder", default="renders/references")
    parser.addini("render_results", "folder for failed comparisons, from the root folder", default="renders/failures")


def _positive(text: str) -> float:
    factor = float(text)
    if not 0 < factor < float("inf"):
        raise ValueError(f"{text} is no factor above 0")
    return factor


@pytest.fixture
def render_regression(request: pytest.FixtureRequest):
    """Compare a render of a scene with its reference: ``render_regression("scene.xml", parameters={..}, tiers=..)``.

    Without a reference the test fails, and says how to make one. See
    `mitsuba_subdivision.regression.fixture.RenderRegression`.
    """
    from mitsuba_subdivision.regression.fixture import FixtureSettings, RenderRegression

    config = request.config
    results = config.getoption("--render-results")
    settings = FixtureSettings(
        references=config.rootpath / config.getini("render_references"),
        results=Path(results).absolute() if results else config.rootpath / config.getini("render_results"),
        update=config.getoption("render_update"),
        spp_scale=config.getoption("--render-spp-scale"),
        reports=config.getoption("--render-report"),
    )
    fixture = RenderRegression(settings, request.node)
    yield fixture
    if fixture.reported:
        config.stash[_REPORTED] = settings.results


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write a page that links to the reports."""
    results = session.config.stash.get(_REPORTED, None)
    if results:
        from mitsuba_subdivision.images.report import write_index

        write_index(results)
