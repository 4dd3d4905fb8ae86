"""Control cages: validation, tags, attributes, what files hold of them, and named examples."""

from .attributes import Attribute
from .control_cage import ControlCage
from .errors import CageError, CageWarning

__all__ = ["Attribute", "CageError", "CageWarning", "ControlCage"]
