"""References: converged renders that later renders are compared with."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..images import ImageError
from ..images.flip_tier import flip_exposures
from ..images.image import Image, load_image, require_finite
from ..images.tolerances import Tolerances
from ..messages import PROGRAM
from . import RegressionError
from .passes import Sampling, render_pass
from .scene import BOX, SceneSource, load_scene

# Samples per pixel: four batches for a test, and 64 times as many for a reference.
TEST_SPP = 256
REFERENCE_SPP = 16384


def render_reference(
    source: SceneSource,
    path: str | Path,
    parameters: Mapping[str, Any] | None = None,
    sampling: Sampling | None = None,
    tolerances: Tolerances | None = None,
) -> Image:
    """Render a reference in the current variant, with the box filter. `save_image` writes the file.

    Parameters
    ----------
    source : path, dictionary or mi.Scene
    path : str or Path
        The reference's file. The metadata keep the command that makes the reference, as run in this file's folder.
    """
    sampling = sampling or Sampling.of_spp(REFERENCE_SPP)
    image = render_pass(load_scene(source, parameters, BOX), sampling, with_probe=True)
    scene = source if isinstance(source, (str, Path)) else None
    return as_reference(image, scene, path, sampling, tolerances)


def as_reference(
    image: Image,
    scene: str | Path | None,
    path: str | Path,
    sampling: Sampling,
    tolerances: Tolerances | None = None,
) -> Image:
    """Make a reference of an image: its metadata get tolerances, exposures for FLIP, and the command that makes it.

    Raises
    ------
    ImageError
        If the image is not finite.
    """
    require_finite(image)
    found = image.metadata
    metadata = {
        **found,
        "tolerances": (tolerances or Tolerances()).as_dict(),
        "flip_exposures": flip_exposures(image.pixels),
    }
    if scene is not None:
        # Relative to the reference, so that the working folder makes no difference.
        relative = Path(os.path.relpath(scene, Path(path).parent)).as_posix()
        metadata["scene"] = relative
        metadata["command"] = command(
            relative, Path(path).name, found["parameters"], found["variant"], sampling, tolerances
        )
    return replace(image, name=str(path), metadata=metadata)


def command(
    scene: str | Path,
    output: str | Path,
    parameters: Mapping[str, str],
    variant: str,
    sampling: Sampling,
    tolerances: Tolerances | None = None,
) -> str:
    """Shell command that makes a reference."""
    words = [PROGRAM, "render", str(scene), "-o", str(output), "--reference"]
    words += ["--spp", str(sampling.spp), "--batch", str(sampling.batch), "--seed", str(sampling.seed)]
    usual = Tolerances().as_dict()
    changed = {name: v for name, v in (tolerances or Tolerances()).as_dict().items() if v != usual[name]}
    words += ["--variant", variant, *_assignments("-D", parameters), *_assignments("--tolerance", changed)]
    return shlex.join(words)


class UnusableReference(RegressionError):
    """A reference is missing, cannot be read, or is of another scene: it has to be made again."""


def load_reference(path: Path) -> Image:
    """Read a reference.

    Raises
    ------
    UnusableReference
        If it is missing, damaged, or no reference.
    """
    if not path.is_file():
        raise UnusableReference(f'there is no reference "{path}"')
    try:
        reference = load_image(path)
    except ImageError as error:
        raise UnusableReference(str(error)) from None
    sampling_of(reference)
    return reference


def sampling_of(reference: Image) -> Sampling:
    """Sampling of a reference.

    Raises
    ------
    UnusableReference
        If the reference does not record it.
    """
    found = reference.metadata.get("sampling")
    if reference.estimate is None or not isinstance(found, dict):
        raise UnusableReference(
            f'"{reference.name}" does not say how it was rendered; expected a reference, as '
            f'"{PROGRAM} render SCENE -o REFERENCE.exr --reference" writes'
        )
    batches = sum(stop - start for start, stop in found["batches"])
    return Sampling(batches, found["batch"], found["seed"])


def _assignments(option: str, values: Mapping[str, object]) -> Sequence[str]:
    return [word for name, value in sorted(values.items()) for word in (option, f"{name}={value}")]
