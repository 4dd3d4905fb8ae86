"""Rendering by passes: each renders a share of an image's batches, here or on a Dask cluster, and all are merged."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..messages import timed
from ..variants import set_variant
from . import RegressionError
from .image import NOTHING, Estimate, Image, Probe, combine
from .scene import SEEDS, LoadedScene, environment, render_pixels

if TYPE_CHECKING:
    from distributed import Client

# Samples per pixel of a batch, which is rendered at once with a seed of its own.
BATCH = 64
# Fewer batches than these measure the variance badly.
LEAST_BATCHES = 4
# Entries of the metadata that all passes of an image share.
_SHARED = ("variant", "filter", "size", "files", "parameters")
# Mesh attribute of the shape `subdivision`: the face of the cage that each triangle belongs to.
ELEMENT_ATTRIBUTE = "face_element"


@dataclass(frozen=True)
class Sampling:
    """Which samples make an image: batches of ``batch`` samples per pixel; batch b has the seed ``seed + b``."""

    batches: int
    batch: int = BATCH
    seed: int = 0

    @classmethod
    def of_spp(cls, spp: int, batch: int = BATCH, seed: int = 0) -> Sampling:
        """At least ``spp`` samples in whole batches, of which there are at least `LEAST_BATCHES`."""
        batch = min(batch, max(1, spp // LEAST_BATCHES))
        return cls(max(LEAST_BATCHES, -(-spp // batch)), batch, seed)

    @property
    def spp(self) -> int:
        return self.batches * self.batch

    def share(self, number: int, count: int) -> range:
        """Batches of pass ``number`` of ``count``, where passes count from 1.

        Raises RegressionError if there is no such pass, or more passes than batches.
        """
        if not 1 <= number <= count:
            raise RegressionError(f"there is no pass {number} of {count}; expected 1 to {count}")
        if count > self.batches:
            raise RegressionError(
                f"{self.spp} samples in batches of {self.batch} make {self.batches} batches, fewer than {count} passes"
            )
        return range((number - 1) * self.batches // count, number * self.batches // count)


def render_pass(
    loaded: LoadedScene, sampling: Sampling, number: int = 1, count: int = 1, *, with_probe: bool = False
) -> Image:
    """Render the batches of one pass; the first also with the first batch alone and the probe, if ``with_probe``."""
    share = sampling.share(number, count)
    first: NDArray[np.float32] | None = None

    def batches() -> Iterable[Estimate]:
        nonlocal first
        for index in share:
            at(f"batch {index + 1} of {sampling.batches}")
            pixels = render_pixels(loaded.scene, (sampling.seed + index) % SEEDS, sampling.batch)
            if pixels.ndim != 3 or pixels.shape[2] < 3:
                film = f"the film has the shape {pixels.shape}"
                raise RegressionError(f'{film}; expected R, G, B: pixel_format "rgb" or "rgba"')
            pixels = pixels[..., :3]
            first = pixels if first is None else first
            yield Estimate.of_batch(pixels, sampling.batch)

    # Rounded as in a file, so that it does not matter whether a pass was written and read again.
    with timed("Rendering") as at:
        estimate = combine(batches()).stored()
    record = {"seed": sampling.seed, "batch": sampling.batch, "batches": [[share.start, share.stop]]}
    metadata = {**describe(loaded), "sampling": {**record, "total": sampling.batches, "passes": count}}
    paired, probe = None, None
    if with_probe and share.start == 0 and first is not None:
        paired, probe = first.astype(np.float32).astype(np.float64), probe_scene(loaded)
        metadata["paired"] = {"seed": sampling.seed, "spp": sampling.batch}
    name = str(loaded.path or "scene") + (f", pass {number} of {count}" if count > 1 else "")
    return Image(name, estimate.mean, estimate, paired, probe, metadata)


def merge_passes(passes: Sequence[Image], name: str = "merged") -> Image:
    """Merge passes of one image. The order in which they are given makes no difference.

    Raises RegressionError if a file is no pass, passes are of different images, or two have the same samples.
    """
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
    # Only the pass with the first batch can have these.
    paired = next((image for image in ordered if image.paired is not None), None)
    probe = next((image.probe for image in ordered if image.probe is not None), None)
    metadata = {**first.metadata, "sampling": {**first.metadata["sampling"], "batches": ranges}}
    if paired and "paired" in paired.metadata:
        metadata["paired"] = paired.metadata["paired"]
    return Image(name, estimate.mean, estimate, paired.paired if paired else None, probe, metadata)


def missing_passes(image: Image) -> list[int]:
    """Numbers of the passes that a merged image lacks, whole or in part."""
    record = image.metadata["sampling"]
    present = {index for start, stop in record["batches"] for index in range(start, stop)}
    total, passes = record.get("total", max(present) + 1), record.get("passes", 1)
    sampling = Sampling(total, record["batch"], record["seed"])
    return [i for i in range(1, passes + 1) if not present.issuperset(sampling.share(i, passes))]


def describe(loaded: LoadedScene) -> dict[str, Any]:
    """Metadata of a render in the current variant, except for its samples."""
    return {
        "version": __version__,
        "variant": mi.variant(),
        "environment": environment(str(mi.variant())),
        "integrator": str(loaded.scene.integrator()).partition("[")[0],
        "filter": loaded.filter,
        "size": list(loaded.size),
        "files": loaded.files,
        "parameters": loaded.parameters,
    }


def _require_same_image(first: Image, other: Image) -> None:
    pairs = [(key, first.metadata.get(key), other.metadata.get(key)) for key in _SHARED]
    pairs += [(key, *(p.metadata["sampling"].get(key) for p in (first, other))) for key in ("seed", "batch", "total")]
    for key, a, b in pairs:
        if a != b:
            difference = f"{key} is {a} and {b}"
            if isinstance(a, dict) and isinstance(b, dict):
                names = sorted(name for name in {*a, *b} if a.get(name) != b.get(name))
                values = [f"{name} is {a.get(name)} and {b.get(name)}" for name in names]
                # Nobody reads checksums.
                difference = f"of the {key}, {', '.join(names)} differ" if key == "files" else ", ".join(values)
            raise RegressionError(f'"{first.name}" and "{other.name}" are not passes of one image: {difference}')


def _joined(ordered: Sequence[Image]) -> list[list[int]]:
    """Ranges of batches, where neighbouring ranges are joined."""
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
    """Position, normal, uv, shape, triangle and face at the first hits of the rays through the centres of pixels."""
    trace = _trace_arrays if dr.is_jit_v(mi.Float) else _trace_one_by_one
    width, height = loaded.size
    *vectors, triangle, shape = trace(loaded, width, height)
    missed = shape == NOTHING
    for values in vectors:
        values[missed] = 0
    triangle[missed] = NOTHING
    position, normal, uv = (values.reshape(height, width, -1) for values in vectors)
    indices = shape, triangle, _elements(loaded.scene, shape, triangle)
    return Probe(position, normal, uv, *(values.reshape(height, width) for values in indices))


def _trace_arrays(loaded: LoadedScene, width: int, height: int) -> tuple[NDArray, ...]:
    """Position, normal, parameters, triangle and shape that each ray hits, in a variant of arrays."""
    pixel = dr.arange(mi.UInt32, width * height)
    x, y = mi.Float(pixel % width), mi.Float(pixel // width)
    film_position = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
    # Any, as a number is taken for an array.
    sensor: Any = loaded.sensor
    # The middle of the lens and of the spectrum, when the shutter opens: a probe takes no random samples.
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, film_position, mi.Point2f(0.5))
    hit = loaded.scene.ray_intersect(ray)
    # Any, as the stubs have no type for an array of shapes.
    shapes: Any = hit.shape, loaded.scene.shapes_dr()
    identity, order = (np.array(dr.reinterpret_array(mi.UInt32, pointers)) for pointers in shapes)
    shape = np.full(width * height, NOTHING, dtype=np.uint32)
    valid = np.array(hit.is_valid())
    for index, shape_identity in enumerate(order):
        shape[valid & (identity == shape_identity)] = index
    vectors = (np.array(v).T.astype(np.float32).copy() for v in (hit.p, hit.sh_frame.n, hit.uv))
    return *vectors, np.array(hit.prim_index).astype(np.uint32), shape


def _trace_one_by_one(loaded: LoadedScene, width: int, height: int) -> tuple[NDArray, ...]:
    """Trace as `_trace_arrays` does, in a scalar variant."""
    # Any, as the stubs are those of variants with arrays.
    sensor: Any = loaded.sensor
    scene: Any = loaded.scene
    shapes, nothing = scene.shapes(), ([0] * 3, [0] * 3, [0] * 2, NOTHING, NOTHING)
    rows = []
    for y, x in np.ndindex(height, width):
        ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, [(x + 0.5) / width, (y + 0.5) / height], [0.5, 0.5])
        hit = scene.ray_intersect(ray)
        first = hit.p, hit.sh_frame.n, hit.uv, hit.prim_index
        rows.append((*first, shapes.index(hit.shape)) if hit.is_valid() else nothing)
    kinds = np.float32, np.float32, np.float32, np.uint32, np.uint32
    return tuple(np.array(column, dtype=kind) for column, kind in zip(zip(*rows, strict=True), kinds, strict=True))


def _elements(scene: mi.Scene, shape: NDArray[np.uint32], triangle: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Faces of the cage that triangles belong to, `NOTHING` for shapes without a cage."""
    faces = np.full(shape.shape, NOTHING, dtype=np.uint32)
    for index, candidate in enumerate(scene.shapes()):
        at = np.flatnonzero(shape == index)
        parameters = mi.traverse(candidate) if len(at) and candidate.is_mesh() else {}
        if ELEMENT_ATTRIBUTE in parameters:
            elements = np.array(parameters[ELEMENT_ATTRIBUTE]).astype(np.uint32)
            faces[at] = elements[triangle[at]]
    return faces


