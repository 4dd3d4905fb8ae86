"""The paired tier: the same samples must give the same pixels."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from .image import Image
from .panel import Panel, relative_panel
from .tier import Status, TierResult, pixel_of_largest, skipped, skipped_without
from .tolerances import Tolerances

NAME = "paired"
# The difference of a pixel that is darker than this part of the image's mean is taken relative to that part.
DARK = 1e-3

# Both images drew the same samples if these agree.
_SAME_SAMPLES = ("variant", "filter", "paired")


def compare(
    reference: Image,
    test: Image,
    tolerances: Tolerances,
    suite_size: int = 1,  # noqa: ARG001 - no chance takes part
) -> TierResult:
    """Compare the first batches of two images, which are drawn from the same samples.

    Skipped, with the reason, where the samples are not the same. On another machine or with other versions of the
    libraries, equal pixels still prove that nothing changed, but different ones prove nothing: the tier then warns.
    """
    if reference.paired is None or test.paired is None:
        what = "first batch to pair (channels paired.R, paired.G, paired.B)"
        return skipped_without(NAME, reference.paired, test.paired, what)
    reason = _different_samples(reference, test)
    if reason:
        return skipped(NAME, reason)
    difference = np.abs(test.paired - reference.paired)
    size = np.maximum(np.abs(reference.paired), DARK * np.abs(reference.paired).mean())
    relative = difference / np.where(size > 0, size, 1)
    largest = float(relative.max())
    changed = int((difference.max(axis=2) > 0).sum())
    numbers = {"paired_relative": largest, "changed_pixels": changed, "pixels": int(difference[..., 0].size)}
    if largest <= tolerances.paired_relative:
        found = "the same bits" if changed == 0 else f"relative difference up to {largest:.2g}, in {changed} pixels"
        return TierResult(NAME, Status.PASS, [found], numbers)
    line = (
        f"same samples, but {changed} of {numbers['pixels']} pixels differ, by up to {largest:.3g} relative; "
        f"at most {tolerances.paired_relative:.2g} expected"
    )
    result = TierResult(NAME, Status.FAIL, [line], numbers, pixel_of_largest(relative.max(axis=2)))
    environment = differences(reference.metadata.get("environment", {}), test.metadata.get("environment", {}))
    if environment:
        result.status = Status.WARN
        result.lines.append(f"which may come from the environment: {'; '.join(environment)}")
    return result


def differences(reference: dict[str, Any], test: dict[str, Any]) -> list[str]:
    """One phrase for each entry of two dictionaries that is not the same."""
    return [
        f"{key} {_in_words(test.get(key))} here, {_in_words(reference.get(key))} in the reference"
        for key in sorted({*reference, *test})
        if reference.get(key) != test.get(key)
    ]


def panels(reference: Image, test: Image, result: TierResult) -> Iterable[Panel]:  # noqa: ARG001
    """Panels for the report."""
    if reference.paired is not None and test.paired is not None:
        caption = "the same for the first batches: the same samples, so no noise"
        yield relative_panel("Paired difference", reference.paired, test.paired, caption)


def _different_samples(reference: Image, test: Image) -> str | None:
    """Why the samples of two images are not the same, None if they are."""
    for image, role in ((reference, "reference"), (test, "test")):
        if "paired" not in image.metadata:
            return f"the {role} does not say with which seed its first batch was rendered"
    wanted, found = ({key: image.metadata.get(key) for key in _SAME_SAMPLES} for image in (reference, test))
    different = differences(wanted, found)
    if different:
        return f"the samples are not the same: {'; '.join(different)}"
    if wanted["filter"] != "box":
        return f'filter "{wanted["filter"]}" adds samples in any order; expected "box"'
    return None


def _in_words(value: Any) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, dict):
        return ", ".join(f"{key} {entry}" for key, entry in value.items())
    return str(value)
