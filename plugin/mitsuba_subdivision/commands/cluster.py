"""Frames and passes on the workers of a Dask cluster."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import mitsuba as mi

from ..messages import timed
from ..regression import RegressionError
from ..regression.image import Image
from ..regression.renders import Sampling, merge_passes, render_pass
from ..regression.scene import LoadedScene
from ..variants import set_variant

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")

# One render at a time in a worker: Mitsuba has one variant at a time, and an LLVM variant uses all cores.
_lock = threading.Lock()


@contextmanager
def cluster(address: str) -> Iterator[Client]:
    """The cluster of a scheduler, at an address such as "tcp://farm:8786"."""
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


def results(client: Client, work: Callable[[int], T], numbers: Sequence[int]) -> Iterator[tuple[int, T]]:
    """Numbers and results of picklable work, in the order of completion; work of lost workers is repeated."""
    from distributed import as_completed

    # Not pure in Dask's sense: a repeated request renders again.
    futures = as_completed(client.map(partial(_work, work, str(mi.variant())), numbers, pure=False), with_results=True)
    return (result for _, result in futures)


def _work(work: Callable[[int], T], variant: str, number: int) -> tuple[int, T]:
    with _lock:
        set_variant(variant)
        return number, work(number)


def render_on_cluster(
    address: str,
    load: Callable[[], LoadedScene],  # Picklable
    sampling: Sampling,
    count: int,  # 0 for the number of threads
    *,
    with_probe: bool = False,
) -> Image:
    """Render passes of an image on the workers of a cluster, by default one for each of their threads, and merge them.

    With the box filter and an LLVM variant, the image has the same bits as the same passes on one machine with the
    workers' versions and processor.
    """
    with cluster(address) as client, timed("Rendering on the cluster"):
        count = count or min(sum(client.nthreads().values()), sampling.batches)

        def work(number: int) -> Image:
            return render_pass(load(), sampling, number, count, with_probe=with_probe)

        return merge_passes([image for _, image in results(client, work, range(1, count + 1))])
