"""Checks of an image's metadata: files may be damaged, or come from other programs."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

from . import ImageError


def require_metadata(metadata: dict[str, Any], source: str) -> None:
    """Refuse metadata of another form than `save_image` writes. Any entry may be missing.

    Raises
    ------
    ImageError
        If an entry with a known name has a value of another form.
    """
    for name, (is_right, expected) in _KNOWN.items():
        if name in metadata and not is_right(metadata[name]):
            found = str(metadata[name])
            shown = found if len(found) <= _LONGEST else f"{found[:_LONGEST]}.."
            raise ImageError(f'metadata of image "{source}": {name} is {shown}; expected {expected}')


_LONGEST = 60


def _is_integer(value: Any, least: int = 0) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _are_texts(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_text, value.values()))


def _is_sampling(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and _is_integer(value.get("seed"))
        and _is_integer(value.get("batch"), 1)
        and _are_ranges(value.get("batches"))
        # Older files lack these.
        and _is_integer(value.get("total", 1), value["batches"][-1][1] if "total" in value else 1)
        and _is_integer(value.get("passes", 1), 1)
        and value.get("passes", 1) <= value.get("total", math.inf)
    )


def _are_ranges(value: Any) -> bool:
    if not isinstance(value, list) or not value:
        return False
    if not all(isinstance(pair, list) and len(pair) == 2 and all(map(_is_integer, pair)) for pair in value):
        return False
    return all(a < b for a, b in value) and all(first[1] <= second[0] for first, second in pairwise(value))


def _is_paired(value: Any) -> bool:
    return isinstance(value, dict) and _is_integer(value.get("seed")) and _is_integer(value.get("spp"), 1)


_KNOWN: dict[str, tuple[Callable[[Any], bool], str]] = {
    "sampling": (_is_sampling, "a seed, the samples of a batch, and ranges of batches"),
    "paired": (_is_paired, "a seed and samples per pixel"),
    "variant": (_is_text, "a name"),
    "filter": (_is_text, "a name"),
    "files": (_are_texts, "checksums by name"),
    "parameters": (_are_texts, "values by name"),
    "environment": (_are_texts, "versions by name"),
    "tolerances": (lambda value: isinstance(value, dict), "numbers by name"),
}
