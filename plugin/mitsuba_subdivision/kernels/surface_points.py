"""Results of `SurfaceKernel`: points of the surface on the device."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr

from .algebra import AffineMap, over, unit
from .array_types import Float, Vector3
from .locations import Location


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a surface.

    Attributes
    ----------
    location : Location
        Element and parameters.
    p : 3-vector
        In the space of the control points.
    n : 3-vector
        Unit normal along ``dp_du x dp_dv``. Where the surface has none, as on folds, zero or dominated by rounding.
    dp_du, dp_dv : 3-vectors
        Derivatives by the parameters of the location.
    dn_du, dn_dv : 3-vectors, or None
        Derivatives of the normal, if they were requested.
    """

    location: Location
    p: Vector3
    n: Vector3
    dp_du: Vector3
    dp_dv: Vector3
    dn_du: Vector3 = None
    dn_dv: Vector3 = None

    def placed(self, to_world: AffineMap) -> SurfacePoints:
        """Transform the points to another space."""
        normal = to_world.normal(self.n)
        n = unit(normal)
        points = SurfacePoints(
            self.location, to_world.point(self.p), n, to_world.direction(self.dp_du), to_world.direction(self.dp_dv)
        )
        if self.dn_du is None:
            return points
        inverse = over(1, dr.norm(normal), 0)
        changes = (to_world.normal(derivative) * inverse for derivative in (self.dn_du, self.dn_dv))
        dn_du, dn_dv = (change - n * dr.dot(n, change) for change in changes)
        return replace(points, dn_du=dn_du, dn_dv=dn_dv)


@dataclass(frozen=True, eq=False)
class SurfaceHits(SurfacePoints):
    """Points where rays intersect a surface.

    Attributes
    ----------
    t : float array
        Ray parameter, in lengths of the direction; infinite where the ray does not intersect the surface nearby.
    """

    t: Float = None


@dataclass(frozen=True, eq=False)
class NearestSurfacePoints(SurfacePoints):
    """Points of a surface that are nearest to given points.

    Attributes
    ----------
    distance : float array
        Distance from the given points.
    """

    distance: Float = None


@dataclass(frozen=True, eq=False)
class RandomSurfacePoints(SurfacePoints):
    """Random points of a surface.

    Attributes
    ----------
    pdf : float array
        Probability density by area.
    """

    pdf: Float = None
