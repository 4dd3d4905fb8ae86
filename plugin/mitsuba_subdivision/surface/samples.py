"""Points of a limit surface with normals, derivatives and curvature."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemes.domain import FloatArray


class SurfaceSamples(NamedTuple):
    """Points of a limit surface.

    Attributes
    ----------
    p : (s, 3)
        Points, in the cage's space.
    dp_du, dp_dv : (s, 3)
        Derivatives by the sample's own (u, v). At an extraordinary point, where they vanish or are infinite, the
        tangents along the u and the v edge, of arbitrary length.
    n : (s, 3)
        Unit normals, along ``dp_du x dp_dv``: outward for a cage with counter-clockwise faces. A surface without a
        tangent plane at a vertex has a normal by convention there: beside many faces on a border, the limit along the
        border; at the tip of a sharp vertex, one normal for all its faces, made of the edges around it. Exactly zero
        where the tangents are parallel or zero but for rounding: on the fold between two faces glued back to back, at
        sharp vertices of two faces and ends of creases in them, and where the surface collapses to a curve or a point.
        The published forms "power" and "stam" return what they compute.
    level : (s,) int64
        The n of equations (9) to (12): refinements of the irregular patch that holds the sample until the sample lies
        in a regular one. 0 on regular patches, -1 at an extraordinary point itself.
    d2p_duu, d2p_duv, d2p_dvv : (s, 3) or None
        Second derivatives, if requested. Not a number at an extraordinary point itself.
    gaussian_curvature, mean_curvature : (s,) or None
        If requested. Mean curvature is positive where the surface bends towards its normal: negative on a ball. At an
        extraordinary point itself 0 where the curvature vanishes there (Catmull-Clark, valence 3), else not a number,
        because the curvature is unbounded or depends on the direction. Also not a number where there is no normal.
    """

    p: FloatArray
    dp_du: FloatArray
    dp_dv: FloatArray
    n: FloatArray
    level: NDArray[np.int64]
    d2p_duu: FloatArray | None = None
    d2p_duv: FloatArray | None = None
    d2p_dvv: FloatArray | None = None
    gaussian_curvature: FloatArray | None = None
    mean_curvature: FloatArray | None = None
