"""What goes wrong with a control cage."""

import sys
import warnings

_PACKAGE = __name__.partition(".")[0]


class CageError(ValueError):
    """A control cage that cannot be used; the message says what is wrong, where, and what was expected."""


class CageWarning(UserWarning):
    """A control cage that can be used, but is probably not what its author meant."""


def warn(message: str) -> None:
    """Warn of a cage, in the name of whoever called this package."""
    level, frame = 1, sys._getframe()
    # Mitsuba loads shapes in threads of its own, where nobody called.
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == _PACKAGE:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, CageWarning, stacklevel=level)


def shortened(text: str, length: int = 80) -> str:
    """Words of others in a message: the beginning of what is long."""
    return text if len(text) <= length else f"{text[:length]}..."
