"""Files of the frames of an animation: times of a USD file, or one file for each frame."""

from __future__ import annotations

import re
from pathlib import Path

from ..cage import CageError

PATTERN = re.compile(r"%(0\d+)?d")


class FrameFiles:
    """File and time code of a frame.

    Parameters
    ----------
    path : Path
        A USD file, or a name with a number in it, such as "frame_%04d.obj".
    numbers : range
        Times or numbers of files.

    Raises
    ------
    CageError
        If the name has no number in it.
    FileNotFoundError
        If there is no file for a frame.

    Attributes
    ----------
    numbers : range
    """

    def __init__(self, path: Path, numbers: range) -> None:
        self._path, self.numbers = path, numbers
        self.are_many = bool(PATTERN.search(path.name))
        if not self.are_many and not path.suffix.lower().startswith(".usd"):
            raise CageError(
                f'"{path}": frames are times of a USD file, or files; expected a name such as frame_%04d.obj'
            )
        missing = [file for number in numbers if not (file := self.file(number)).is_file()]
        if missing:
            more = f" ({len(missing)} such files)" if len(missing) > 1 and self.are_many else ""
            raise FileNotFoundError(f'"{missing[0]}": there is no such file{more}; expected one for each frame')

    def file(self, number: int) -> Path:
        """File of a frame."""
        if not self.are_many:
            return self._path
        return self._path.with_name(PATTERN.sub(lambda found: found[0] % number, self._path.name, count=1))

    def time(self, number: int) -> float | None:
        """Time code of a frame; None in files of their own."""
        return None if self.are_many else float(number)
