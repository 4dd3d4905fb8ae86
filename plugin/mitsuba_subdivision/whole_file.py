"""Output files that are complete or absent."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# Number of characters of a name to keep: a file name has at most 255 bytes, and a character up to four.
_LONGEST_STEM = 40

_unfinished: set[Path] = set()


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` to write to; at the end, that file replaces ``path``.

    The temporary name has the suffix of ``path``. If writing fails, the temporary file is removed, and an existing file
    is unchanged. A killed process leaves its temporary file, ".NAME.NUMBER.part.SUFFIX". If several processes write one
    file, the last to end wins. Links are followed. Pipes and devices are written to directly. Raises FileNotFoundError
    if the folder does not exist. Raises OSError if the file cannot be written; the message names ``path``.
    """
    path = Path(path)
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    path = Path(os.path.realpath(path)) if path.is_symlink() else path
    if not path.parent.is_dir():  # Otherwise messages would name the temporary file.
        raise FileNotFoundError(f'"{path}": there is no folder "{path.parent}"')
    with _temporary(path) as beside:
        try:
            yield beside
            with beside.open("r+b") as stream:  # Wait for the disk: some systems report a full disk only then
                os.fsync(stream.fileno())
            beside.replace(path)
        except (OSError, RuntimeError) as error:
            if isinstance(error, OSError) and error.errno and str(error.filename or beside) == str(beside):
                raise type(error)(error.errno, error.strerror, str(path)) from error
            text = str(error).replace(str(beside), str(path))
            if text == str(error):
                raise
            raise OSError(text) from error


def write_text(path: Path, text: str) -> None:
    """Write a file in UTF-8, as `whole_file` does."""
    with whole_file(path) as beside:
        beside.write_text(text, encoding="utf-8")


def require_writable(path: Path, inputs: Iterable[Path] = ()) -> None:
    """Check that a path can be written to, before its contents are computed; create its folder.

    Raises ValueError if ``path`` is an input, OSError if it cannot be written.
    """
    for other in inputs:
        if path.exists() and other.exists() and path.samefile(other):
            raise ValueError(f'output "{path}" is an input as well; expected another file')
    if path.is_dir():
        raise IsADirectoryError(f'output "{path}" is a folder; expected a file')
    require_folder(path.parent)
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(f'output "{path}" is protected from writing')
    if path.exists() and not path.is_file():
        return
    with _temporary(Path(os.path.realpath(path))) as probe:
        try:
            probe.touch()
        except OSError as error:
            raise type(error)(f'output "{path}": {error.strerror}') from None


def require_folder(folder: Path) -> None:
    """Create a folder and its parents unless they exist. Raises OSError if this fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise FileExistsError(f'"{folder}" is a file; expected a folder') from None
    except OSError as error:
        raise type(error)(f'folder "{folder}" cannot be made: {error.strerror}') from None


def remove_unfinished() -> None:
    """Remove the temporary files of this process."""
    for beside in _unfinished.copy():
        with suppress(OSError):
            beside.unlink(missing_ok=True)


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    beside = path.with_name(f".{path.stem[:_LONGEST_STEM]}.{uuid.uuid4().hex}.part{path.suffix}")
    _unfinished.add(beside)
    try:
        yield beside
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        _unfinished.discard(beside)
