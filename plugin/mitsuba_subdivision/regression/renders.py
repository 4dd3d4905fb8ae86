"""Renders of scenes by passes, references (converged renders), and comparisons with references.

A pass renders a share of an image's batches; passes are merged into the image.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..llvm import best_variant
from ..messages import PROGRAM, timed
from ..variants import environment, variant_problem
from . import ContentElsewhere, RegressionError
from .compare import Comparison, compare
from .image import NOTHING, Estimate, Image, Probe, combine, load_image, require_finite
from .scene import SEEDS, GivenScene, LoadedScene, load_scene, render_pixels
from .tiers import Status, Tolerances

BATCH = 64  # Samples per pixel of a batch
LEAST_BATCHES = 4  # Fewer batches estimate the variance badly
_OF_SAMPLING = ("seed", "batch", "total")
# Entries of the metadata that all passes of an image share.
_SHARED = ("variant", "filter", "sampler", "sensor", "size", "channels", "files", "parameters", *_OF_SAMPLING)


@dataclass(frozen=True)
class Sampling:
    """The samples of an image: batches of ``batch`` samples per pixel; batch b has the seed ``seed + b``."""

    batches: int
    batch: int = BATCH
    seed: int = 0

    @classmethod
    def of_spp(cls, spp: int, batch: int = BATCH, seed: int = 0) -> Sampling:
        """At least ``spp`` samples in at least `LEAST_BATCHES` whole batches."""
        batch = min(batch, max(1, spp // LEAST_BATCHES))
        return cls(max(LEAST_BATCHES, -(-spp // batch)), batch, seed)

    @property
    def spp(self) -> int:
        return self.batches * self.batch

    def share(self, number: int, count: int) -> range:
        """Batches of pass ``number`` of ``count``, where passes count from 1."""
        if not 1 <= number <= count:
            raise RegressionError(f"there is no pass {number} of {count}; expected 1 to {count}")
        if count > self.batches:
            made = f"{self.spp} samples in batches of {self.batch} make {self.batches} batches"
            raise RegressionError(f"{made}, fewer than {count} passes")
        return range((number - 1) * self.batches // count, number * self.batches // count)


def render_pass(
    loaded: LoadedScene, sampling: Sampling, number: int = 1, count: int = 1, *, with_probe: bool = False
) -> Image:
    """Render the batches of one pass; ``with_probe`` adds the first batch alone and the probe to the first pass."""
    share = sampling.share(number, count)
    first: NDArray[np.float32] | None = None
    names: list[str] = []

    def batches() -> Iterable[Estimate]:
        nonlocal first, names
        for index in share:
            at(f"batch {index + 1} of {sampling.batches}")
            seed = (sampling.seed + index) % SEEDS
            pixels = render_pixels(loaded.scene, seed, sampling.batch, sensor=loaded.sensor_index)
            if (film := pixels.shape)[2:] < (3,):
                raise RegressionError(f'the film has the shape {film}; expected R, G, B: pixel_format "rgb" or "rgba"')
            every = loaded.channel_names(pixels.shape[2])
            # Indices have no mean, and shapes' indices depend on other loaded objects; the probe compares them.
            kept = [i for i, name in enumerate(every) if not name.endswith(".I")]
            names, pixels = [every[i] for i in kept], pixels[..., kept]
            first = pixels if first is None else first
            yield Estimate.of_batch(pixels, sampling.batch)

    with timed("Rendering") as at:
        estimate = combine(batches()).stored()  # Rounded, so that a pass is the same after writing and reading
    record = {"seed": sampling.seed, "batch": sampling.batch, "batches": [[share.start, share.stop]]}
    metadata: dict[str, Any] = {
        "version": __version__,
        "variant": mi.variant(),
        "environment": environment(str(mi.variant())),
        "integrator": str(loaded.scene.integrator()).partition("[")[0],
        "filter": loaded.filter,
        "sampler": loaded.sampler,
        "sensor": loaded.sensor_index,
        "sensors": len(loaded.scene.sensors()),
        "channels": names,
        "shapes": [shape.id() for shape in loaded.scene.shapes()],
        "size": list(loaded.size),
        "files": loaded.files,
        "parameters": loaded.parameters,
        "sampling": {**record, "total": sampling.batches, "passes": count},
    }
    paired, probe = None, None
    if with_probe and share.start == 0 and first is not None:
        paired, probe = first.astype(np.float32).astype(np.float64), probe_scene(loaded)
        metadata["paired"] = {"seed": sampling.seed, "spp": sampling.batch}
    name = str(loaded.path or "scene") + (f", pass {number} of {count}" if count > 1 else "")
    return Image(name, estimate.mean, estimate, paired, probe, metadata, tuple(names))


def merge_passes(passes: Sequence[Image], name: str = "merged") -> Image:
    """Merge passes of one image, in any order."""
    if not passes:
        raise RegressionError("no passes to merge; expected at least one")
    for image in passes:
        if image.estimate is None or "sampling" not in image.metadata:
            raise RegressionError(f'"{image.name}" is no pass: it has no variance, or no record of its samples')
    first, *others = ordered = sorted(passes, key=lambda image: image.metadata["sampling"]["batches"])
    for other in others:
        _require_same_image(first, other)
    ranges = _joined(ordered)
    estimate = combine(image.estimate for image in ordered if image.estimate is not None).stored()
    metadata = {**first.metadata, "sampling": {**first.metadata["sampling"], "batches": ranges}}
    # Only the pass with the first batch can have a paired image and a probe.
    return replace(first, name=name, pixels=estimate.mean, estimate=estimate, metadata=metadata)


def missing_passes(image: Image) -> list[int]:
    """Numbers of incomplete passes of a merged image."""
    record = image.metadata["sampling"]
    present = {index for start, stop in record["batches"] for index in range(start, stop)}
    total, passes = record.get("total", max(present) + 1), record.get("passes", 1)
    sampling = Sampling(total, record["batch"], record["seed"])
    return [i for i in range(1, passes + 1) if not present.issuperset(sampling.share(i, passes))]


def _require_same_image(first: Image, other: Image) -> None:
    entries = [{**image.metadata, **image.metadata["sampling"]} for image in (first, other)]
    for key in _SHARED:
        a, b = (of_image.get(key) for of_image in entries)
        if a != b:
            difference = f"{key} is {a} and {b}"
            if isinstance(a, dict) and isinstance(b, dict):
                names = sorted(name for name in {*a, *b} if a.get(name) != b.get(name))
                values = ", ".join(f"{name} is {a.get(name)} and {b.get(name)}" for name in names)
                # Checksums do not help in messages.
                difference = f"of the {key}, {', '.join(names)} differ" if key == "files" else values
            raise RegressionError(f'"{first.name}" and "{other.name}" are not passes of one image: {difference}')


def _joined(ordered: Sequence[Image]) -> list[list[int]]:
    joined: list[list[int]] = []
    ranges = [(*pair, image.name) for image in ordered for pair in image.metadata["sampling"]["batches"]]
    for start, stop, name in sorted(ranges):
        if joined and start < joined[-1][1]:
            raise RegressionError(f'"{name}" has batch {start}, which another pass has as well: it would count twice')
        if joined and start == joined[-1][1]:
            joined[-1][1] = stop
        else:
            joined.append([start, stop])
    return joined


def probe_scene(loaded: LoadedScene) -> Probe:
    """The first hits of the rays through the centres of pixels."""
    width, height = loaded.size
    sensor: Any = loaded.sensor  # Any, as the stubs are for variants with arrays
    scene: Any = loaded.scene

    def first_hit(x: Any, y: Any) -> Any:
        film_position = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
        # Middle of the lens and the spectrum, and opening of the shutter: a probe has no random samples.
        ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, film_position, mi.Point2f(0.5))
        return scene.ray_intersect(ray)

    shapes = scene.shapes()
    if dr.is_jit_v(mi.Float):  # One hit with arrays; in scalar variants, one for each pixel
        pixel = dr.arange(mi.UInt32, width * height)
        hits = [first_hit(mi.Float(pixel % width), mi.Float(pixel // width))]
        dr.eval(hits)
        pointers = hits[0].shape, scene.shapes_dr()
        identity, order = (np.array(dr.reinterpret_array(mi.UInt32, of_shapes)) for of_shapes in pointers)
    else:
        hits = [first_hit(x, y) for y, x in np.ndindex(height, width)]
        identity, order = np.array([id(hit.shape) for hit in hits]), np.array([id(shape) for shape in shapes])
    values = zip(*((hit.is_valid(), hit.p, hit.sh_frame.n, hit.uv, hit.prim_index) for hit in hits), strict=True)
    valid, *vectors, triangle = (
        np.array([np.array(value).T for value in column]).reshape(height, width, -1) for column in values
    )
    position, normal, uv = (np.where(valid, vector, 0).astype(np.float32) for vector in vectors)
    valid, triangle = valid[..., 0], np.where(valid, triangle, NOTHING)[..., 0].astype(np.uint32)
    # Indices of shapes, and faces of their cages.
    shape, element = (np.full((height, width), NOTHING, dtype=np.uint32) for _ in range(2))
    for index, candidate in enumerate(shapes):
        at = valid & (identity == order[index]).reshape(height, width)
        shape[at] = index
        parameters = mi.traverse(candidate) if at.any() and candidate.is_mesh() else {}
        if "face_element" in parameters:
            element[at] = np.array(parameters["face_element"]).astype(np.uint32)[triangle[at]]
    return Probe(position, normal, uv, shape, triangle, element)


TEST_SPP = 256  # Samples per pixel of a test: four batches
REFERENCE_SPP = 16384  # Samples per pixel of a reference, 64 times as many
SEED_STEP = 2**20  # Distance between the seeds of references, tests and second attempts, whose samples differ
RETRY_FACTOR = 4  # Samples of the second attempt, relative to the first


def as_reference(image: Image, scene: Path | None, path: str | Path, tolerances: Tolerances) -> Image:
    """Add tolerances to a finite image, and the command that renders the reference again."""
    require_finite(image)
    limits, made_by = tolerances.as_dict(), image.metadata
    metadata, sampling = {**made_by, "tolerances": limits}, made_by["sampling"]
    if scene is not None:
        # Relative to the reference, so that the working folder makes no difference.
        metadata["scene"] = Path(os.path.relpath(scene, Path(path).parent)).as_posix()
        words = [PROGRAM, "render", metadata["scene"], "-o", Path(path).name, "--reference"]
        values = {"spp": sampling["total"] * sampling["batch"], "batch": sampling["batch"], "seed": sampling["seed"]}
        words += [word for name, value in values.items() for word in (f"--{name}", str(value))]
        words += ["--variant", made_by["variant"], *_assignments("-D", made_by["parameters"])]
        words += ["--sensor", str(made_by["sensor"])] if made_by["sensor"] else []
        words += _assignments("--tolerance", dict(limits.items() - Tolerances().as_dict().items()))
        metadata["command"] = shlex.join(words)
    return replace(image, name=str(path), metadata=metadata)


class UnusableReference(RegressionError):
    """A reference is missing, unreadable, or of another scene, and must be rendered again."""


def load_reference(path: Path) -> Image:
    """Read a reference. Raises UnusableReference if it is missing, damaged, or no reference."""
    if not path.is_file():
        raise UnusableReference(f'there is no reference "{path}"')
    try:
        reference = load_image(path)
    except RegressionError as error:
        raise (error if isinstance(error, ContentElsewhere) else UnusableReference(str(error))) from None
    sampling_of(reference)
    return reference


def sampling_of(reference: Image) -> Sampling:
    """Sampling of a reference. Raises UnusableReference if the reference does not record it."""
    sampling = reference.metadata.get("sampling")
    if reference.estimate is None or not isinstance(sampling, dict):
        command = f"{PROGRAM} render SCENE -o REFERENCE.exr --reference"
        what = f'"{reference.name}" does not say how it was rendered'
        raise UnusableReference(f'{what}; expected a reference, as "{command}" writes')
    return Sampling(sum(stop - start for start, stop in sampling["batches"]), sampling["batch"], sampling["seed"])


def _assignments(option: str, values: Mapping[str, object]) -> list[str]:
    return [word for name, value in sorted(values.items()) for word in (option, f"{name}={value}")]


def variant_for(reference: Image) -> str:
    """Variant of the reference, or the best available one."""
    wanted = reference.metadata.get("variant", "")
    return best_variant() if variant_problem(wanted) else wanted


def render_like(
    reference: Image, source: GivenScene, spp: int = TEST_SPP, seed: int = 0, *, second_attempt: bool = False
) -> Image:
    """Render a scene in the current variant with the settings of a reference, but other samples for each seed.

    The first attempt also has the probe, and the samples of the reference's first batch for the paired tier.
    """
    sampling = sampling_of(reference)
    loaded = _load_like(reference, source)
    first_seed = (sampling.seed + SEED_STEP * (2 * seed + 1 + second_attempt)) % SEEDS
    test = render_pass(loaded, Sampling.of_spp(spp, sampling.batch, first_seed))
    if second_attempt or reference.paired is None:
        return test
    pair = render_pass(loaded, Sampling(1, sampling.batch, sampling.seed), with_probe=True)
    metadata = {**test.metadata, "paired": pair.metadata["paired"]}
    return replace(test, paired=pair.paired, probe=pair.probe, metadata=metadata)


def _load_like(reference: Image, source: GivenScene) -> LoadedScene:
    made = reference.metadata
    loaded = load_scene(source, made.get("parameters"), made.get("filter"), made.get("sensor", 0))
    if loaded.size != reference.size:
        of_scene, of_reference = ("{} x {}".format(*size) for size in (loaded.size, reference.size))
        raise UnusableReference(f'the scene has {of_scene} pixels, the reference "{reference.name}" has {of_reference}')
    return loaded


def compare_scene(
    reference: Image, source: GivenScene, spp: int = TEST_SPP, seed: int = 0, **options: Any
) -> Comparison:
    """Render a scene as its reference was, in the current variant, and `compare` the two with further options of that.

    If only the tile tier fails, a second attempt with four times as many new samples decides. If the paired tier warns,
    as on another machine, and still no tier fails, the tile tier decides with all samples of the reference, so that
    nearly all noise is the same in both.
    """
    test = render_like(reference, source, spp, seed)

    def compared(pixels: Image) -> Comparison:
        metadata = {**test.metadata, "sampling": pixels.metadata["sampling"]}
        image = replace(test, pixels=pixels.pixels, estimate=pixels.estimate, metadata=metadata)
        return compare(reference, image, **options)

    comparison = compared(test)
    failed = [tier for tier in comparison.tiers if tier.status is Status.FAIL]
    if [tier.name for tier in failed] == ["tile"] and test.estimate is not None:
        count = RETRY_FACTOR * int(test.estimate.count.max())
        comparison = compared(render_like(reference, source, count, seed, second_attempt=True))
        what = f"second attempt of the tile tier, with {RETRY_FACTOR} times the samples; the first found"
        comparison.notes.append(f"{what}: {failed[0].lines[0]}")
    paired = comparison.tier("paired")
    if comparison.status is not Status.FAIL and paired and paired.status is Status.WARN:
        comparison = compared(render_pass(_load_like(reference, source), sampling_of(reference)))
        comparison.notes.append("the tile tier compared all samples of the reference, as the paired tier warns")
    return comparison
