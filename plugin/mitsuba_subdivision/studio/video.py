"""Frames joined to a video."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..whole_file import whole_file

VIDEO_SUFFIXES = (".gif", ".mp4")
# Sides of the pictures in an MP4 file are multiples of this; others lose a row or a column.
EVEN = 2


def require_encoder(path: Path) -> None:
    """Check that the packages that write a video are installed, before frames are rendered.

    Raises
    ------
    ValueError
        If a package is missing.
    """
    try:
        import imageio.v2  # noqa: F401 - only to find out whether it is there

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
    import imageio.v2 as imageio

    # A GIF file repeats for ever, and its durations are milliseconds.
    is_gif = path.suffix.lower() == ".gif"
    settings: dict[str, Any] = {"duration": 1000 / fps, "loop": 0} if is_gif else {"fps": fps, "macro_block_size": EVEN}
    with whole_file(path) as beside:
        video: Any = imageio.get_writer(beside, **settings)
        with video:
            for frame in frames:
                pixels = imageio.imread(frame)[..., :3]
                height, width = (side if is_gif else side // EVEN * EVEN for side in pixels.shape[:2])
                video.append_data(pixels[:height, :width])
