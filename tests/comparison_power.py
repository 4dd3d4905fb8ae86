"""What comparisons of renders notice, and how often they fail where nothing has changed.

Five scenes, four of them with rare bright paths, are rendered unchanged and with small changes, with other seeds than
their references. Each render is compared by the tile tier; by Mitsuba's own z-test of pixels; by FLIP; and by idiff
where it is installed.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

# Before Mitsuba, so that Dr.Jit finds an LLVM library that works.
import mitsuba_subdivision  # noqa: F401

# isort: split
import mitsuba as mi
import numpy as np
from mitsuba_subdivision.regression.compare import compare
from mitsuba_subdivision.regression.image import Image, load_image, save_image
from mitsuba_subdivision.regression.renders import Sampling, render_pass
from mitsuba_subdivision.regression.scene import LoadedScene, load_scene
from mitsuba_subdivision.regression.tiers import Status
from regression.defects import stam
from scipy.special import ndtr

SIZE = 64  # Of `valence5`, and by default of the others
REFERENCE_SPP, BATCHES = 16384, 4
# Far from the seeds of the references.
FIRST_SEED = 10_000_000
# What a pixel covers, in radians: to move a camera by parts of a pixel.
FIELD_OF_VIEW = 40.0
PIXEL = np.radians(FIELD_OF_VIEW) / SIZE
PIXEL_SUCCESS_RATE, LEAST_VARIANCE, ALPHA = 0.9975, 1e-4, 0.01
XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
IDIFF = ["idiff", "-q", "-fail", "0.05", "-failpercent", "1"]

FOLDER = Path(__file__).parent / "data" / "comparison"
# These have cameras and albedos of their own.
IN_FOLDER = ("balls", "caustics", "room", "fog")
# What the camera looks to, and from where.
PLACES = ("default[@name='target']", "value"), (".//lookat", "origin")


def made(name: str, sampler: str, size: int, albedo: float = 1.0, shift: float = 0.0) -> LoadedScene:
    """A scene with other albedos, whose camera is turned to the right by a part of a pixel."""
    if name == "valence5":
        return load_scene(valence5(albedo, shift))
    file = FOLDER / f"{name}.xml"
    root = ElementTree.parse(file)

    def numbers(text: str) -> np.ndarray:
        return np.array(text.split(","), dtype=float)

    # Parameters of these scenes are albedos, and the point that the camera looks to.
    entries = [entry.attrib for entry in root.iter("default") if entry.attrib["name"] not in ("sampler", "size")]
    values = {entry["name"]: albedo * numbers(entry["value"]) for entry in entries}
    target, origin = (numbers(root.find(path).attrib[key]) for path, key in PLACES)
    ahead = target - origin
    right = np.cross(ahead, [0, 0, 1])
    values["target"] = target + right / np.linalg.norm(right) * np.linalg.norm(ahead) * shift * PIXEL
    words = {key: ", ".join(map(repr, value.tolist())) for key, value in values.items()}
    words |= {"sampler": sampler, "size": size}
    return load_scene(file, words, "box")


def valence5(albedo: float, shift: float) -> mi.Scene:
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


SCENES = [*IN_FOLDER, "valence5"]
# Grey but for a blue sky, so that RGB and spectra agree; with caustics, room and fog, they are ten.
OF_EVERY_VARIANT = ["sky", "ball", "shadow", "rough", "plastic", "checker", "surface"]
CHANGES: dict[str, dict[str, float]] = {"unchanged": {}}
CHANGES |= {f"albedo + {part:g} %": {"albedo": 1 + part / 100} for part in (0.1, 1, 4)}
CHANGES |= {f"camera {part:g} px": {"shift": part} for part in (0.05, 0.5)}
STAM = "Stam's normals"


def rendered(
    name: str, change: str, kind: str, size: int, spp: int, batches: int, seeds: range, cache: Path
) -> Iterator[Image]:
    """Renders of a scene, one for each seed, kept in a folder; a kind is a variant and a sampler."""
    loaded = None
    variant, sampler = kind.split("/")
    for seed in seeds:
        path = cache / f"{variant} {sampler} {size} {name} {change} {spp} {seed}.exr".replace(" ", "-")
        if not path.exists():
            mi.set_variant(variant)
            scene = partial(made, name, sampler, size, **CHANGES.get(change, {}))
            loaded = loaded or (load_scene(stam(5)) if change == STAM else scene())
            save_image(path, render_pass(loaded, Sampling(batches, spp // batches, seed)))
        yield load_image(path)


def fails(tier: str, reference: Image, test: Image) -> bool:
    return compare(reference, test, [tier]).status is Status.FAIL


def mitsuba_z_test(reference: Image, test: Image) -> bool:
    """The rule of Mitsuba's src/render/tests/test_renders.py: enough pixels must pass, by the reference's variance."""
    variance = np.maximum(reference.estimate.variance @ (XYZ**2).T, LEAST_VARIANCE)
    z = np.abs((test.pixels - reference.pixels) @ XYZ.T) * np.sqrt(test.estimate.count[..., None] / variance)
    limit = 1 - (1 - ALPHA) ** (1 / test.estimate.count.size)
    return bool(np.mean(2 * ndtr(-z) > limit) < PIXEL_SUCCESS_RATE)


def idiff(reference: Image, test: Image) -> bool:
    return subprocess.run([*IDIFF, reference.name, test.name], capture_output=True, check=False).returncode == 2


RULES = {"tile": partial(fails, "tile"), "Mitsuba": mitsuba_z_test, "FLIP": partial(fails, "flip"), "idiff": idiff}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=SCENES, choices=[*SCENES, *OF_EVERY_VARIANT])
    parser.add_argument("--changes", nargs="+", default=[*CHANGES, STAM], choices=[*CHANGES, STAM])
    parser.add_argument("--rules", nargs="+", default=list(RULES), choices=RULES)
    kinds = {"nargs": "+", "default": ["llvm_ad_rgb/independent"], "metavar": "VARIANT/SAMPLER"}
    parser.add_argument("--references", **kinds)
    parser.add_argument("--tests", **kinds)
    parser.add_argument("--size", type=int, default=SIZE)
    parser.add_argument("--spp", nargs="+", type=int, default=[64, 256])
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--cache", type=Path, help="folder that keeps the renders")
    options = parser.parse_args()
    cache = options.cache or Path(tempfile.mkdtemp())
    rules = [name for name in options.rules if name != "idiff" or shutil.which("idiff")]
    print(f"{'scene':12}{'change':17}{'spp':>5}{'seeds':>6}" + "".join(f"{name:>9}" for name in rules))
    seeds = range(FIRST_SEED, FIRST_SEED + BATCHES * options.seeds, BATCHES)
    for of_reference, of_test, name in itertools.product(options.references, options.tests, options.scenes):
        one = REFERENCE_SPP, REFERENCE_SPP // 64, range(1), cache
        (reference,) = rendered(name, "unchanged", of_reference, options.size, *one)
        for change in (each for each in options.changes if each != STAM or name == "valence5"):
            for spp in options.spp:
                failed = np.zeros(len(rules), int)
                for test in rendered(name, change, of_test, options.size, spp, BATCHES, seeds, cache):
                    failed += [RULES[rule](reference, test) for rule in rules]
                counts = "".join(f"{count:9}" for count in failed)
                print(f"{name:12}{change:17}{spp:5}{options.seeds:6}{counts}  {of_reference} {of_test}", flush=True)


if __name__ == "__main__":
    main()
