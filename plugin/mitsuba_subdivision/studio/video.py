"""Frames joined to a video."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..whole_file import whole_file

VIDEO_SUFFIXES = (".gif", ".mp4")
# Mp4 files are made of blocks of so many pixels on each side, or less.
_EVEN = 2


def require_encoder(path: Path) -> None:
    """Refuse to make a video without the packages that write it, before frames are rendered.

    Raises
    ------
    ValueError
        If a package is missing.
    """
    try:
        import imageio.v3  # noqa: F401 - only to find out whether it is there

        if path.suffix.lower() == ".mp4":
            import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise ValueError(
            f'output "{path}": the package {error.name}, which writes videos, is missing; pip install '
            '"mitsuba-subdivision[video]", or name a .png file for frames only'
        ) from None


def write_video(path: Path, frames: Sequence[Path], fps: float) -> None:
    """Write images as a video, an animated GIF that repeats or an MP4 file.

    Parameters
    ----------
    path : Path
    frames : sequence of Path
        PNG files of one size.
    fps : float
        Frames per second.
    """
    import imageio.v3 as iio

    is_gif = path.suffix.lower() == ".gif"
    settings = (
        {"duration": 1000 / fps, "loop": 0} if is_gif else {"fps": fps, "codec": "libx264", "macro_block_size": _EVEN}
    )
    with whole_file(path) as beside:
        images = np.stack([iio.imread(frame)[..., :3] for frame in frames])
        iio.imwrite(beside, images, plugin="pillow" if is_gif else "FFMPEG", **settings)
