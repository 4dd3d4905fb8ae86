"""Comparison of renders: rendering by passes, references, and tiers that compare images with them.

image
    An array of pixels, with the metadata of its file (`image.Image`). A render is an image of a scene.
reference, test
    The two images of a comparison: the trusted one, stored in a file, and the one to be tested.
tier
    One way to compare two images: `tiers.TIERS` has them all.
probe
    AOVs (arbitrary output variables) of the first hit of the ray through the centre of each pixel, without noise.
batch
    Samples that are rendered at once, with one seed. The variance comes from how the means of batches differ.
pass
    Some of an image's batches, rendered by one process; passes are merged into the image.
part
    Some of an image's samples, rendered by one call of Mitsuba, so that progress can be shown in between.

The modules `image`, `tiers`, `compare` and `report` do not use Mitsuba, so that they compare
renders of any origin.
"""


class RegressionError(ValueError):
    """A scene cannot be rendered as requested, or images cannot be read or compared."""


class ContentElsewhere(RegressionError):
    """A file is a pointer of git-lfs."""
