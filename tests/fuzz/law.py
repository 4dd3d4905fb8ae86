"""What every file must keep to: it is a cage or a `CageError`, told in few words, and nothing stays behind."""

import os
import warnings
from pathlib import Path
from random import Random

from fuzz.mutations import mutated
from fuzz.seed_files import WORDS, seed_files
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage

# What a message may be long, besides the path.
LONGEST_MESSAGE = 500
_DESCRIPTORS = "/proc/self/fd"
OPTIONS = {"obj": {}, "ply": {}, "usd": {"prim": "*"}}


def damaged_file(reader: str, seed: int, index: int) -> tuple[str, bytes]:
    """Suffix and content of a file, the same for the same numbers."""
    random = Random(f"{reader} {seed} {index}")
    suffix, content = random.choice(seed_files(reader))
    return suffix, mutated(content, tuple(WORDS[reader]), random)


def broken_law(path: Path) -> str | None:
    """What reading a file does that no file may make it do; None where all is well."""
    before = _open_files()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        problem = _outcome(path)
    for warning in told:
        if not issubclass(warning.category, CageWarning):
            return f"{warning.category.__name__}: {warning.message}"
        problem = problem or _wrong_message("warning", str(warning.message), path)
    left = _open_files()
    return problem or (f"open file left: {_names(left)}" if len(left) > len(before) else None)


def _outcome(path: Path) -> str | None:
    try:
        ControlCage.from_file(path, **OPTIONS["usd" if path.suffix.startswith(".usd") else path.suffix[1:]])
    except CageError as error:
        return _wrong_message("error", str(error), path)
    except Exception as error:  # Which is the finding.
        place, frame = "", error.__traceback__
        while frame is not None:
            place, frame = f"{Path(frame.tb_frame.f_code.co_filename).name}:{frame.tb_lineno}", frame.tb_next
        return f"{type(error).__name__} at {place}: {error}"
    return None


def _wrong_message(kind: str, message: str, path: Path) -> str | None:
    if str(path) not in message:
        return f"{kind} without the file's name: {message}"
    length = len(message) - len(str(path))
    return f"{kind} of {length} characters: {message}" if length > LONGEST_MESSAGE else None


def _open_files() -> list[str]:
    """Descriptors of this process, where the system tells."""
    return os.listdir(_DESCRIPTORS) if os.path.isdir(_DESCRIPTORS) else []


def _names(descriptors: list[str]) -> list[str]:
    paths = [Path(_DESCRIPTORS) / each for each in descriptors]
    return [os.readlink(path) for path in paths if path.is_symlink()]