T = TypeVar("T")

# A worker may have several threads. But Mitsuba has one variant at a time, and an LLVM variant takes all cores.
_lock = threading.Lock()


@contextmanager
def cluster(address: str) -> Iterator[Client]:
    """The cluster of a scheduler, at an address such as "tcp://farm:8786".

    Raises RegressionError if `distributed` is not installed, or the cluster is not there.
    """
    try:
        from distributed import Client
    except ImportError:
        raise RegressionError("Dask is not installed: pip install 'mitsuba-subdivision[dask]'") from None
    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError) as error:
        raise RegressionError(f'no Dask scheduler at "{address}": {error}') from None
    with client:
        if not client.nthreads():
            raise RegressionError(f'the Dask scheduler at "{address}" has no workers')
        yield client


def results(client: Client, work: Callable[[int], T], variant: str, numbers: Sequence[int]) -> Iterator[tuple[int, T]]:
    """Numbers and what the workers of a cluster make of them, in the order in which they finish.

    Where a worker ends early, another one repeats its work, one call at a time in each, in a variant of Mitsuba. The
    work must be picklable.
    """
    from distributed import as_completed

    # Not pure, in the sense of Dask: a repeated request renders again.
    futures = as_completed(client.map(partial(_work, work, variant), numbers, pure=False), with_results=True)
    return (result for _, result in futures)


def _work(work: Callable[[int], T], variant: str, number: int) -> tuple[int, T]:
    """Runs on a worker."""
    with _lock:
        set_variant(variant)
        return number, work(number)


def render_on_cluster(
    address: str,
    load: Callable[[], LoadedScene],
    variant: str,
    sampling: Sampling,
    count: int,
    *,
    with_probe: bool = False,
) -> Image:
    """Render the passes of an image on the workers of a cluster, and merge them.

    With the box filter and an LLVM variant, the image has the same bits as the same passes on one machine, if the
    workers have that machine's versions and processor. Each loads the scene by ``load``, which must be picklable. A
    ``count`` of 0 makes as many passes as the workers have threads.
    """
    with cluster(address) as client, timed("Rendering on the cluster"):
        count = count or min(sum(client.nthreads().values()), sampling.batches)

        def work(number: int) -> Image:
            return render_pass(load(), sampling, number, count, with_probe=with_probe)

        return merge_passes([image for _, image in results(client, work, variant, range(1, count + 1))])
