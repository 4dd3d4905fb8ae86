"""The pytest fixture `render_regression`.

The plugin that brings the fixture to pytest, `pytest_mitsuba_subdivision`, imports this module only when a test asks
for it.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from ..variants import chosen_variant, variant_set
from . import RegressionError, renders
from .compare import Comparison
from .image import save_image
from .report import write_report
from .scene import BOX, SceneSource, load_scene
from .tiers import Status, Tolerances


class RenderRegression:
    """The fixture's value: a function of a scene, which compares the scene with its reference.

    The settings are those of the command line of pytest and of its configuration file.
    """

    def __init__(self, config: pytest.Config, node: Any) -> None:
        results = config.getoption("--render-results")
        self.references = config.rootpath / config.getini("render_references")
        self.results = Path(results).absolute() if results else config.rootpath / config.getini("render_results")
        self.update = config.getoption("render_update")
        self.spp_scale = config.getoption("--render-spp-scale")
        self.reports = config.getoption("--render-report")
        self.node = node
        self.reported = False

    def __call__(
        self,
        scene: SceneSource,
        *,
        name: str | None = None,
        parameters: Mapping[str, Any] | None = None,
        variant: str | None = None,
        spp: int = renders.TEST_SPP,
        reference_spp: int = renders.REFERENCE_SPP,
        batch: int = renders.BATCH,
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
        path = self.references / f"{_name(scene, name)}.exr"
        new_limits = Tolerances().with_values(tolerances or {})

        def write() -> None:
            with variant_set(chosen_variant(variant)):
                loaded = load_scene(scene, given, BOX)
                image = renders.render_pass(loaded, renders.Sampling.of_spp(reference_spp, batch), with_probe=True)
                save_image(path, renders.as_reference(image, loaded.path, path, new_limits))

        if self.update == "all":
            write()
            return None
        try:
            reference = renders.load_reference(path)
            stored = reference.metadata.get("parameters", {})
            if stored != given:
                raise renders.UnusableReference(
                    f'the reference "{path}" was made with the scene parameters {stored}; this test has {given}'
                )
            limits = Tolerances().with_values({**reference.metadata.get("tolerances", {}), **(tolerances or {})})
            # All scenes with a reference share the probability of a false alarm, whichever tests are run.
            suite_size = max(1, len(list(self.references.glob("*.exr"))))
            spp = max(1, round(spp * self.spp_scale))
            with variant_set(chosen_variant(variant) if variant else renders.variant_for(reference)):
                comparison = renders.compare_scene(reference, scene, tiers, spp, limits, suite_size, seed)
        except renders.UnusableReference as problem:
            if self.update == "no":
                pytest.fail(f"{problem}; make it with: pytest {shlex.quote(self.node.nodeid)} --render-update", False)
            write()
            pytest.fail(f"{problem}; wrote it; look at it, and run the test again", False)
        report = self._report(comparison, path.stem)
        if comparison.status is not Status.FAIL:
            self.node.add_report_section("call", "render difference", str(comparison))
            return comparison
        if self.update != "no":
            write()
            report += f'\nwrote the reference "{path}" again'
        pytest.fail(f"{comparison}{report}", False)

    def _report(self, comparison: Comparison, name: str) -> str:
        """Write a report if the settings request one; returns a line with its path."""
        wanted = self.reports
        if wanted == "none" or (wanted == "failures" and comparison.status is not Status.FAIL):
            return ""
        folder = self.results / re.sub(r"[^\w.-]+", "-", f"{self.node.nodeid}-{name}").strip("-")
        try:
            page = write_report(folder, comparison, f"{name}: {self.node.nodeid}")
            save_image(folder / "test.exr", comparison.test)
        except (OSError, RegressionError) as error:
            return f"\n  no report: {error}"
        self.reported = True
        return f"\n  report: {page}"


def _name(scene: SceneSource, name: str | None) -> str:
    if name is None:
        if not isinstance(scene, (str, Path)):
            raise RegressionError("a scene that is no file has no name; expected render_regression(scene, name=..)")
        name = Path(scene).stem
    if not re.fullmatch(r"[\w.-]+", name):
        raise RegressionError(f'reference name "{name}"; expected letters, digits, ".", "_" and "-" only')
    return name
