"""Files that appear whole or not at all."""

from __future__ import annotations

import itertools
import os
import re
import socket
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_HOST = re.sub(r"[^\w.]", "_", socket.gethostname())[:32]
# A file being written: ".NAME.HOST-PROCESS-NUMBER.part.SUFFIX", and what libraries put behind it while they write.
_UNFINISHED = re.compile(rf"\..*\.{re.escape(_HOST)}-(\d+)-\d+\.part\b.*")
# Longest part of a name that is kept: names end at 255 bytes, and a character may take four.
_LONGEST_STEM = 40

_number = itertools.count(1)
_unfinished: set[Path] = set()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a path beside ``path``, with its suffix, to write to; at the end it takes the place of ``path``.

    If writing fails, nothing stays behind, and a file that was there before is as it was. A process that is killed
    leaves the file beside; the next one to write into the folder removes it. Of several processes, the last to end
    wins. Links are followed; pipes and devices are written to as they are.

    Raises
    ------
    FileNotFoundError
        If there is no such folder.
    OSError
        If the file cannot be written; the message names ``path``.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    path = Path(os.path.realpath(path)) if path.is_symlink() else path
    if not path.parent.is_dir():  # Else messages would be about the path beside.
        raise FileNotFoundError(f'"{path}": there is no folder "{path.parent}"')
    _remove_leftovers(path.parent)
    beside = _beside(path)
    _unfinished.add(beside)
    try:
        yield beside
        _to_disk(beside)
        beside.replace(path)
    except (OSError, RuntimeError) as error:
        told = _about(path, beside, error)
        if told is error:
            raise
        raise told from error
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        _unfinished.discard(beside)


def require_writable(path: Path, inputs: Iterable[Path] = ()) -> None:
    """Refuse a path that no file can be written to, before the work that the file is for; make its folder.

    Parameters
    ----------
    path : Path
    inputs : iterable of Path, optional
        Files that the work reads, which ``path`` must not be one of.

    Raises
    ------
    OSError
        If ``path`` is a folder, or protected from writing, or the folder cannot be made or written to.
    ValueError
        If ``path`` is one of the inputs.
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
    target = Path(os.path.realpath(path))
    _remove_leftovers(target.parent)
    probe = _beside(target)
    _unfinished.add(probe)
    try:
        probe.touch()
    except OSError as error:
        raise type(error)(f'output "{path}": {error.strerror}') from None
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
        _unfinished.discard(probe)


def require_folder(folder: Path) -> None:
    """Make a folder and those above it, if they are not there.

    Raises
    ------
    OSError
        If it is a file, or cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise FileExistsError(f'"{folder}" is a file; expected a folder') from None
    except OSError as error:
        raise type(error)(f'folder "{folder}" cannot be made: {error.strerror}') from None


def remove_unfinished() -> None:
    """Remove the files that this process is writing, because it is about to end in the midst of that."""
    for beside in _unfinished.copy():
        with suppress(OSError):
            beside.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.stem[:_LONGEST_STEM]}.{_HOST}-{os.getpid()}-{next(_number)}.part{path.suffix}")


def _remove_leftovers(folder: Path) -> None:
    """Remove what processes of this machine that are no more were writing into a folder."""
    with suppress(OSError):
        for name in os.listdir(folder):
            found = _UNFINISHED.fullmatch(name)
            if found and not _is_being_written(name, int(found[1])):
                with suppress(OSError):
                    (folder / name).unlink()


def _is_being_written(name: str, process: int) -> bool:
    if process == os.getpid():
        # In containers, processes often have the same number one after the other.
        return any(beside.name == name for beside in _unfinished.copy())
    if os.name != "posix":
        # There, signal 0 ends a process.
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        # Somebody else's.
        return True
    return True


def _to_disk(path: Path) -> None:
    """Wait until a file is on its disk: some systems tell only then that there is no room."""
    with path.open("r+b") as stream:
        os.fsync(stream.fileno())


def _about(path: Path, beside: Path, error: Exception) -> Exception:
    """The error, with the name that the user knows instead of that beside."""
    if isinstance(error, OSError) and error.errno and (error.filename is None or str(error.filename) == str(beside)):
        return type(error)(error.errno, error.strerror, str(path))
    text = str(error).replace(str(beside), str(path))
    return error if text == str(error) else OSError(text)
