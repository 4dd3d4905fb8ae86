"""OpenEXR files of one part, with metadata as JSON in one attribute."""

from __future__ import annotations

import contextlib
import io
import json
import os
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from ..whole_file import whole_file
from . import ImageError

METADATA_ATTRIBUTE = "mitsuba_subdivision:metadata"

Channels = dict[str, NDArray]

_MAGIC = b"\x76\x2f\x31\x01"

_quieting = threading.Lock()


def write_exr(path: str | Path, pixels: NDArray[np.floating], metadata: dict | None = None) -> None:
    """Write linear RGB pixels as float32; the file appears whole or not at all.

    Parameters
    ----------
    path : str or Path
    pixels : (height, width, 3)
    metadata : dict, optional
        Kept in the file as JSON, in the string attribute "mitsuba_subdivision:metadata".
    """
    _write(Path(path), {"RGB": np.ascontiguousarray(pixels, dtype=np.float32)}, metadata)


def write_channels(path: str | Path, channels: Mapping[str, NDArray], metadata: dict | None = None) -> None:
    """Write named channels into one single-part file; the file appears whole or not at all.

    The same channels and metadata give the same bytes. The file has one part, since Mitsuba reads only the first of
    several, without a warning.

    Parameters
    ----------
    channels : dict of (height, width)
        Integers become 32 bits unsigned, all else float32. A dot in a name makes a layer: ``variance.R``.
    """
    converted = {
        name: np.ascontiguousarray(values, dtype=np.uint32 if values.dtype.kind in "iu" else np.float32)
        for name, values in channels.items()
    }
    _write(Path(path), converted, metadata)


def read_channels(path: str | Path) -> tuple[Channels, dict[str, Any]]:
    """Channels ``(height, width)`` by name of a file of one part, and its metadata, empty if there is none.

    Raises
    ------
    ImageError
        If there is no such file, it is truncated or not an OpenEXR file, or it has several parts, deep pixels or broken
        metadata.
    """
    path = Path(path)
    if not path.is_file():
        raise ImageError(f'image "{path}" is not a file; expected an OpenEXR file')
    try:
        with _quiet(), OpenEXR.File(str(path), separate_channels=True) as file:
            parts = len(file.parts)
            if not parts:
                raise RuntimeError("its pixels cannot be read")
            if parts != 1:
                raise ImageError(
                    f'image "{path}" has {parts} parts; expected 1, as most programs read only the first part'
                )
            header = dict(file.header())
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except ImageError:
        raise
    except (RuntimeError, ValueError, OSError):
        with path.open("rb") as start:
            is_exr = start.read(len(_MAGIC)) == _MAGIC
        problem = "is truncated, or damaged" if is_exr else "is not an OpenEXR file"
        raise ImageError(f'image "{path}" {problem}') from None
    if any(values.dtype == object or values.ndim != 2 for values in channels.values()):
        raise ImageError(f'image "{path}" has deep or subsampled channels; expected one value per pixel')
    return channels, _metadata(path, header)


def _write(path: Path, channels: Mapping[str, NDArray], metadata: dict | None) -> None:
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if metadata:
        # JSON, as OpenEXR would round Python's numbers to 32 bits.
        header[METADATA_ATTRIBUTE] = json.dumps(metadata, sort_keys=True)
    with whole_file(path) as beside, OpenEXR.File(header, channels) as file:
        file.write(str(beside))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Close standard output and error while OpenEXR reads: of a damaged file, it writes a line for each row."""
    with _quieting, contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
        try:
            kept = os.dup(2)
        except OSError:
            # Standard error is closed.
            yield
            return
        stack.callback(os.close, kept)
        null_device = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null_device, 2)
        os.close(null_device)
        stack.callback(os.dup2, kept, 2)
        yield


def _metadata(path: Path, header: dict[str, Any]) -> dict[str, Any]:
    text = header.get(METADATA_ATTRIBUTE)
    if text is None:
        return {}
    try:
        found = json.loads(text)
    except ValueError as error:
        raise ImageError(f'attribute "{METADATA_ATTRIBUTE}" of image "{path}" is not JSON: {error}') from None
    if not isinstance(found, dict):
        raise ImageError(f'attribute "{METADATA_ATTRIBUTE}" of image "{path}" is no JSON object')
    return found
