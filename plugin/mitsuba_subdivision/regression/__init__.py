"""Comparison of renders: rendering by passes, references, and tiers that compare images with them.

The glossary of plugin/ARCHITECTURE.md has its terms. The modules `image`, `tiers`, `compare` and `report` do not use
Mitsuba, and compare renders of any origin.
"""


class RegressionError(ValueError):
    """A scene cannot be rendered as requested, or images cannot be read or compared."""


class ContentElsewhere(RegressionError):
    """A file is a pointer of git-lfs."""
