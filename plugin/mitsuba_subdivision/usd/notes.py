"""What of a stage is not taken: gathered while it is read, and warned once for each kind."""

from __future__ import annotations

from ..cage.errors import shortened, warn

# Prims that a message names, and characters of their names that it shows.
_SHOWN, _LENGTH = 3, 200


class Notes:
    """Kinds of things that are not taken, and where they are."""

    def __init__(self) -> None:
        self._places: dict[str, list[str]] = {}

    def add(self, what: str, place: object) -> None:
        """Note something that a prim has.

        Parameters
        ----------
        what : str
            What it is and what becomes of it, the same for all of its kind.
        place : Sdf.Path or str
        """
        places = self._places.setdefault(what, [])
        if str(place) not in places:
            places.append(str(place))

    def warn(self, name: str, warned: set[str] | None = None) -> None:
        """Warn of each kind, in messages that begin with the name of a file.

        Parameters
        ----------
        name : str
        warned : set of str, optional
            Kinds that have had a warning, which are skipped; the others are added.

        Warns
        -----
        CageWarning
        """
        for what, places in self._places.items():
            if warned is not None and what in warned:
                continue
            if warned is not None:
                warned.add(what)
            shown = shortened(", ".join(places[:_SHOWN]), _LENGTH)
            more = f" and {len(places) - _SHOWN} more" if len(places) > _SHOWN else ""
            warn(f"{name}: {what} ({shown}{more})")
