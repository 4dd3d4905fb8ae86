"""Collects problems of a stage, and issues one warning for each kind."""

from __future__ import annotations

import re

from mitsuba_subdivision.cage import shortened, warn

# Prims that a message names, and characters of their names that it shows.
_SHOWN, _LENGTH = 3, 200
# Details that differ between messages of one kind: texts in parentheses or quotes, paths and numbers.
_DETAILS = re.compile(r"\([^()]*\)|\"[^\"]*\"|(?<!\w)/\S+|\d+(?:[.,]\d+)*")


class StageWarnings:
    """Kinds of problems, and the affected prims."""

    def __init__(self) -> None:
        self._prims: dict[str, list[str]] = {}
        # The first message of kinds of which each message names its prim.
        self._first: dict[str, str] = {}

    def add(self, what: str, prim: object) -> None:
        """Record a problem of a prim and its consequence, the same text for all of its kind."""
        prims = self._prims.setdefault(what, [])
        if str(prim) not in prims:
            prims.append(str(prim))

    def add_message(self, message: str, prim: object) -> None:
        """Record a message that begins with the names of file and prim; messages of a kind differ in details."""
        kind = _DETAILS.sub("", message.partition(": ")[2])
        self._first.setdefault(kind, message)
        self.add(kind, prim)

    def warn(
        self,
        name: str,  # Of the file, with which messages begin
        warned: set[str] | None = None,  # Kinds that have had a warning, which are skipped; the others are added
    ) -> None:
        """Warn of each kind once."""
        for kind, prims in self._prims.items():
            if warned is not None:
                if kind in warned:
                    continue
                warned.add(kind)
            if kind not in self._first:
                warn(f"{name}: {kind} ({_listed(prims)})")
            elif len(prims) == 1:
                warn(self._first[kind])
            else:
                others = "another prim" if len(prims) == 2 else f"{len(prims) - 1} other prims"
                warn(f"{self._first[kind]}; likewise {others} ({_listed(prims[1:])})")


def _listed(prims: list[str]) -> str:
    more = f" and {len(prims) - _SHOWN} more" if len(prims) > _SHOWN else ""
    return shortened(", ".join(prims[:_SHOWN]), _LENGTH) + more
