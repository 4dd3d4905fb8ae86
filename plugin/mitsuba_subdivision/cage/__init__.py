"""Control cages: connectivity, validation, readers and named examples."""

from .control_cage import ControlCage
from .errors import CageError, CageWarning

__all__ = ["CageError", "CageWarning", "ControlCage"]
