"""BasisCurves of a stage as Mitsuba's curves: every basis becomes linear segments or cubic B-splines, exactly."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from mitsuba_subdivision.cage import Attribute, CageContents, CageSource
from mitsuba_subdivision.files import time_of, value_at
from mitsuba_subdivision.mesh import IntArray, ragged
from mitsuba_subdivision.mitsuba_mesh import CurveSet
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, UsdSkel

from .stage_warnings import StageWarnings

CURVES = "BasisCurves"
# Coefficients of the powers of a segment's parameter, by its control points.
BASES: dict[str, NDArray[np.float64]] = {
    "linear": np.array([[1.0, 0], [-1, 1]]),
    "bezier": np.array([[1.0, 0, 0, 0], [-3, 3, 0, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]),
    "bspline": np.array([[1.0, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6,
    "catmullRom": np.array([[0.0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]]) / 2,
}
_WRAPS = ("nonperiodic", "periodic", "pinned")
# Sine of the largest angle between segments that meet without a visible gap in their tubes.
_STRAIGHT = 1e-3
# Largest ratio of lengths that a transform without distortion has, by rounding.
_EVEN = 1.001
# Places along each segment, in the middles of equal parts, at which colours are sampled.
_PLACES = (np.arange(8) + 0.5) / 8
_NO_FACES: IntArray = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class CurveTopology:
    """Segments of curves, and what depends on their points."""

    counts: IntArray  # (n,): points of each curve, in the order of the points
    basis: str  # One of `BASES`
    wrap: str  # "nonperiodic", "periodic" or "pinned"

    @property
    def _step(self) -> int:
        return 3 if self.basis == "bezier" else 1

    @property
    def _added(self) -> int:
        """Points beyond each end, with which pinned curves begin and end at their own points."""
        return int(self.wrap == "pinned" and self.basis in ("bspline", "catmullRom"))

    @cached_property
    def segments(self) -> IntArray:
        """Number of segments of each curve, ``(n,)``: 0 where there are too few points."""
        if self.wrap == "periodic":
            return self.counts // self._step
        return np.maximum((self.counts + 2 * self._added - len(BASES[self.basis])) // self._step + 1, 0)

    @cached_property
    def _curve(self) -> IntArray:
        return np.repeat(np.arange(len(self.counts)), self.segments)

    def has(self, size: int, interpolation: str) -> bool:
        """Whether there are so many values with an interpolation."""
        sizes = {"constant": [1], "uniform": [len(self.counts)], "vertex": [self.counts.sum()]}
        return size in sizes.get(interpolation, [ends.sum() for ends in self._ends])

    @property
    def _ends(self) -> list[IntArray]:
        """Numbers ``(n,)`` of varying values of curves, by the documentation of USD and by its library."""
        closed = self.wrap == "periodic"
        return [self.segments + (not closed), self.segments + 1 - 2 * self._added]

    def powers(self, values: NDArray[np.float64], interpolation: str) -> NDArray[np.float64]:
        """Coefficients ``(n_s, 2 or 4, k)`` of powers of the parameter, along each segment, of values ``(m, k)``."""
        basis, number = BASES[self.basis], ragged.index_in_row(self.segments)[:, None]
        if interpolation == "vertex":
            return np.asarray(basis @ self._controls(values, self._step * number + np.arange(len(basis)) - self._added))
        row = np.repeat(self._curve[:, None], 2, axis=1) * (interpolation == "uniform")
        if interpolation == "varying":
            ends = next(ends for ends in self._ends if ends.sum() == len(values))
            # The library has no values for the points that are added.
            row = number + np.arange(2) - (ends < self.segments)[self._curve, None] * self._added
            last = ends[self._curve, None] - 1
            row = row % (last + 1) if self.wrap == "periodic" else np.clip(row, 0, last)
            row += ragged.starts(ends)[self._curve, None]
        powers = np.zeros((len(row), len(basis), values.shape[1]))
        powers[:, :2] = BASES["linear"] @ values[row]
        return powers

    def _controls(self, values: NDArray[np.float64], index: IntArray) -> NDArray[np.float64]:
        """Control values of segments, by their indices ``(n_s, 2 or 4)`` within their curves."""
        first, last = ragged.starts(self.counts)[self._curve, None], self.counts[self._curve, None] - 1
        if self.wrap == "periodic":
            return values[first + index % (last + 1)]
        inside = np.clip(index, 0, last)
        mirrored = np.clip(2 * inside - index, 0, last)
        # An added point lies as far beyond an end as the next point lies before it.
        return np.where((index == inside)[..., None], 1, 2) * values[first + inside] - np.where(
            (index == inside)[..., None], 0, values[first + mirrored]
        )

    def curve_set(self, points: NDArray[np.float64], radii: NDArray[np.float64], interpolation: str) -> CurveSet:
        """The curves, with points ``(m, 3)`` and radii ``(k, 1)``."""
        powers = np.concatenate([self.powers(points, "vertex"), self.powers(radii, interpolation)], axis=2)
        order = powers.shape[1]
        controls = np.linalg.solve(BASES["linear" if order == 2 else "bspline"], powers)
        # Segments share points if they are those of a spline; then each adds its last point to those before.
        is_spline = order == 2 or (self.basis == "bspline" and interpolation != "varying")
        is_new = np.full(controls.shape[:2], not is_spline)
        is_new[:, -1] = is_new[ragged.index_in_row(self.segments) == 0] = True
        counts = self.segments[self.segments > 0] + order - 1 if is_spline else np.full(len(controls), order)
        return CurveSet("linearcurve" if order == 2 else "bsplinecurve", controls[is_new], counts)

    def has_corners(self, points: NDArray[np.float64]) -> bool:
        """Whether cubic segments meet at an angle, where their tubes have a gap."""
        powers = self.powers(points, "vertex")
        before, after = np.arange(powers.shape[1]) @ powers[:-1], powers[1:, 1]
        limit = _STRAIGHT * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        is_bent = (np.linalg.norm(np.cross(before, after), axis=1) > limit) | ((before * after).sum(axis=1) < 0)
        return self.basis != "linear" and bool((is_bent & (self._curve[1:] == self._curve[:-1])).any())


def read_curves(
    prim: Usd.Prim,
    to_world: NDArray[np.float64],  # (4, 4)
    time: Usd.TimeCode,
    names: Iterable[str],  # Of primvars
    notes: StageWarnings,
) -> tuple[CageContents, CurveSet]:
    """Curves of a prim; and their points, with primvars along them. Raises ValueError if they are unusable."""
    path, curves, primvars = prim.GetPath(), UsdGeom.BasisCurves(prim), UsdGeom.PrimvarsAPI(prim)
    points = _numbers(value_at(curves.GetPointsAttr(), time))
    topology = _topology(curves, time, len(points))

    primvar = primvars.GetPrimvar("widths")
    owner = primvar if primvar.HasValue() else curves
    widths = _flattened(primvar, time) if owner is primvar else _numbers(value_at(curves.GetWidthsAttr(), time), 1)
    given = str(primvar.GetInterpolation() if owner is primvar else curves.GetWidthsInterpolation())
    given = "constant" if len(widths) == 1 else given
    if not topology.has(len(widths), given) or not (widths >= 0).all():
        raise ValueError(f"there are {len(widths)} {given} widths; expected as many as {given} values, 0 or more")
    sizes = np.linalg.svd(to_world[:3, :3], compute_uv=False)
    told = {
        "curves with too few points are left out": not topology.segments.all(),
        "normals of curves are ignored; Mitsuba's curves are tubes": value_at(curves.GetNormalsAttr(), time),
        "skeletons of curves are ignored": prim.HasAPI(UsdSkel.BindingAPI),
        "cubic curves with corners have gaps there, as Mitsuba's tubes have no caps": topology.has_corners(points),
        "curves stay round where transforms stretch them": sizes[0] > _EVEN * sizes[2],
    }
    for what in (what for what, is_so in told.items() if is_so):
        notes.add(what, path)
    attributes = {}
    varying = (primvar for name in names if (primvar := primvars.GetPrimvar(name)).HasValue())
    for primvar in (primvar for primvar in varying if primvar.GetInterpolation() != "constant"):
        values, kind = _flattened(primvar, time), str(primvar.GetInterpolation())
        if not topology.has(len(values), kind):
            notes.add("primvars of curves that have another number of values are ignored", primvar.GetAttr().GetPath())
            continue
        powers = topology.powers(values, kind)
        samples = (_PLACES[:, None] if kind != "uniform" else np.zeros((1, 1))) ** np.arange(powers.shape[1]) @ powers
        attributes[str(primvar.GetPrimvarName())] = Attribute(samples.reshape(-1, values.shape[1]), "vertex")
    # Mitsuba's curves have texture coordinates of their own.
    texcoords = Attribute(np.zeros((len(points), 2)), "vertex")
    source = CageSource(str(path))
    cage = CageContents(points, _NO_FACES, _NO_FACES, texcoords=texcoords, attributes=attributes, source=source)
    return cage, topology.curve_set(points, widths / 2, given)


def _topology(curves: UsdGeom.BasisCurves, time: Usd.TimeCode, point_count: int) -> CurveTopology:
    """Raises ValueError if the attributes are not those of curves."""
    counts = np.array(value_at(curves.GetCurveVertexCountsAttr(), time) or [], dtype=np.int64)
    named = (curves.GetTypeAttr(), curves.GetBasisAttr(), curves.GetWrapAttr())
    kind, basis, wrap = (str(value_at(attribute, time)) for attribute in named)
    basis = basis if kind == "cubic" else kind
    if basis not in BASES or wrap not in _WRAPS:
        raise ValueError(f'curves are "{basis}" and "{wrap}"; expected {", ".join(BASES)}, and {", ".join(_WRAPS)}')
    topology = CurveTopology(counts, basis, wrap)
    if counts.min(initial=0) < 0 or counts.sum() != point_count or not topology.segments.any():
        raise ValueError(f"curveVertexCounts are {counts.sum()}; expected {point_count}, as many as points, for curves")
    return topology


def _flattened(primvar: UsdGeom.Primvar, time: Usd.TimeCode) -> NDArray[np.float64]:
    values = np.asarray(primvar.ComputeFlattened(time_of(primvar.GetAttr(), time)), dtype=np.float64)
    return _numbers(values, values.shape[1] if values.ndim == 2 else 1)


def _numbers(values: Any, columns: int = 3) -> NDArray[np.float64]:
    """Values as ``(n, columns)``. Raises ValueError unless they are finite."""
    numbers = np.asarray([] if values is None else values, dtype=np.float64).reshape(-1, columns)
    if not np.isfinite(numbers).all():
        raise ValueError("points, widths or primvars are not finite; expected numbers")
    return numbers
