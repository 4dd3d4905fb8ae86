"""Control cages: connectivity, validation, readers and named examples."""

from .attributes import Attribute
from .control_cage import ControlCage
from .errors import CageError, CageWarning

__all__ = ["Attribute", "CageError", "CageWarning", "ControlCage"]
