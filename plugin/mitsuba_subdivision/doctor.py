"""The command `mitsuba-subdivision doctor`: versions, and tests of all variants."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import re
import signal
import subprocess
import sys
import time
from typing import Any

from .llvm import loaded_version, lowest_version, select_llvm, version_without_package
from .variants import variant_problem

# Variants to test, and whether a missing device is a problem.
VARIANTS = {"scalar_rgb": True, "llvm_ad_rgb": True, "cuda_ad_rgb": False}
PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "OpenEXR")
DISTRIBUTION = "mitsuba-subdivision"
_FOR_DEVELOPERS = ("dev", "test")  # Extras for developers of this package
SECONDS = 120  # The start of Mitsuba on a slow disk takes some seconds, and a GPU's first kernels some more
# Height of a cube's limit surface amid a face, for corners at -1 and 1: the limit mask of vertices of the refined cube.
CUBE_HEIGHT = 68 / 81
_PIXEL = 1e-6  # Half the side of the pixel, small enough for a constant height
TOLERANCE = 1e-5
_CHILD = "import json, sys; from mitsuba_subdivision import doctor; print(json.dumps(doctor._report(sys.argv[1])))"


def diagnose(variants: dict[str, bool] | None = None) -> dict[str, Any]:
    """Collect versions, and render a small surface in each variant of `VARIANTS`, each in its own process."""
    from . import __version__

    versions = {DISTRIBUTION: __version__, "Python": platform.python_version(), **{n: _version(n) for n in PACKAGES}}
    tried = {name: try_variant(name, needed) for name, needed in (VARIANTS if variants is None else variants).items()}
    return {
        "versions": versions,
        "machine": platform.platform(),
        "llvm": select_llvm()._asdict(),
        "late_llvm": version_without_package(),
        "variants": tried,
        "extras": _extras(),
        "healthy": None not in versions.values() and all(report["works"] is not False for report in tried.values()),
    }


def in_words(diagnosis: dict[str, Any]) -> str:
    """Lines of text for the results of `diagnose`."""
    llvm, late = diagnosis["llvm"], diagnosis["late_llvm"]
    lines = [("machine", diagnosis["machine"])]
    lines += [(name, version or "MISSING") for name, version in diagnosis["versions"].items()]
    version = f", version {llvm['version']}" if llvm["version"] else ""
    lines.append(("LLVM", f"{llvm['path'] or 'none chosen'}{version} ({llvm['reason']})"))
    crashes = ", whose kernels end the process: import mitsuba_subdivision before mitsuba and drjit"
    too_old = crashes if late and late < lowest_version() else ""
    lines.append(("LLVM, Mitsuba first", f"version {late}{too_old}" if late else "none"))
    for name, report in diagnosis["variants"].items():
        if report["works"]:
            exact = report["exact_problem"] or "exact shading works"
            loaded = f", LLVM {report['llvm']}" if report["llvm"] and name.startswith("llvm") else ""
            lines.append((name, f"works ({report['seconds']:.1f} s{loaded}); {exact}"))
        else:
            lines.append((name, f"{'not available' if report['works'] is None else 'FAILS'}: {report['problem']}"))
    for name, packages in diagnosis["extras"].items():
        listed = ", ".join(f"{package} {version or 'is not installed'}" for package, version in packages.items())
        lines.append((f"extra {name}", listed))
    all_works = "everything that this machine should support works"
    verdict = all_works if diagnosis["healthy"] else "there are PROBLEMS, listed above"
    width = max(len(name) for name, _ in lines)
    return "\n".join([*(f"{name:{width}}  {text}" for name, text in lines), verdict])


def try_variant(variant: str, needed: bool = True, seconds: float = SECONDS) -> dict[str, Any]:
    """Render a small surface in a separate process with a time limit, to report crashes.

    "works" is whether the surface is at the right place, or None if the machine lacks the device of an optional
    variant; "problem" is the reason; "exact_shading" and "exact_problem" likewise. "llvm" is as of `loaded_version`.
    """
    start = time.monotonic()
    report = _in_process(variant, seconds)
    if report["works"] is None and needed:
        report["works"] = False
    nothing = {"problem": None, "exact_shading": False, "exact_problem": None, "llvm": None}
    return {**nothing, **report, "seconds": round(time.monotonic() - start, 2)}


def _in_process(variant: str, seconds: float) -> dict[str, Any]:
    command = [sys.executable, "-c", _CHILD, variant]
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return {"works": False, "problem": f"did not end within {seconds:g} s"}
    if done.returncode < 0:
        names = {number.value: number.name for number in signal.Signals}
        name = names.get(-done.returncode, f"signal {-done.returncode}")
        return {"works": False, "problem": f"the process crashed ({name})"}
    try:
        return dict(json.loads(done.stdout.splitlines()[-1]))
    except (IndexError, ValueError):
        last = (done.stderr.strip().splitlines() or ["no output"])[-1]
        return {"works": False, "problem": f"the process ended with {done.returncode}: {last}"}


def _report(variant: str) -> dict[str, Any]:
    """Result of `try_variant`, in this process."""
    import mitsuba as mi

    from .shapes.interaction_hook import exact_shading_problem

    report = {"works": None, "llvm": loaded_version()}
    if problem := variant_problem(variant):
        return {**report, "problem": problem}
    mi.set_variant(variant)
    if problem := _problem(shading="vertex", tessellation_rate=2):
        return {**report, "works": False, "problem": problem}
    problem = exact_shading_problem(getattr(mi, variant))
    # With one segment per edge, triangles are far below the surface.
    if problem is None and (wrong := _problem(shading="exact", tessellation_rate=1)):
        problem = f"exact shading does not work: {wrong}"
    return {**report, "works": True, "exact_shading": problem is None, "exact_problem": problem}


def _problem(**parameters: Any) -> str | None:
    """One line about a wrong limit surface of a cube in a render of one pixel; None if it is right."""
    import mitsuba as mi

    from .cage.named_cages import cube

    camera = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    camera = camera @ mi.ScalarTransform4f().scale([_PIXEL, _PIXEL, 1])
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    scene = {
        "type": "scene",
        "integrator": {"type": "aov", "aovs": "position:position"},
        "sensor": {"type": "orthographic", "to_world": camera, "film": film},
        "surface": {"type": "subdivision", **cube().as_properties(mi), **parameters},
    }
    try:
        height = float(mi.TensorXf(mi.render(mi.load_dict(scene), spp=1)).array[2])
    except Exception as error:
        return f"{type(error).__name__}: {(str(error).strip().splitlines() or [''])[-1]}"
    if abs(height - CUBE_HEIGHT) <= TOLERANCE:
        return None
    return f"the limit surface of a cube was rendered at the height {height:.6f}; expected {CUBE_HEIGHT:.6f}"


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _extras() -> dict[str, dict[str, str | None]]:
    try:
        required = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    extras: dict[str, dict[str, str | None]] = {}
    for requirement in required:
        name, extra = re.match(r"[\w.-]+", requirement), re.search(r"extra == ['\"]([\w-]+)['\"]", requirement)
        if name and extra and extra[1] not in _FOR_DEVELOPERS:
            extras.setdefault(extra[1], {})[name[0]] = _version(name[0])
    return extras
