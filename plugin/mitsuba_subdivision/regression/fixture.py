"""The pytest fixture `render_regression`, which `pytest_mitsuba_subdivision` imports when a test asks for it."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
import shutil
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pytest_mitsuba_subdivision import RenderWarning

from ..llvm import imported_too_late
from ..variants import chosen_variant, variant_set
from ..whole_file import require_writable
from . import ContentElsewhere, RegressionError, renders
from .compare import Comparison
from .image import Image, load_image, save_image
from .report import NUMBERS, write_report
from .scene import BOX, GivenScene, load_scene
from .tiers import Status, Tolerances

# Scenes of a reference, by its path: text of the scene, and the test that renders it.
CLAIMS = pytest.StashKey[dict[Path, tuple[str, str]]]()
TOO_LATE = "mitsuba was imported before mitsuba_subdivision, which chooses an LLVM library;"
NAME = "expected another name=.. for one of them"
_Settings = tuple[dict[str, str], int]  # Parameters of the scene's file, and index of its sensor


class RenderRegression:
    """The fixture's value: a function of a scene, which compares the scene with its reference by pytest's settings."""

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
        scene: GivenScene,
        *,
        name: str | None = None,
        parameters: Mapping[str, Any] | None = None,
        sensor: int | None = None,
        variant: str | None = None,
        spp: int = renders.TEST_SPP,
        reference_spp: int = renders.REFERENCE_SPP,
        batch: int = renders.BATCH,
        tiers: Sequence[str] | None = None,
        tolerances: Mapping[str, float] | None = None,
        missing_channels: str = "warn",
        seed: int = 0,
    ) -> Comparison | None:
        """Render a scene, and fail the pytest test if the render differs from the scene's reference.

        Undecided comparisons are warnings, and properties in JUnit files. Returns None if the reference was written.

        Parameters
        ----------
        scene : path of an XML file, dictionary, or mi.Scene
            A path is relative to the test's file, or else to pytest's root folder. "box" replaces the reconstruction
            filter; a mi.Scene must already have it.
        name : str, optional
            Name of the reference; by default the path of the scene's file relative to pytest's root folder, with the
            parameters and the sensor. A scene that is not a file needs a name.
        parameters : dict, optional
            Values for parameters of the scene file.
        sensor : int, optional
            Index of the scene's sensor; by default the first, with a warning if there are several.
        variant : str, optional
            Variant of Mitsuba; by default the reference's.
        spp, reference_spp, batch : int
            Samples per pixel of the test, of the reference, and of each batch of both.
        tiers : sequence of str, optional
            Some of "probe", "paired", "tile" and "flip"; by default the first three.
        tolerances : dict, optional
            Fields of `Tolerances` that replace those of the reference. A new reference stores them.
        missing_channels : str
            Effect of channels of only one image: "ignore", "warn" or "fail".
        seed : int
            From 0 on: selects the samples of the tile tier.
        """
        __tracebackhide__ = True
        given = {key: str(value) for key, value in (parameters or {}).items()}
        new_limits = Tolerances().with_values(tolerances or {})
        scene = self._located(scene)
        settings = given, sensor or 0
        path = self._path_of_reference(scene, name, settings)
        self._claim(path, scene, settings)
        if (variant or "llvm").startswith("llvm") and imported_too_late():
            pytest.fail(f'{TOO_LATE} add "import mitsuba_subdivision" above the first "import mitsuba"', False)

        def write() -> None:
            with variant_set(chosen_variant(variant)):
                loaded = load_scene(scene, given, BOX, settings[1])
                image = renders.render_pass(loaded, renders.Sampling.of_spp(reference_spp, batch), with_probe=True)
                save_image(path, renders.as_reference(image, loaded.path, path, new_limits))

        def compared() -> Comparison:
            reference = renders.load_reference(path)
            _require_same_scene(reference, path, scene, settings)
            limits = Tolerances().with_values({**reference.metadata.get("tolerances", {}), **(tolerances or {})})
            # All scenes with a reference share the probability of a false alarm, in any selection of tests.
            suite_size = max(1, len(list(self.references.rglob("*.exr"))))
            count = max(1, round(spp * self.spp_scale))
            options = {"tiers": tiers, "tolerances": limits, "suite_size": suite_size, "missing": missing_channels}
            with variant_set(chosen_variant(variant) if variant else renders.variant_for(reference)):
                return renders.compare_scene(reference, scene, count, seed, **options)

        failure = ""
        try:
            if self.update != "no":
                require_writable(path)
            if self.update == "all":
                write()
                return None
            try:
                comparison = compared()
            except renders.UnusableReference as problem:
                failure = f"{problem}; make it with: pytest {shlex.quote(self.node.nodeid)} --render-update"
                if self.update != "no":
                    write()
                    failure = f"{problem}; wrote it; look at it, and run the test again"
        except (RuntimeError, OSError, ContentElsewhere) as problem:
            # The place in the scene helps more than the place in Mitsuba's code.
            failure = re.sub(r"^\[\S+:\d+\] ", "", str(problem))
        if failure:
            pytest.fail(failure, False)
        title = os.path.relpath(path, self.references).removesuffix(".exr")
        report = self._report(comparison, title, scene, path)
        if comparison.status is not Status.FAIL:
            self.node.add_report_section("call", "render difference", str(comparison))
            self._warn_of_undecided(title, comparison, sensor)
            return comparison
        if self.update != "no":
            write()
            report += f'\nwrote the reference "{path}" again'
        pytest.fail(f"{comparison}{report}", False)

    def _located(self, scene: GivenScene) -> GivenScene:
        if not isinstance(scene, (str, Path)):
            return scene
        folders = dict.fromkeys([self.node.path.parent, self.node.config.rootpath])
        found = next((folder / scene for folder in folders if (folder / scene).is_file()), None)
        if found is None:
            pytest.fail(f'scene "{scene}" is not a file in {" or ".join(map(str, folders))}', False)
        return Path(os.path.relpath(found)) if found.is_relative_to(Path.cwd()) else found

    def _path_of_reference(self, scene: GivenScene, name: str | None, settings: _Settings) -> Path:
        if name is not None:
            if not re.fullmatch(r"[\w.-]+", name):
                raise RegressionError(f'reference name "{name}"; expected letters, digits, ".", "_" and "-" only')
            return self.references / f"{name}.exr"
        if not isinstance(scene, Path):
            raise RegressionError("a scene that is no file has no name; expected render_regression(scene, name=..)")
        relative = Path(os.path.relpath(scene, self.node.config.rootpath)).parent
        folder = self.references.joinpath(*(part for part in relative.parts if part not in ("..", os.sep)))
        path, old = folder / f"{scene.stem}{_suffix(settings)}.exr", self.references / f"{scene.stem}.exr"
        if not path.exists() and old.is_file():  # Older versions named references by the scene's file only
            with suppress(RegressionError):
                made_of = load_image(old).metadata
                if _settings_of(made_of) == settings and _scene_of(made_of, old) in (None, scene.resolve()):
                    return old
        return path

    def _claim(self, path: Path, scene: GivenScene, settings: _Settings) -> None:
        """Fail if another scene of this run has the same reference; record this one for pytest's summary."""
        words = f"{scene if isinstance(scene, Path) else 'a scene in memory'}{_suffix(settings)}"
        other, test = self.node.config.stash.setdefault(CLAIMS, {}).setdefault(path, (words, self.node.nodeid))
        if other != words:
            pytest.fail(f'"{path}" is the reference of "{other}" in {test}, and of "{words}" here; {NAME}', False)
        self.node.user_properties.append(("render_reference", os.path.relpath(path, self.references)))

    def _warn_of_undecided(self, name: str, comparison: Comparison, sensor: int | None) -> None:
        count, lines = comparison.test.metadata["sensors"], comparison.undecided()
        if sensor is None and count > 1:
            lines.append(f"sensor 0 of {count} was compared; sensor=1 compares another, sensor=0 only this one")
        for line in lines:
            self.node.user_properties.append(("render_undecided", f"{name}: {line}"))
            warnings.warn(RenderWarning(f"{name}: {line}"), stacklevel=3)

    def _report(self, comparison: Comparison, name: str, scene: GivenScene, path: Path) -> str:
        """Write a report if the settings request one, in place of an earlier one; returns a line with its path."""
        folder = self.results / re.sub(r"[^\w.-]+", "-", f"{self.node.nodeid}-{name}").strip("-")
        if (folder / NUMBERS).is_file():
            shutil.rmtree(folder)
            self.reported = True
        if self.reports == "none" or (self.reports == "failures" and comparison.status is not Status.FAIL):
            return ""
        try:
            page = write_report(folder, comparison, f"{name}: {self.node.nodeid}")
            files = {"reference": path, **({"scene": scene} if isinstance(scene, Path) else {})}
            of_test = {key: os.path.relpath(file, folder) for key, file in files.items()}
            save_image(folder / "test.exr", replace(comparison.test, metadata={**comparison.test.metadata, **of_test}))
        except (OSError, RegressionError) as error:
            return f"\n  no report: {error}"
        self.reported = True
        return f"\n  report: {page}"


