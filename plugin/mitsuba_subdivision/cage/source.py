"""Where a control cage comes from, as its error messages say it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .errors import CageError


def number_of(count: int, noun: str) -> str:
    """A count with its noun: "1 vertex", "2 vertices"."""
    plurals = {"vertex": "vertices", "index": "indices"}
    return f"{count} {noun if count == 1 else plurals.get(noun, f'{noun}s')}"


@dataclass(frozen=True, eq=False)
class CageSource:
    """Origin of a control cage: names its vertices and faces in error messages.

    Parameters
    ----------
    name : str
        How messages call the whole, a quoted path for a file.
    index_base : int
        Number of the first vertex and face as the author sees them: 0 for arrays, 1 for OBJ files.
    vertex_lines, face_lines : (n_v,), (n_f,) int64 or None
        1-based line of each vertex and face in the file; None where there are no lines.
    tag_lines : dict of str to sequence of int
        Likewise of "creases", "corners" and "holes", as far as there are lines.
    """

    name: str = "control cage"
    index_base: int = 0
    vertex_lines: NDArray[np.int64] | None = None
    face_lines: NDArray[np.int64] | None = None
    tag_lines: Mapping[str, Sequence[int]] = field(default_factory=dict)

    def at_face(self, face: int) -> str:
        """Beginning of a message about 0-based ``face``: ``"cube.obj", line 17: face 5``."""
        return f"{self._line_prefix(self.face_lines, face)}: face {face + self.index_base}"

    def at_vertex(self, vertex: int) -> str:
        """Beginning of a message about 0-based ``vertex``."""
        return f"{self._line_prefix(self.vertex_lines, vertex)}: {self.vertex(vertex)}"

    def at_tag(self, kind: str, row: int) -> str:
        """Beginning of a message about one of the "creases", "corners" or "holes"."""
        return self._line_prefix(self.tag_lines.get(kind), row)

    def vertex(self, vertex: int) -> str:
        """Name of 0-based ``vertex`` inside a message."""
        return f"vertex {vertex + self.index_base}"

    def edge(self, start: int, end: int) -> str:
        """Name of the edge between two 0-based vertices inside a message."""
        return f"edge ({start + self.index_base}, {end + self.index_base})"

    def faces(self, faces: NDArray[np.int64], shown: int = 6) -> str:
        """Names of 0-based ``faces`` with their lines inside a message, the first ``shown`` of them."""
        names = [
            f"{face + self.index_base}" + ("" if self.face_lines is None else f" (line {self.face_lines[face]})")
            for face in faces[:shown].tolist()
        ]
        more = f" and {len(faces) - shown} more" if len(faces) > shown else ""
        return ("faces " if len(faces) > 1 else "face ") + ", ".join(names) + more

    def error(self, place: str, problem: str, expected: str, count: int, noun: str) -> CageError:
        """An error about the first of some vertices, faces, edges or indices, at a place that `at_face` or so names."""
        such = number_of(count, noun).replace(" ", " such ")
        return CageError(f"{place} {problem}; expected {expected} ({such}; numbers count from {self.index_base})")

    def _line_prefix(self, lines: NDArray[np.int64] | Sequence[int] | None, index: int) -> str:
        return self.name if lines is None else f"{self.name}, line {lines[index]}"
