# ruff: noqa: T201
"""What comparisons of renders notice, and how often they fail where nothing has changed.

Five scenes, four of them with rare bright paths, are rendered unchanged and with small changes, with other seeds than
their references. Each render is compared by the tile tier; by the same tiles with normally distributed noise, of the
variance that the reference has; by Mitsuba's own z-test of pixels; by FLIP; and by idiff where it is installed.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

# Before Mitsuba, so that Dr.Jit finds an LLVM library that works.
import mitsuba_subdivision  # noqa: F401

# isort: split
import mitsuba as mi
import numpy as np
from mitsuba_subdivision.regression.compare import compare
from mitsuba_subdivision.regression.image import Image, load_image, save_image
from mitsuba_subdivision.regression.renders import Sampling, render_pass
from mitsuba_subdivision.regression.scene import load_scene
from mitsuba_subdivision.regression.tiers import Status
from regression.defects import stam
from scipy.special import ndtr

SIZE = 64
REFERENCE_SPP, BATCHES = 16384, 4
# Far from the seeds of the references.
FIRST_SEED = 10_000_000
# What a pixel covers, in radians: to move a camera by parts of a pixel.
FIELD_OF_VIEW = 40.0
PIXEL = np.radians(FIELD_OF_VIEW) / SIZE
PIXEL_SUCCESS_RATE, LEAST_VARIANCE, ALPHA = 0.9975, 1e-4, 0.01
XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
IDIFF = ["idiff", "-q", "-fail", "0.05", "-failpercent", "1"]

PATHS = {"type": "path", "max_depth": 8}
GLASS = {"type": "dielectric"}

Scene = dict[str, Any]


def diffuse(*rgb: float) -> Scene:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}


def placed(type_name: str, bsdf: Scene, position: list[float], scale: Any, **more: Any) -> Scene:
    return {"type": type_name, "bsdf": bsdf, "to_world": transform().translate(position).scale(scale), **more}


def light(radiance: float) -> Scene:
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}}


def lamp(center: list[float], radius: float, radiance: float) -> Scene:
    return {"type": "sphere", "center": center, "radius": radius, "emitter": light(radiance)}


def transform() -> Any:
    return mi.ScalarTransform4f()


def empty(integrator: Scene, origin: list[float], target: list[float], shift: float) -> Scene:
    """A scene whose camera is turned to the right by a part of a pixel."""
    ahead = np.subtract(target, origin)
    right = np.cross(ahead, [0, 0, 1])
    target = np.add(target, right / np.linalg.norm(right) * np.linalg.norm(ahead) * shift * PIXEL).tolist()
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": FIELD_OF_VIEW, "film": film}
    camera["to_world"] = transform().look_at(origin, target, [0, 0, 1])
    return {"type": "scene", "integrator": integrator, "camera": camera}


def balls(albedo: float = 1.0, shift: float = 0.0) -> Scene:
    """A glass ball, a rough copper ball and a cube on a checkerboard, under a small lamp."""
    board = {"type": "checkerboard", "to_uv": transform().scale(8.0), "color0": 0.2, "color1": 0.6 * albedo}
    return empty(PATHS, [0, -7, 3.5], [0, 0, 0.5], shift) | {
        "floor": placed("rectangle", {"type": "diffuse", "reflectance": board}, [0, 0, 0], 5.0),
        "glass": placed("sphere", GLASS, [-1.2, 0, 1], 1.0),
        "copper": placed("sphere", {"type": "roughconductor", "material": "Cu", "alpha": 0.1}, [1.3, 0.5, 0.8], 0.8),
        "cube": placed("cube", diffuse(0.6 * albedo, 0.3 * albedo, 0.2 * albedo), [0.2, -1.6, 0.35], 0.35),
        "lamp": lamp([1.5, -1.5, 5], 0.15, 400.0),
        "sky": {"type": "constant", "radiance": 0.05},
    }


def caustics(albedo: float = 1.0, shift: float = 0.0) -> Scene:
    """Light that reaches the floor through a glass ball and off a mirror, from a lamp that is hard to hit."""
    return empty(PATHS, [0, -6, 4], [0, 0, 0.3], shift) | {
        "floor": placed("rectangle", diffuse(*[0.5 * albedo] * 3), [0, 0, 0], 4.0),
        "glass": placed("sphere", GLASS, [-0.9, 0, 0.9], 0.8),
        "mirror": placed("sphere", {"type": "conductor"}, [1.1, 0.3, 0.7], 0.7),
        "lamp": lamp([-2, 1, 4], 0.1, 500.0),
    }


def room(albedo: float = 1.0, shift: float = 0.0) -> Scene:
    """A dark room that light enters from a bright sky, through a small window, past a glossy box."""
    wall, at = diffuse(*[0.6 * albedo] * 3), transform().translate
    places = {
        "floor": at([0, 0, -1]).rotate([1, 0, 0], 0),
        "ceiling": at([0, 0, 1]).rotate([1, 0, 0], 180),
        "back": at([0, 1, 0]).rotate([1, 0, 0], 90),
        "left": at([-1, 0, 0]).rotate([0, 1, 0], 90),
        # The right wall is two halves with a gap between them.
        "below": at([1, 0, -0.57]).rotate([0, 1, 0], -90).scale([0.43, 1, 1]),
        "above": at([1, 0, 0.57]).rotate([0, 1, 0], -90).scale([0.43, 1, 1]),
        "front": at([0, -1, 0]).rotate([1, 0, 0], -90),
    }
    window = at([2, 0, 0.3]).rotate([0, 1, 0], -90).scale(0.3)
    return empty(PATHS, [-0.1, -0.98, 0.1], [-0.1, 1, -0.3], shift) | {
        **{name: {"type": "rectangle", "bsdf": wall, "to_world": place} for name, place in places.items()},
        "box": placed("cube", {"type": "roughconductor", "alpha": 0.15}, [0.2, 0.3, -0.7], 0.3),
        "window": {"type": "rectangle", "to_world": window, "emitter": light(60.0)},
    }


def fog(albedo: float = 1.0, shift: float = 0.0) -> Scene:
    """Two balls in fog, lit by a small lamp within it."""
    medium = {"type": "homogeneous", "albedo": 0.9, "sigma_t": 0.25, "phase": {"type": "hg", "g": 0.6}}
    ball = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": 0.5 * albedo}}
    return empty({"type": "volpathmis", "max_depth": 8}, [0, -5, 1.5], [0, 0, 0.5], shift) | {
        "bounds": placed("sphere", {"type": "null"}, [0, 0, 0], 9.0, interior=medium),
        "floor": placed("rectangle", diffuse(*[0.4 * albedo] * 3), [0, 0, -0.5], 4.0),
        "one": placed("sphere", ball, [-0.9, 0, 0.3], 0.8),
        "two": placed("sphere", GLASS, [0.9, 0, 0.3], 0.7),
        "lamp": lamp([0.4, 1.2, 2.2], 0.1, 150.0),
    }


def valence5(albedo: float = 1.0, shift: float = 0.0) -> mi.Scene:
    """The scene `scenes/valence5.xml`: a diffuse limit surface under a large lamp."""
    loaded = load_scene(Path("scenes/valence5.xml"), {"resolution": SIZE}, "box").scene
    parameters = mi.traverse(loaded)
    name = next(key for key in parameters.keys() if key.endswith("bsdf.reflectance.value"))  # noqa: SIM118
    parameters[name] *= albedo
    parameters.update()
    camera = mi.traverse(loaded.sensors()[0])
    degrees = -shift * float(np.ravel(camera["x_fov"])[0]) / SIZE
    camera["to_world"] = camera["to_world"] @ mi.Transform4f().rotate([0, 1, 0], degrees)
    camera.update()
    return loaded


SCENES: dict[str, Callable[..., Any]] = {f.__name__: f for f in (balls, caustics, room, fog, valence5)}
CHANGES: dict[str, dict[str, float]] = {"unchanged": {}}
CHANGES |= {f"albedo + {part:g} %": {"albedo": 1 + part / 100} for part in (0.1, 1, 4)}
CHANGES |= {f"camera {part:g} px": {"shift": part} for part in (0.05, 0.5)}
STAM = "Stam's normals"


def rendered(name: str, change: str, spp: int, batches: int, seeds: range, cache: Path) -> Iterator[Image]:
    """Renders of a scene, one for each seed, kept in a folder."""
    loaded = None
    for seed in seeds:
        path = cache / f"{mi.variant()} {name} {change} {spp} {seed}.exr".replace(" ", "-")
        if not path.exists():
            loaded = loaded or load_scene(stam(5) if change == STAM else SCENES[name](**CHANGES[change]))
            save_image(path, render_pass(loaded, Sampling(batches, spp // batches, seed)))
        yield load_image(path)


def fails(tier: str, reference: Image, test: Image) -> bool:
    return compare(reference, test, [tier]).status is Status.FAIL


def normal_tiles(reference: Image, test: Image) -> bool:
    """The tile tier without rare events: the test's own variance shows none, as it is the reference's."""
    estimate = replace(test.estimate, variance=reference.estimate.variance)
    return fails("tile", reference, replace(test, estimate=estimate))


def mitsuba_z_test(reference: Image, test: Image) -> bool:
    """The rule of Mitsuba's src/render/tests/test_renders.py: enough pixels must pass, by the reference's variance."""
    variance = np.maximum(reference.estimate.variance @ (XYZ**2).T, LEAST_VARIANCE)
    z = np.abs((test.pixels - reference.pixels) @ XYZ.T) * np.sqrt(test.estimate.count[..., None] / variance)
    limit = 1 - (1 - ALPHA) ** (1 / test.estimate.count.size)
    return bool(np.mean(2 * ndtr(-z) > limit) < PIXEL_SUCCESS_RATE)


def idiff(reference: Image, test: Image) -> bool:
    return subprocess.run([*IDIFF, reference.name, test.name], capture_output=True, check=False).returncode == 2


RULES = {
    "tile": partial(fails, "tile"),
    "normal": normal_tiles,
    "Mitsuba": mitsuba_z_test,
    "FLIP": partial(fails, "flip"),
    "idiff": idiff,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--changes", nargs="+", default=[*CHANGES, STAM], choices=[*CHANGES, STAM])
    parser.add_argument("--rules", nargs="+", default=list(RULES), choices=RULES)
    parser.add_argument("--variant", default="llvm_ad_rgb", help="of the tests; references are of llvm_ad_rgb")
    parser.add_argument("--spp", nargs="+", type=int, default=[64, 256])
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--cache", type=Path, help="folder that keeps the renders")
    options = parser.parse_args()
    cache = options.cache or Path(tempfile.mkdtemp())
    rules = [name for name in options.rules if name != "idiff" or shutil.which("idiff")]
    print(f"{'scene':10}{'change':17}{'spp':>5}{'seeds':>6}" + "".join(f"{name:>9}" for name in rules))
    seeds = range(FIRST_SEED, FIRST_SEED + BATCHES * options.seeds, BATCHES)
    for name in options.scenes:
        mi.set_variant("llvm_ad_rgb")
        (reference,) = rendered(name, "unchanged", REFERENCE_SPP, REFERENCE_SPP // 64, range(1), cache)
        mi.set_variant(options.variant)
        for change in (each for each in options.changes if each != STAM or name == "valence5"):
            for spp in options.spp:
                failed = np.zeros(len(rules), int)
                for test in rendered(name, change, spp, BATCHES, seeds, cache):
                    failed += [RULES[rule](reference, test) for rule in rules]
                counts = "".join(f"{count:9}" for count in failed)
                print(f"{name:10}{change:17}{spp:5}{options.seeds:6}{counts}", flush=True)


if __name__ == "__main__":
    main()
