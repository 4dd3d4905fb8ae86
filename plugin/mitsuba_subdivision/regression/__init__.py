"""Comparison of renders: rendering by passes, references, and tiers that compare images with them.

image
    An array of pixels with metadata (`image.Image`). A render is an image of a scene.
reference, test
    The two images of a comparison: the trusted one, stored in a file, and the one to test.
tier
    A method to compare two images; `tiers.TIERS` lists them.
probe
    Noise-free AOVs (arbitrary output variables): the first hit of the ray through the centre of each pixel.
batch
    Samples rendered at once with one seed. The variance is estimated from the means of batches.
pass
    A share of an image's batches, rendered by one process; passes are merged into the image.
part
    A share of an image's samples, rendered by one call of Mitsuba, to show progress in between.

The modules `image`, `tiers`, `compare` and `report` do not use Mitsuba, and compare renders of any origin.
"""


class RegressionError(ValueError):
    """A scene cannot be rendered as requested, or images cannot be read or compared."""


class ContentElsewhere(RegressionError):
    """A file is a pointer of git-lfs."""
