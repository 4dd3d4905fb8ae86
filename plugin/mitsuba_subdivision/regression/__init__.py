"""Render-difference tests: rendering by passes, references, and the comparison of scenes with them.

`images` compares what is rendered here; its page has the words reference, test, tier, probe, batch and pass.
"""


class RegressionError(ValueError):
    """A scene cannot be rendered as asked, or a reference cannot be used."""
