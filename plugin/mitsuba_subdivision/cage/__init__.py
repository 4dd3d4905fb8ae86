"""Control cages: validation, tags, attributes, contents of files, and named examples."""

from .contents import Attribute, CageContents, same, same_topology
from .control_cage import ControlCage, cage_of
from .errors import CageError, CageSource, CageWarning, in_digits, noting_warnings, shortened, warn, without_warnings
from .named_cages import cube, extraordinary
from .validation import require_range

__all__ = [
    "Attribute", "CageContents", "CageError", "CageSource", "CageWarning", "ControlCage", "cage_of", "cube",
    "extraordinary", "in_digits", "noting_warnings", "require_range", "same", "same_topology", "shortened", "warn",
    "without_warnings",
]  # fmt: skip
