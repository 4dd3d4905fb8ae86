"""Names of a control cage, its vertices and its faces in messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ..mesh.connectivity import IntArray
from .errors import CageError, number_of_such


@dataclass(frozen=True, eq=False)
class CageSource:
    """Origin of a control cage, which names the cage, its vertices and its faces in messages.

    All methods take 0-based indices.

    Parameters
    ----------
    name : str
        Name of the whole cage; for a file, its quoted path.
    index_base : int
        Number of the first vertex and face in messages: 0 for arrays, 1 for OBJ files.
    vertex_lines, face_lines : (n_v,), (n_f,) int or None
        1-based line of each vertex and face in the file; None if the file has no lines.
    tag_lines : dict of str to sequence of int
        1-based lines of "creases", "corners" and "holes", if the file has lines.
    """

    name: str = "control cage"
    index_base: int = 0
    vertex_lines: IntArray | None = None
    face_lines: IntArray | None = None
    tag_lines: Mapping[str, Sequence[int]] = field(default_factory=dict)

    def at_face(self, face: int) -> str:
        """Return the beginning of a message about a face: ``"cube.obj", line 17: face 5``."""
        return f"{self._line_prefix(self.face_lines, face)}: face {face + self.index_base}"

    def at_vertex(self, vertex: int) -> str:
        """Return the beginning of a message about a vertex."""
        return f"{self._line_prefix(self.vertex_lines, vertex)}: {self.vertex(vertex)}"

    def at_tag(self, kind: str, row: int) -> str:
        """Return the beginning of a message about a row of "creases", "corners" or "holes"."""
        return self._line_prefix(self.tag_lines.get(kind), row)

    def vertex(self, vertex: int) -> str:
        """Return the name of a vertex within a message."""
        return f"vertex {vertex + self.index_base}"

    def edge(self, start: int, end: int) -> str:
        """Return the name of the edge between two vertices within a message."""
        return f"edge ({start + self.index_base}, {end + self.index_base})"

    def faces(self, faces: IntArray, shown: int = 6) -> str:
        """Return the names of the first few faces, with their lines, within a message, and the number of the rest."""
        names = [
            f"{face + self.index_base}" + ("" if self.face_lines is None else f" (line {self.face_lines[face]})")
            for face in faces[:shown].tolist()
        ]
        more = f" and {len(faces) - shown} more" if len(faces) > shown else ""
        return ("faces " if len(faces) > 1 else "face ") + ", ".join(names) + more

    def error(self, where: str, problem: str, expected: str, count: int, noun: str) -> CageError:
        """Return an error about the first of several vertices, faces, edges or indices with the same problem.

        ``where``, from `at_face` or `at_vertex`, begins the message; ``count`` is the number of items, ``noun`` their
        kind ("vertex").
        """
        such = number_of_such(count, noun)
        return CageError(f"{where} {problem}; expected {expected} ({such}; numbers count from {self.index_base})")

    def _line_prefix(self, lines: IntArray | Sequence[int] | None, index: int) -> str:
        return self.name if lines is None else f"{self.name}, line {lines[index]}"
