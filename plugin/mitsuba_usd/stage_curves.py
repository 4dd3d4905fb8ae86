"""BasisCurves of a stage as Mitsuba's curves: linear segments, or exactly converted cubic B-splines."""

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

# Coefficients of powers of a segment's parameter, from its control points.
BASES: dict[str, NDArray[np.float64]] = {
    "linear": np.array([[1.0, 0], [-1, 1]]),
    "bezier": np.array([[1.0, 0, 0, 0], [-3, 3, 0, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]),
    "bspline": np.array([[1.0, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6,
    "catmullRom": np.array([[0.0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]]) / 2,
}
# Sine of the largest angle between tubes without a gap, and largest ratio of lengths of uniform transforms.
_STRAIGHT, EVEN = 1e-3, 1.001
_WIRE = 1e-3  # Width of curves without widths, relative to their size
_PLACES = (np.arange(8)[:, None] + 0.5) / 8  # Parameters along each segment at which colours are sampled


@dataclass(frozen=True, eq=False)
class CurveTopology:
    """Segments of the curves of a prim."""

    counts: IntArray  # (n,): number of points of each curve
    basis: str  # One of `BASES`
    wrap: str  # "nonperiodic", "periodic" or "pinned"

    @property
    def _steps(self) -> tuple[int, int]:
        """Points from segment to segment, and added points beyond each end of pinned curves."""
        return (3, 0) if self.basis == "bezier" else (1, int(self.wrap == "pinned" and self.basis != "linear"))

    @cached_property
    def segments(self) -> IntArray:
        """Number of segments of each curve, ``(n,)``; 0 for too few points."""
        step, added = self._steps
        missing = 0 if self.wrap == "periodic" else len(BASES[self.basis]) - step - 2 * added
        return np.maximum((self.counts - missing) // step, 0)

    @cached_property
    def _curve(self) -> IntArray:
        return np.repeat(np.arange(len(self.counts)), self.segments)

    def has(self, size: int, interpolation: str) -> bool:
        """Whether an interpolation has this number of values."""
        sizes = {"constant": 1, "uniform": len(self.counts), "vertex": self.counts.sum(), "varying": self._ends.sum()}
        return size == sizes.get(interpolation)

    @property
    def _ends(self) -> IntArray:
        return self.segments + (self.wrap != "periodic")

    def powers(self, values: NDArray[np.float64], interpolation: str) -> NDArray[np.float64]:
        """Coefficients ``(n_s, 2 or 4, k)`` of powers of the parameter, along each segment, of values ``(m, k)``."""
        basis, number = BASES[self.basis], ragged.index_in_row(self.segments)[:, None]
        if interpolation == "vertex":
            step, added = self._steps
            return np.asarray(basis @ self._controls(values, step * number + np.arange(len(basis)) - added))
        row = np.repeat(self._curve[:, None], 2, axis=1) * (interpolation == "uniform")
        if interpolation == "varying":
            row = ragged.starts(self._ends)[self._curve, None] + (number + np.arange(2)) % self._ends[self._curve, None]
        powers = np.zeros((len(row), len(basis), values.shape[1]))
        powers[:, :2] = BASES["linear"] @ values[row]
        return powers

    def _controls(self, values: NDArray[np.float64], index: IntArray) -> NDArray[np.float64]:
        first, last = ragged.starts(self.counts)[self._curve, None], self.counts[self._curve, None] - 1
        if self.wrap == "periodic":
            return values[first + index % (last + 1)]
        inside = np.clip(index, 0, last)
        # Added points mirror the points before an end.
        beyond = values[first + inside] - values[first + np.clip(2 * inside - index, 0, last)]
        return values[first + inside] + (index != inside)[..., None] * beyond

    def curve_set(self, points: NDArray[np.float64], radii: NDArray[np.float64], interpolation: str) -> CurveSet:
        """Mitsuba's curves with points ``(m, 3)`` and radii ``(k, 1)``."""
        powers = np.concatenate([self.powers(points, "vertex"), self.powers(radii, interpolation)], axis=2)
        is_linear = self.basis == "linear"
        controls = np.linalg.inv(BASES["linear" if is_linear else "bspline"]) @ powers
        # Segments of a spline share points, and each adds its last point.
        is_spline = is_linear or (self.basis == "bspline" and interpolation != "varying")
        is_new = np.full(controls.shape[:2], not is_spline)
        is_new[:, -1] = is_new[ragged.index_in_row(self.segments) == 0] = True
        order = controls.shape[1]
        counts = self.segments[self.segments > 0] + order - 1 if is_spline else np.full(len(controls), order)
        return CurveSet("linearcurve" if is_linear else "bsplinecurve", controls[is_new], counts)

    def has_corners(self, points: NDArray[np.float64]) -> bool:
        """Whether cubic segments meet at an angle, where their tubes have a gap."""
        powers = self.powers(points, "vertex")
        before, after = np.arange(powers.shape[1]) @ powers[:-1], powers[1:, 1]
        limit = _STRAIGHT * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        is_bent = (np.linalg.norm(np.cross(before, after), axis=1) > limit) | ((before * after).sum(axis=1) < 0)
        return self.basis != "linear" and bool((is_bent & (self._curve[1:] == self._curve[:-1])).any())


def read_curves(
    prim: Usd.Prim, to_world: NDArray[np.float64], time: Usd.TimeCode, names: Iterable[str], notes: StageWarnings
) -> tuple[CageContents, CurveSet]:
    """Points of curves with the named primvars, and Mitsuba's curves. Raises ValueError for unusable ones."""
    curves, primvars = UsdGeom.BasisCurves(prim), UsdGeom.PrimvarsAPI(prim)
    kind, basis, wrap = (str(value_at(prim.GetAttribute(name), time)) for name in ("type", "basis", "wrap"))
    points = _numbers(value_at(curves.GetPointsAttr(), time))
    counts = np.array(value_at(curves.GetCurveVertexCountsAttr(), time) or [], dtype=np.int64)
    topology = CurveTopology(counts, basis if kind == "cubic" else kind, wrap)
    if topology.basis not in BASES or wrap not in ("nonperiodic", "periodic", "pinned"):
        raise ValueError(f'curves are "{topology.basis}" and "{wrap}"; expected linear, bezier, bspline or catmullRom')
    if counts.min(initial=0) < 0 or counts.sum() != len(points) or not topology.segments.any():
        raise ValueError(f"curveVertexCounts are {counts.sum()}; expected as many as points, {len(points)}, for curves")
    primvar = primvars.GetPrimvar("widths")
    has_widths = primvar.HasValue()
    widths = _flattened(primvar, time) if has_widths else _numbers(value_at(curves.GetWidthsAttr(), time), 1)
    of_widths = str(primvar.GetInterpolation() if has_widths else curves.GetWidthsInterpolation())
    is_wire = not len(widths)
    widths = np.full((1, 1), _WIRE * np.ptp(points, axis=0).max()) if is_wire else widths
    of_widths = "constant" if len(widths) == 1 else of_widths
    if not topology.has(len(widths), of_widths) or not (widths >= 0).all():
        raise ValueError(f"there are {len(widths)} {of_widths} widths; expected one for each, 0 or more")
    sizes = np.linalg.svd(to_world[:3, :3], compute_uv=False)
    problems = {
        "curves without widths are wires of a thousandth of their size": is_wire,
        "curves with too few points are left out": not topology.segments.all(),
        "normals of curves are ignored; Mitsuba's curves are tubes": value_at(curves.GetNormalsAttr(), time),
        "skeletons of curves are ignored": prim.HasAPI(UsdSkel.BindingAPI),
        "cubic curves with corners have gaps there, as Mitsuba's tubes have no caps": topology.has_corners(points),
        "curves stay round where transforms stretch them": sizes[0] > EVEN * sizes[2],
    }
    for what in (what for what, is_so in problems.items() if is_so):
        notes.add(what, prim.GetPath())
    attributes = {}
    for primvar in filter(UsdGeom.Primvar.HasValue, map(primvars.GetPrimvar, names)):
        values, given = _flattened(primvar, time), str(primvar.GetInterpolation())
        if not topology.has(len(values), given):
            notes.add("primvars of curves with another number of values are ignored", primvar.GetAttr().GetPath())
        elif given != "constant":
            powers = topology.powers(values, given)
            samples = (_PLACES[: 1 if given == "uniform" else None] ** np.arange(powers.shape[1])) @ powers
            attributes[str(primvar.GetPrimvarName())] = Attribute(samples.reshape(-1, values.shape[1]), "vertex")
    # Mitsuba's curves have texture coordinates of their own.
    texcoords, no_faces = Attribute(np.zeros((len(points), 2)), "vertex"), np.zeros(0, np.int64)
    named: dict[str, Any] = {"texcoords": texcoords, "source": CageSource(str(prim.GetPath()))}
    cage = CageContents(points, no_faces, no_faces, attributes=attributes, **named)
    return cage, topology.curve_set(points, widths / 2, of_widths)


def _flattened(primvar: UsdGeom.Primvar, time: Usd.TimeCode) -> NDArray[np.float64]:
    values = np.asarray(primvar.ComputeFlattened(time_of(primvar.GetAttr(), time)))
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{primvar.GetName()} is of the type {primvar.GetTypeName()}; expected numbers")
    return _numbers(values, values.shape[1] if values.ndim == 2 else 1)


def _numbers(values: Any, columns: int = 3) -> NDArray[np.float64]:
    """Values as ``(n, columns)``. Raises ValueError unless they are finite."""
    numbers = np.asarray([] if values is None else values, dtype=np.float64).reshape(-1, columns)
    if not np.isfinite(numbers).all():
        raise ValueError("points, widths or primvars are not finite; expected numbers")
    return numbers
