"""The characteristic map: the shape that the patches around an extraordinary point tend to, whatever the cage."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..evaluation.element import element_stencils
from ..evaluation.irregular_patch import IrregularPatch, irregular_patch
from ..evaluation.patch_tree import irregular_structure, isolated_signature
from ..schemes import Scheme

# Points along each side of a polygon, which the map bends.
SIDE_POINTS = 24


def patch_of_valence(scheme: Scheme, valence: int) -> IrregularPatch:
    """The patch with one extraordinary point, at its parameters (0, 0), and regular faces and vertices around it."""
    return irregular_patch(scheme, irregular_structure(scheme, isolated_signature(scheme, valence)))


class CharacteristicMap:
    """The map from a patch's parameters to the plane, with the extraordinary point at (0, 0).

    The two subdominant eigenvectors could be any basis of their plane. In the basis chosen here, the edges at the
    extraordinary point form a regular star, and the first edge lies along x.
    """

    def __init__(self, patch: IrregularPatch, valence: int) -> None:
        self.patch = patch
        self.turn = 2 * np.pi / valence
        # (K, 2): in the plane; the map is the patch that they make.
        self.control_points = patch.basis.vectors[:, 1:3]
        begin, end = self(patch.scheme.domain.corners[[1, -1]])
        star = np.array([(1, 0), (np.cos(self.turn), np.sin(self.turn))]).T
        self.control_points = self.control_points @ (star @ np.linalg.inv(np.stack([begin, end], axis=1))).T

    def __call__(self, uv: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map parameters ``(s, 2)`` to points ``(s, 2)``."""
        stencils = element_stencils(self.patch.scheme, self.patch.structure.signature, uv)
        return (stencils[0] @ self.control_points).astype(np.float64, copy=False)

    def sector(self, points: NDArray[np.float64], index: int) -> NDArray[np.float64]:
        """Rotate points of the patch into the ``index``-th patch around the extraordinary point."""
        cos, sin = np.cos(index * self.turn), np.sin(index * self.turn)
        return points @ np.array([(cos, sin), (-sin, cos)])


def outline(corners: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points along the sides of a polygon ``(m, 2)``, `SIDE_POINTS` on each."""
    t = np.linspace(0, 1, SIDE_POINTS, endpoint=False)[None, :, None]
    return ((1 - t) * corners[:, None] + t * np.roll(corners, -1, axis=0)[:, None]).reshape(-1, 2)
