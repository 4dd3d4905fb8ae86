"""Images: OpenEXR files, Monte Carlo estimates of pixels, and the comparison of a render with a reference.

This package does not use Mitsuba, so that it compares renders of any origin. Terms of `images` and `regression`:

image
    An array of pixels, with the metadata of its file (`image.Image`). A render is an image of a scene.
reference, test
    The two images of a comparison: the trusted one, stored in a file, and the one to be tested.
tier
    One way to compare two images: `tiers.TIERS` has them all.
probe
    AOVs of the first hit of the ray through the centre of each pixel, without sampling and so without noise.
batch
    Samples that are rendered at once, with one seed. The variance comes from how the means of batches differ.
pass
    Some of an image's batches, rendered by one process; passes are merged into the image.
part
    Some of an image's samples, rendered by one call of Mitsuba, so that progress can be shown in between.
"""


class ImageError(ValueError):
    """An image cannot be read, or two images cannot be compared."""
