"""What parameters with derivatives have been computed from, and whether Dr.Jit still knows it."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..cage.errors import warn

# Indices of Dr.Jit's variables have that of their derivatives in the upper half.
_HALF = 32


def computed_ones(*values: Any) -> set[int]:
    """Dr.Jit's numbers of those arrays whose gradients have a way to variables that they were computed from.

    There is none from variables whose own gradients are asked for, and none after gradients have taken it: Dr.Jit then
    forgets it unless it is told otherwise.
    """
    given = (value for value in values if value is not None)
    derivatives = {index >> _HALF for value in given for index in dr.detail.collect_indices(value)} - {0}
    graph = dr.graphviz_ad(as_string=True)
    return {index for index in derivatives if f" {index} -> " in graph}


def warn_of_lost_gradients(name: str) -> None:
    """Say that gradients have reached the parameters of a shape, but not what these were computed from."""
    warn(
        f"{name}: gradients came to control_points or to_world a second time since the last update, and could not go "
        "on to the variables that these were computed from, as Dr.Jit forgets a way that gradients have taken; assign "
        "the parameters and update before each view, or differentiate one loss of all views, as loss_of_views makes it"
    )
