"""One refinement near an extraordinary vertex: old and new control points, the patch and its four children."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection

from ..cage.structure import edges_of
from ..mesh.one_ring import one_ring
from ..schemes import scheme_named
from ..schemes.domain import FloatArray
from .characteristic import CharacteristicMap, outline, patch_of_valence
from .domains import sub_domain
from .output import FigureOptions, hide_frame, panels, write_plot

VALENCE = 5
# Stencils that agree to this many decimals are the same: their entries are fractions of small integers.
DECIMALS = 9
# The irregular child is grey, as in the figure `subdivision`; in grey prints, all four differ.
CHILD_COLOURS = ("#747b84", "#fcebbc", "#e39360", "#b3d3e0")
EDGE, NEW_EDGE = "#8d97a1", "#3f5b6b"
# In points; indices are 0.7 times as large.
LABEL_SIZE = 9


@dataclass(frozen=True, eq=False)
class RefinementStep:
    """A patch's control points before and after one refinement, in the plane of the characteristic map."""

    characteristic: CharacteristicMap
    old: FloatArray  # (K, 2): control points of the patch
    # (M, 2): control points of its four children: the different rows of A and of the matrices of the regular ones
    new: FloatArray
    # (.., 2, 2): both ends of the edges between the control points
    old_edges: FloatArray
    new_edges: FloatArray

    @classmethod
    def at_valence(cls, valence: int) -> RefinementStep:
        """Refine the one-ring of a Catmull-Clark patch with one extraordinary vertex."""
        patch = patch_of_valence(scheme_named("catmull_clark"), valence)
        characteristic = CharacteristicMap(patch, valence)
        rows = np.concatenate([patch.structure.matrix, *patch.structure.children])
        stencils = np.unique(rows.round(DECIMALS), axis=0)
        ring = one_ring(patch.structure.signature).topology
        refinement = patch.scheme.refine(ring)
        # Refined points without such a stencil belong to neighbouring patches.
        distance = np.abs(refinement.stencils.matrix.toarray()[:, None] - stencils).max(axis=2)
        needed = (distance < 10.0**-DECIMALS).any(axis=1)
        edges, old = edges_of(refinement.topology), characteristic.control_points
        new_edges = refinement.apply(old)[edges[needed[edges].all(axis=1)]]
        return cls(characteristic, old, stencils @ old, old[edges_of(ring)], new_edges)


def draw(options: FigureOptions) -> list[Path]:
    """Draw the control points of a patch of valence 5 before and after one refinement.

    The points lie where the characteristic map puts them. The refined points come from the evaluator's subdivision
    matrices.
    """
    step = RefinementStep.at_valence(VALENCE)
    domain = step.characteristic.patch.scheme.domain
    options.report(f"valence {VALENCE}: {len(step.old)} control points, {len(step.new)} after one refinement")
    figure, ((before, after),) = panels(options, 1, 2)
    for axis in (before, after):
        axis.add_collection(LineCollection(list(step.old_edges), colors=EDGE, linewidths=0.6, zorder=1))
        axis.plot(*step.old.T, "o", color="black", markersize=4, zorder=4)
        axis.set_aspect("equal")
        hide_frame(axis)
    style = {"edgecolor": "#30363c", "linewidth": 0.7, "zorder": 2}
    label = {"fontsize": LABEL_SIZE, "ha": "center", "va": "center", "zorder": 6}
    whole = step.characteristic(outline(domain.corners))
    before.fill(*whole.T, facecolor=CHILD_COLOURS[0], **style)
    before.text(*whole.mean(axis=0), r"$\Omega$", **label)
    for k, colour in enumerate(CHILD_COLOURS):
        child = step.characteristic(outline(sub_domain(domain, 0, k)))
        after.fill(*child.T, facecolor=colour, **style)
        after.text(*child.mean(axis=0), rf"$\Omega_{k}$", **label)
    after.add_collection(LineCollection(list(step.new_edges), colors=NEW_EDGE, linewidths=0.5, zorder=3))
    after.plot(*step.new.T, "o", mfc="white", mec="black", mew=0.6, markersize=3, zorder=5)
    before.set(title=f"a patch of valence {VALENCE}", xlabel=f"$K$ = {len(step.old)} control points")
    after.set(title="one refinement", xlabel=f"$M$ = {len(step.new)} new control points")
    return write_plot(options, "refinement", figure)
