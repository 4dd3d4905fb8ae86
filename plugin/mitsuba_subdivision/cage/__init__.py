"""Control cages: validation, tags, attributes, contents of files, and named examples."""

from .contents import Attribute, CageContents, same, same_topology
from .control_cage import ControlCage
from .errors import CageError, CageSource, CageWarning, in_digits, shortened, warn
from .validation import require_range

__all__ = [
    "Attribute",
    "CageContents",
    "CageError",
    "CageSource",
    "CageWarning",
    "ControlCage",
    "in_digits",
    "require_range",
    "same",
    "same_topology",
    "shortened",
    "warn",
]
