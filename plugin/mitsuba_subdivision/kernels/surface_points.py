"""Points of the surface on the device, as `SurfaceKernel` evaluates and finds them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr

from .affine_map import AffineMap
from .array_types import Float, Vector3
from .element_walk import Location
from .vectors import over, unit


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a surface.

    Attributes
    ----------
    location : Location
        Where they lie.
    p : 3-vector
        In the space of the control points.
    n : 3-vector
        Unit normal along ``dp_du x dp_dv``. Where the surface has none, as on folds, it is zero, or what rounding
        makes of it.
    dp_du, dp_dv : 3-vectors
        Derivatives by the location's parameters.
    dn_du, dn_dv : 3-vectors, or None
        If second derivatives were requested.
    """

    location: Location
    p: Vector3
    n: Vector3
    dp_du: Vector3
    dp_dv: Vector3
    dn_du: Vector3 = None
    dn_dv: Vector3 = None

    def placed(self, to_world: AffineMap) -> SurfacePoints:
        """The same points in another space."""
        normal = to_world.normal(self.n)
        n = unit(normal)
        found = SurfacePoints(
            self.location, to_world.point(self.p), n, to_world.direction(self.dp_du), to_world.direction(self.dp_dv)
        )
        if self.dn_du is None:
            return found
        inverse = over(1, dr.norm(normal), 0)
        turns = (to_world.normal(each) * inverse for each in (self.dn_du, self.dn_dv))
        dn_du, dn_dv = (turn - n * dr.dot(n, turn) for turn in turns)
        return replace(found, dn_du=dn_du, dn_dv=dn_dv)


@dataclass(frozen=True, eq=False)
class SurfaceHits(SurfacePoints):
    """Points where rays intersect a surface.

    Attributes
    ----------
    t : float array
        Distance along the ray, in lengths of its direction; infinite where it does not intersect the surface nearby.
    """

    t: Float = None


@dataclass(frozen=True, eq=False)
class NearestSurfacePoints(SurfacePoints):
    """Points of a surface that are nearest to others.

    Attributes
    ----------
    distance : float array
    """

    distance: Float = None


@dataclass(frozen=True, eq=False)
class RandomSurfacePoints(SurfacePoints):
    """Random points of a surface.

    Attributes
    ----------
    pdf : float array
        Their density by area.
    """

    pdf: Float = None