def _settings_of(metadata: dict[str, Any]) -> _Settings:
    return metadata.get("parameters", {}), metadata.get("sensor", 0)


def _suffix(settings: _Settings) -> str:
    """The settings as part of a name, or their checksum if they are no valid file name."""
    values = {**settings[0], **({"sensor": str(settings[1])} if settings[1] else {})}
    text = "".join(f"-{key}={value}" for key, value in sorted(values.items()))
    if re.fullmatch(r"[\w.,=+-]{0,80}", text):
        return text
    return "-" + hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


def _scene_of(metadata: dict[str, Any], path: Path) -> Path | None:
    scene = (path.parent / metadata["scene"]).resolve() if "scene" in metadata else None
    return scene if scene is not None and scene.is_file() else None


def _require_same_scene(reference: Image, path: Path, scene: GivenScene, settings: _Settings) -> None:
    """Fail if a reference shows another scene; raise UnusableReference if it has other parameters."""
    other = _scene_of(reference.metadata, path)
    if other and isinstance(scene, Path) and other != scene.resolve():
        pytest.fail(f'"{path}" is the reference of "{other}", this test renders "{scene.resolve()}"; {NAME}', False)
    stored = _settings_of(reference.metadata)
    if stored != settings:
        texts = ["parameters {} and sensor {}".format(*values) for values in (stored, settings)]
        raise renders.UnusableReference(f'the reference "{path}" was made with {texts[0]}; this test has {texts[1]}')
