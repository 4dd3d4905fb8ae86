"""Work on a Dask cluster: passes of an image, or pictures."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from ..images.image import Image
from ..progress import timed
from ..variants import set_variant
from . import RegressionError
from .passes import Sampling, merge_passes, render_pass
from .scene import LoadedScene

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")

# A worker may have several threads. But Mitsuba has one variant at a time, and an LLVM variant takes all cores.
_lock = threading.Lock()


@contextmanager
def cluster(address: str) -> Iterator[Client]:
    """The cluster of a scheduler, at an address such as "tcp://farm:8786".

    Raises
    ------
    RegressionError
        If `distributed` is not installed, or the cluster is not there.
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

    Where a worker ends early, another one repeats its work.

    Parameters
    ----------
    work : callable
        Runs on the workers, one call at a time in each; must be picklable.
    variant : str
        Of Mitsuba, set on the workers.
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
    workers have that machine's versions and processor.

    Parameters
    ----------
    address : str
        Address of the scheduler, such as "tcp://farm:8786".
    load : callable
        Loads the scene on each worker, which must have this package and find the files; must be picklable.
    count : int
        Number of passes; 0 for as many as the workers have threads.

    Raises
    ------
    RegressionError
        If `distributed` is not installed, or the cluster is not there.
    """
    with cluster(address) as client, timed("Rendering on the cluster"):
        count = count or min(sum(client.nthreads().values()), sampling.batches)
        work = partial(_render_pass, load, sampling, count, with_probe)
        return merge_passes([image for _, image in results(client, work, variant, range(1, count + 1))])


def _render_pass(
    load: Callable[[], LoadedScene], sampling: Sampling, count: int, with_probe: bool, number: int
) -> Image:
    return render_pass(load(), sampling, number, count, with_probe=with_probe)
