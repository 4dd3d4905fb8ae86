"""Problems of a stage, with one warning for each kind."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from mitsuba_subdivision.cage import noting_warnings, warn, without_warnings
from mitsuba_subdivision.files import listed

_SHOWN = 3  # Number of prims in a message
# Details in which messages of one kind differ: texts in parentheses or quotes, paths and numbers.
_DETAILS = re.compile(r"\([^()]*\)|\"[^\"]*\"|(?<!\w)/\S+|\d+(?:[.,]\d+)*")


class StageWarnings:
    """Kinds of problems with the affected prims; each kind has one warning, for all times and files."""

    def __init__(self, ignored: Iterable[str] = ()) -> None:
        self._warned = set(ignored)
        self._prims: dict[str, dict[str, None]] = {}  # In the order in which they were added
        self._first: dict[str, str] = {}  # First message of each kind whose messages name a prim

    def add(self, what: str, prim: object) -> None:
        """Record a problem of a prim, with its consequence, in the words of its kind."""
        self._prims.setdefault(what, {})[str(prim)] = None

    def add_message(self, message: str, prim: object, kind: str | None = None) -> None:
        """Record a message that begins with the names of file and prim, and has details beyond its kind."""
        kind = _DETAILS.sub("", message.partition(": ")[2]) if kind is None else kind
        self._first.setdefault(kind, message)
        self.add(kind, prim)

    @contextmanager
    def given(self, path: str) -> Iterator[None]:
        """Issue the problems that a ``with`` block records, and its own warnings, when it ends."""
        try:
            with noting_warnings() as messages, without_warnings():
                yield
        finally:
            for message in messages:
                self.add_message(message, path, message.replace(path, ""))
            self.warn(f'"{path}"')

    def warn(self, name: str) -> None:
        """Issue a warning for each new kind; messages begin with the name of the file."""
        for kind in (kind for kind in self._prims if kind not in self._warned):
            self._warned.add(kind)
            prims = list(self._prims[kind])
            if kind not in self._first:
                warn(f"{name}: {kind} ({listed(prims, _SHOWN)})")
            elif len(prims) == 1:
                warn(self._first[kind])
            else:
                others = "another prim" if len(prims) == 2 else f"{len(prims) - 1} other prims"
                warn(f"{self._first[kind]}; likewise {others} ({listed(prims[1:], _SHOWN)})")
        self._prims.clear()
        self._first.clear()
