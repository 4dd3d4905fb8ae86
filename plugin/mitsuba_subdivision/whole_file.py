"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a path beside ``path``, with its suffix, to write to; at the end it takes the place of ``path``.

    If writing fails, nothing stays behind, and a file that was there before is as it was.

    Raises
    ------
    FileNotFoundError
        If there is no such folder.
    """
    if not path.parent.is_dir():  # Else messages would be about the path beside.
        raise FileNotFoundError(f'"{path}": there is no folder "{path.parent}"')
    beside = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield beside
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
