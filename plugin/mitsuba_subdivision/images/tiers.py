"""The table of tiers, the ways to compare a test with a reference.

A new tier is one file and one line. The file is a module of this package with two functions. ``compare`` gets the
reference, the test, the tolerances, and the number of scenes that share one probability of a false alarm; it returns a
`tier.TierResult`. ``panels`` gets the reference, the test and that result; it returns the tier's panels for the report.
The line in the table `TIERS` names the module and describes what the tier compares. The command ``compare`` and its
help, the pytest fixture and the report read this table. A limit that users can set is also a field of
`tolerances.Tolerances`.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .image import Image
    from .panel import Panel
    from .tier import TierResult
    from .tolerances import Tolerances


@dataclass(frozen=True)
class Tier:
    """A tier.

    Attributes
    ----------
    module : str
        Module of this package that compares; it is imported only then.
    compares : str
        What the tier compares, for the help.
    compares_radiance : bool
        Whether the tier compares pixels, not only geometry.
    by_default : bool
        Whether the tier runs where the user chooses none.
    """

    module: str
    compares: str
    compares_radiance: bool = True
    by_default: bool = True

    def compare(self, reference: Image, test: Image, tolerances: Tolerances, suite_size: int) -> TierResult:
        """Compare two images whose pixels are finite; the result is skipped if they lack what the tier compares."""
        result: TierResult = self._import().compare(reference, test, tolerances, suite_size)
        return result

    def panels(self, reference: Image, test: Image, result: TierResult) -> Iterable[Panel]:
        """Panels for the report, from a result that is not skipped."""
        panels: Iterable[Panel] = self._import().panels(reference, test, result)
        return panels

    def _import(self) -> Any:
        return importlib.import_module(f".{self.module}", __package__)


TIERS = {
    "probe": Tier("probe_tier", "what the rays through the centres of the pixels hit", compares_radiance=False),
    "paired": Tier("paired_tier", "pixels from the same samples, which must be the same"),
    "tile": Tier("tile_tier", "tiles of several sizes: does noise explain their difference?"),
    # Noise makes FLIP's errors large. So this tier is left for images that no other tier can compare.
    "flip": Tier("flip_tier", "converged pixels, as an eye sees them", by_default=False),
}
