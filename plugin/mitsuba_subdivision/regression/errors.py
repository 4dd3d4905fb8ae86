"""What is wrong with a scene or a reference."""

from __future__ import annotations


class RegressionError(ValueError):
    """A scene cannot be rendered as asked, or a reference cannot be used."""
