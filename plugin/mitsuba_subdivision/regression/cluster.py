"""Rendering the passes of an image on a Dask cluster."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..images.image import Image
from ..progress import timed
from . import RegressionError
from .passes import Sampling, merge_passes, render_pass
from .scene import LoadedScene, load_scene

# A worker may have several threads. But Mitsuba has one variant at a time, and an LLVM variant takes all cores.
_lock = threading.Lock()


def render_on_cluster(
    address: str,
    scene: str | Path,
    parameters: Mapping[str, Any],
    variant: str,
    sampling: Sampling,
    count: int,
    filter_name: str | None = None,
    *,
    with_probe: bool = False,
    load: Callable[[], LoadedScene] | None = None,
) -> Image:
    """Render the passes of an image on the workers of a cluster, and merge them.

    With the box filter and an LLVM variant, the image has the same bits as the same passes on one machine, if the
    workers have that machine's versions and processor.

    Parameters
    ----------
    address : str
        Address of the scheduler, such as "tcp://farm:8786".
    scene : str or Path
        Each worker must find the scene under this path, and have this package.
    count : int
        Number of passes; 0 for as many as the workers have threads.
    load : callable, optional
        Loads what is not a Mitsuba scene on each worker; must be picklable.

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
        threads = sum(client.nthreads().values())
        if not threads:
            raise RegressionError(f'the Dask scheduler at "{address}" has no workers')
        count = count or min(threads, sampling.batches)
        path = str(Path(scene).resolve())
        numbers = list(range(1, count + 1))
        # Not pure, in the sense of Dask: a repeated request renders again.
        futures = client.map(
            _work,
            numbers,
            pure=False,
            job=(path, dict(parameters), variant, sampling, count, filter_name, with_probe, load),
        )
        with timed("Rendering on the cluster"):
            return merge_passes(client.gather(futures))


def _work(number: int, job: tuple[Any, ...]) -> Image:
    """Render one pass; runs on a worker."""
    import mitsuba as mi

    path, parameters, variant, sampling, count, filter_name, with_probe, load = job
    with _lock:
        mi.set_variant(variant)
        loaded = load() if load else load_scene(path, parameters, filter_name)
        return render_pass(loaded, sampling, number, count, with_probe=with_probe)
