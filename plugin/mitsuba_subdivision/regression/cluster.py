"""Passes on a Dask cluster."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..images.picture import Picture
from ..progress import timed
from .errors import RegressionError
from .passes import Sampling, merge_passes, render_pass
from .scene import load_scene

# A worker may have several threads, and Mitsuba one variant and, in LLVM, all cores.
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
) -> Picture:
    """Render the passes of a picture on the workers of a cluster, and merge them.

    With the box filter and an LLVM variant, the picture has the same bits as the same passes on one machine, if the
    workers have its versions and processor.

    Parameters
    ----------
    address : str
        Of the scheduler, such as "tcp://farm:8786".
    scene : str or Path
        Each worker must have the scene under this path, and this package.
    count : int
        Passes; 0 for one for each thread of the workers.

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
        # Not pure: a render that was asked for again should be made again.
        futures = client.map(
            _work, numbers, pure=False, job=(path, dict(parameters), variant, sampling, count, filter_name, with_probe)
        )
        with timed("Rendering on the cluster"):
            return merge_passes(client.gather(futures))


def _work(number: int, job: tuple) -> Picture:
    """Render one pass; runs on a worker."""
    import mitsuba as mi

    path, parameters, variant, sampling, count, filter_name, with_probe = job
    with _lock:
        mi.set_variant(variant)
        return render_pass(load_scene(path, parameters, filter_name), sampling, number, count, with_probe=with_probe)
