"""Render-difference tests: rendering by passes, references, and the comparison of scenes with them.

`images` compares the renders. A probe is the AOVs (arbitrary output variables) of the first hit of each pixel.
"""


class RegressionError(ValueError):
    """A scene cannot be rendered as requested, or a reference cannot be used."""
