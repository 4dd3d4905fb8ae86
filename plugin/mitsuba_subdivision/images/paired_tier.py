"""Tier 1, paired: the same samples must give the same pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

from .picture import Picture
from .tier import Status, TierResult, skipped
from .tolerances import Tolerances

NAME = "paired"
# Where a pixel is this dark compared to the picture, its difference is taken relative to the picture.
DARK = 1e-3

# Both pictures drew the same samples if these agree.
_SAME_SAMPLES = ("variant", "filter", "paired")


def paired_tier(reference: Picture, test: Picture, tolerances: Tolerances) -> TierResult:
    """Compare two pictures drawn from the same samples.

    Skipped, with the reason, where the samples were not the same. Where they were, but program or processor were not,
    equal pixels still say all there is to say, and different ones nothing: the tier then warns.
    """
    reason = _other_samples(reference, test)
    if reason:
        return skipped(NAME, reason)
    difference = np.abs(test.paired - reference.paired)
    size = np.maximum(np.abs(reference.paired), DARK * np.abs(reference.paired).mean())
    relative = difference / np.where(size > 0, size, 1)
    worst = float(relative.max())
    changed = int((difference.max(axis=2) > 0).sum())
    numbers = {"paired_relative": worst, "changed_pixels": changed, "pixels": int(difference[..., 0].size)}
    if worst <= tolerances.paired_relative:
        what = "the same bits" if changed == 0 else f"within {worst:.2g} relative, {changed} pixels not to the bit"
        return TierResult(NAME, Status.PASS, [what], numbers)
    line = (
        f"same samples, but {changed} of {numbers['pixels']} pixels differ, by up to {worst:.3g} relative; "
        f"at most {tolerances.paired_relative:.2g} expected"
    )
    place = np.unravel_index(np.argmax(relative.max(axis=2)), relative.shape[:2])
    result = TierResult(NAME, Status.FAIL, [line], numbers, (int(place[0]), int(place[1])))
    other = differences(reference.metadata.get("environment", {}), test.metadata.get("environment", {}))
    if other:
        result.status = Status.WARN
        result.lines.append(f"which may come from the environment: {'; '.join(other)}")
    return result


def _other_samples(reference: Picture, test: Picture) -> str | None:
    """Why the pictures cannot be paired, None if they can."""
    for picture, role in ((reference, "reference"), (test, "test")):
        if picture.paired is None or "paired" not in picture.metadata:
            return f"the {role} has no paired picture (channels paired.R, paired.G, paired.B and metadata)"
    wanted, found = ({key: p.metadata.get(key) for key in _SAME_SAMPLES} for p in (reference, test))
    other = differences(wanted, found)
    if other:
        return f"the samples are not the same: {'; '.join(other)}"
    if wanted["filter"] != "box":
        return f'filter "{wanted["filter"]}" adds samples in any order; expected "box"'
    return None


def differences(reference: dict[str, Any], test: dict[str, Any]) -> list[str]:
    """One phrase for each entry that is not the same."""
    return [
        f"{key} {_said(test.get(key))} here, {_said(reference.get(key))} in the reference"
        for key in sorted({*reference, *test})
        if reference.get(key) != test.get(key)
    ]


def _said(value: Any) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, dict):
        return ", ".join(f"{key} {entry}" for key, entry in value.items())
    return str(value)
