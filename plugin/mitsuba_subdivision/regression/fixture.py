"""The pytest fixture `render_regression`.

The plugin that brings the fixture to pytest, `pytest_mitsuba_subdivision`, imports this module only when a test asks
for it.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ..images.comparison import Comparison
from ..images.image import save_image
from ..images.report import write_report
from ..images.tier import Status
from ..images.tolerances import Tolerances
from ..llvm import best_variant
from ..variants import variant_set
from . import RegressionError
from .compare_scene import compare_scene, variant_for
from .environment import variant_problem
from .passes import BATCH, Sampling
from .reference import REFERENCE_SPP, TEST_SPP, UnusableReference, load_reference, render_reference
from .scene import SceneSource


@dataclass(frozen=True)
class FixtureSettings:
    """Settings from the command line of pytest and from its configuration file.

    Attributes
    ----------
    references, results : Path
        Folder of the references, and folder for the renders and reports of failed comparisons.
    update : str
        "no" writes no reference. "failing" writes references that are missing or do not match, and fails their tests.
        "all" writes every reference.
    spp_scale : float
        Factor on the samples per pixel of tests; references keep theirs.
    reports : str
        Which comparisons get a report: "failures", "all" or "none".
    """

    references: Path
    results: Path
    update: str = "no"
    spp_scale: float = 1.0
    reports: str = "failures"


class RenderRegression:
    """The fixture's value: a function of a scene, which compares the scene with its reference."""

    def __init__(self, settings: FixtureSettings, node: Any) -> None:
        self.settings = settings
        self.node = node
        self.reported = False

    def __call__(
        self,
        scene: SceneSource,
        *,
        name: str | None = None,
        parameters: Mapping[str, Any] | None = None,
        variant: str | None = None,
        spp: int = TEST_SPP,
        reference_spp: int = REFERENCE_SPP,
        batch: int = BATCH,
        tiers: Sequence[str] | None = None,
        tolerances: Mapping[str, float] | None = None,
        seed: int = 0,
    ) -> Comparison | None:
        """Render a scene, and fail the pytest test if the render differs from the scene's reference.

        Parameters
        ----------
        scene : path of an XML file, dictionary, or mi.Scene
            The reconstruction filter is replaced by "box"; a mi.Scene must already have that filter.
        name : str, optional
            Name of the reference; by default that of the scene's file. A scene that is not a file needs a name.
        parameters : dict, optional
            Values for parameters of the scene file.
        variant : str, optional
            Variant of Mitsuba; by default the reference's.
        spp, reference_spp, batch : int
            Samples per pixel of the test, of the reference, and of each batch of both.
        tiers : sequence of str, optional
            Some of "probe", "paired", "tile" and "flip"; by default the first three.
        tolerances : dict, optional
            Fields of `Tolerances` to use instead of those stored with the reference. A new reference stores them.
        seed : int
            From 0 on: each has other samples for the tile tier.

        Returns
        -------
        Comparison or None
            None if the reference was written instead.
        """
        __tracebackhide__ = True
        given = {key: str(value) for key, value in (parameters or {}).items()}
        path = self.settings.references / f"{_name(scene, name)}.exr"
        limits = Tolerances().with_values(tolerances or {})

        def write() -> None:
            with variant_set(_usable(variant or best_variant())):
                sampling = Sampling.of_spp(reference_spp, batch)
                save_image(path, render_reference(scene, path, given, sampling, limits))

        if self.settings.update == "all":
            write()
            return None
        try:
            found = self._compare(
                scene, path, given, variant, tiers, round(spp * self.settings.spp_scale), tolerances, seed
            )
        except UnusableReference as problem:
            if self.settings.update == "no":
                pytest.fail(f"{problem}; make it with: pytest {shlex.quote(self.node.nodeid)} --render-update", False)
            write()
            pytest.fail(f"{problem}; wrote it; look at it, and run the test again", False)
        report = self._report(found, path.stem)
        if found.status is not Status.FAIL:
            self.node.add_report_section("call", "render difference", str(found))
            return found
        if self.settings.update != "no":
            write()
            report += f'\nwrote the reference "{path}" again'
        pytest.fail(f"{found}{report}", False)

    def _compare(
        self,
        scene: SceneSource,
        path: Path,
        parameters: dict[str, str],
        variant: str | None,
        tiers: Sequence[str] | None,
        spp: int,
        tolerances: Mapping[str, float] | None,
        seed: int,
    ) -> Comparison:
        reference = load_reference(path)
        stored = reference.metadata.get("parameters", {})
        if stored != parameters:
            raise UnusableReference(
                f'the reference "{path}" was made with the scene parameters {stored}; this test has {parameters}'
            )
        limits = Tolerances().with_values({**reference.metadata.get("tolerances", {}), **(tolerances or {})})
        # All scenes with a reference share the probability of a false alarm, whichever tests are run.
        suite_size = max(1, len(list(self.settings.references.glob("*.exr"))))
        with variant_set(_usable(variant) if variant else variant_for(reference)):
            return compare_scene(reference, scene, tiers, max(1, spp), limits, suite_size, seed)

    def _report(self, found: Comparison, name: str) -> str:
        """Write a report if the settings request one; returns a line with its path."""
        wanted = self.settings.reports
        if wanted == "none" or (wanted == "failures" and found.status is not Status.FAIL):
            return ""
        folder = self.settings.results / re.sub(r"[^\w.-]+", "-", f"{self.node.nodeid}-{name}").strip("-")
        try:
            page = write_report(folder, found, f"{name}: {self.node.nodeid}")
            save_image(folder / "test.exr", found.test)
        except OSError as error:
            return f"\n  no report: {error}"
        self.reported = True
        return f"\n  report: {page}"


def _usable(variant: str) -> str:
    problem = variant_problem(variant)
    if problem:
        raise RegressionError(problem)
    return variant


def _name(scene: SceneSource, name: str | None) -> str:
    if name is None:
        if not isinstance(scene, (str, Path)):
            raise RegressionError("a scene that is no file has no name; expected render_regression(scene, name=..)")
        name = Path(scene).stem
    if not re.fullmatch(r"[\w.-]+", name):
        raise RegressionError(f'reference name "{name}"; expected letters, digits, ".", "_" and "-" only')
    return name
