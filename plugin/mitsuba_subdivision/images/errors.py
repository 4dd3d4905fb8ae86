"""What is wrong with an image file or with a pair of them."""

from __future__ import annotations


class ImageError(ValueError):
    """An image cannot be read, or two images cannot be compared."""
