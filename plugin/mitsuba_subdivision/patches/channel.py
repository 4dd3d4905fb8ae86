"""Channels: the attributes of a cage as a scheme interpolates them over its elements."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.attributes import Attribute
from ..mesh.connectivity import IntArray
from ..mesh.seams import seams, value_mesh
from ..schemes import Scheme, SchemeError
from ..schemes.domain import FloatArray
from ..schemes.members import has_border_rules
from .patch_samples import evaluate_patches
from .patch_table import PatchTable


@dataclass(frozen=True, eq=False)
class SubdividedChannel:
    """Values that are subdivided as points are.

    Attributes
    ----------
    patches : PatchTable
        Of the mesh that the values see, with half-edges numbered as in the cage.
    values : (n, k) float64
    row : (n_v,) int64
        0-based row of ``values`` at each vertex of the patches' topology.
    seam : (n_h,) bool or None
        Whether each half-edge of the cage lies on a seam; None where there are none.
    """

    patches: PatchTable
    values: FloatArray
    row: IntArray
    seam: NDArray[np.bool_] | None = None

    def evaluate(self, start: IntArray, uv: FloatArray) -> FloatArray:
        """``(s, k)`` values at parameters that start from corners of elements, half-edges of `PatchTable.elements`."""
        return evaluate_patches(self.patches, self.values, self.row, start, uv).values[0]


@dataclass(frozen=True, eq=False)
class LinearChannel:
    """Values that are interpolated linearly over each element.

    Over a polygon that is no whole element, bilinearly over the quadrilaterals between its corners, the middles of its
    edges and its centre: what refinement with linear rules makes of it.

    Attributes
    ----------
    patches : PatchTable
        Of the surface.
    values : (n, k) float64
    row : (n_h,) int64
        0-based row of ``values`` at each face corner.
    seam : (n_h,) bool or None
        As for `SubdividedChannel`.
    """

    patches: PatchTable
    values: FloatArray
    row: IntArray
    seam: NDArray[np.bool_] | None = None

    def evaluate(self, start: IntArray, uv: FloatArray) -> FloatArray:
        """``(s, k)`` values at parameters that start from corners of elements, half-edges of `PatchTable.elements`."""
        t, (u, v) = self.patches.topology, uv.T[:, :, None]
        start = self.patches.half_edge_of_corner[start]
        following, preceding = t.following(start), t.preceding(start)
        origin, along_u, along_v = (self.values[self.row[corner]] for corner in (start, following, preceding))
        if self.patches.scheme.domain.corner_count == 3:
            return (1 - u - v) * origin + u * along_u + v * along_v
        opposite = self.values[self.row[t.following(following)]]
        partial = np.flatnonzero(t.face_sizes[t.face_of(start)] != 4)
        along_u[partial] = (along_u[partial] + origin[partial]) / 2
        along_v[partial] = (along_v[partial] + origin[partial]) / 2
        opposite[partial] = self._centres[t.face_of(start[partial])]
        return (1 - v) * ((1 - u) * origin + u * along_u) + v * ((1 - u) * along_v + u * opposite)

    @cached_property
    def _centres(self) -> FloatArray:
        """``(n_f, k)`` mean value of each face's corners."""
        t = self.patches.topology
        sums = [np.bincount(t.face, column, minlength=t.face_count) for column in self.values[self.row].T]
        return np.stack(sums, axis=1) / t.face_sizes[:, None]


Channel = SubdividedChannel | LinearChannel


def channel_of(name: str, attribute: Attribute, cage: ControlCage, scheme: Scheme, patches: PatchTable) -> Channel:
    """How an attribute is interpolated.

    Parameters
    ----------
    name : str
        Of the attribute, for error messages.
    attribute : Attribute
        Validated.
    cage : ControlCage
    scheme : Scheme
    patches : PatchTable
        Of the cage's surface; channels on the same mesh share it.

    Raises
    ------
    SchemeError
        If the scheme has no rules for such attributes.
    """
    if attribute.interpolation == "vertex":
        return SubdividedChannel(patches, attribute.values, cage.cut_mesh.vertex)
    is_varying = attribute.interpolation == "varying"
    indices = cage.topology.face_vertices if is_varying else attribute.indices
    seam = seams(cage.topology, indices)
    seam = seam if seam.any() else None
    is_linear = is_varying or cage.face_varying == "all"
    if scheme.element == "vertex":
        if is_linear or seam is not None:
            what = "seams" if seam is not None else "linear interpolation"
            raise SchemeError(
                f'{cage.source.name}: the scheme {scheme.name} has no rules for {what}, as of the attribute "{name}"; '
                "expected one that is subdivided as points are, without seams"
            )
        row = np.zeros(patches.topology.vertex_count, dtype=np.int64)
        row[patches.topology.face_vertices] = indices
        return SubdividedChannel(patches, attribute.values, row)
    if is_linear:
        return LinearChannel(patches, attribute.values, indices, seam)
    mesh = value_mesh(cage.sharp_mesh, cage.face_varying, indices)
    if not has_border_rules(scheme) and ((mesh.topology.twin < 0).any() or mesh.topology.vertex_rules.any()):
        raise SchemeError(
            f'{cage.source.name}: the scheme {scheme.name} has no rules for seams, as of the attribute "{name}", as it '
            'states no border_rules; expected an attribute without seams, or face_varying "all"'
        )
    own = patches if mesh.topology is patches.topology else PatchTable(mesh.topology, scheme, patches.is_hole)
    return SubdividedChannel(own, attribute.values, mesh.row, seam)
