"""Control cages: validation, tags, attributes, contents of files, and named examples."""

from .contents import RULES, TEXCOORDS, Attribute, CageContents, attributes_by_name, same, same_topology
from .control_cage import ControlCage, cage_of
from .errors import CageError, CageSource, CageWarning, in_digits, noting_warnings, shortened, warn, without_warnings
from .named_cages import cube, extraordinary
from .validation import require_range

__all__ = [
    "RULES", "TEXCOORDS", "Attribute", "CageContents", "CageError", "CageSource", "CageWarning", "ControlCage",
    "attributes_by_name", "cage_of", "cube", "extraordinary", "in_digits", "noting_warnings", "require_range", "same",
    "same_topology", "shortened", "warn", "without_warnings",
]  # fmt: skip
