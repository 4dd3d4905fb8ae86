"""Tables of tessellations: a polynomial for every vertex, computed once and applied whenever control points move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.normals import LEAST_EXTENT
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .vertex_polynomials import VertexPolynomials

if TYPE_CHECKING:
    from pathlib import Path

    from scipy import sparse

    from .adaptive_grid import AdaptiveGrid
    from .uniform_grid import UniformGrid


@dataclass(frozen=True, eq=False)
class VertexTable:
    """A tessellation: its vertices as points on polynomials, its triangles, and their elements.

    A polynomial's coefficients are weights times the control points of a patch. Weights do not depend on the positions
    of control points; the triangles of an adaptive tessellation do.
    """

    control_count: int
    patch_count: int
    grid: UniformGrid | AdaptiveGrid  # Numbers and locates the vertices and triangles
    polynomials: tuple[VertexPolynomials, ...]  # Polynomials on which the vertices lie
    # (n,) uint32: control points, or refined ones if there is a `refinement`, of the patches of all classes
    controls: NDArray[np.uint32]
    # (2, n) int64: copies, and the vertices whose positions they take. Each side of a crease has its own vertices, with
    # different normals but bitwise equal positions.
    copies: IntArray
    # (n, control_count) matrix from control points to refined ones, if patches are those of the cage refined once
    refinement: sparse.csr_array | None = None

    @property
    def vertex_count(self) -> int:
        return self.grid.vertex_count

    @cached_property
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        return self.grid.triangles()

    @cached_property
    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        return self.grid.element()

    @cached_property
    def weld_target(self) -> IntArray:
        """``(vertex_count,)`` the vertex whose position each vertex takes: itself, or its original if it is a copy."""
        target = np.arange(self.vertex_count)
        target[self.copies[0]] = self.copies[1]
        return target

    def locations(self) -> tuple[IntArray, FloatArray]:
        """Location of each vertex on the surface, see `UniformGrid.locations`."""
        return self.grid.locations()

    def apply(
        self,
        control_points: FloatArray,  # (control_count, 3) float64
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Evaluate every vertex.

        Returns positions and normals, (vertex_count, 3) float64. Normals are zero where undefined, see
        `SurfaceSamples`.
        """
        positions, normals = (np.empty((self.vertex_count, 3)) for _ in range(2))
        # Refined control points are rounded before another one is subtracted.
        least_extent = 0.0 if self.refinement is None else LEAST_EXTENT[64]
        for part in self.polynomials:
            evaluated = part.evaluated(
                self.controls, self._refined(control_points), with_normals=True, least_extent=least_extent
            )
            for vertex, points, unit_normals in evaluated:
                positions[vertex], normals[vertex] = points, unit_normals
        positions[self.copies[0]] = positions[self.copies[1]]
        return positions, normals

    def interpolated(self, values: FloatArray) -> FloatArray:
        """``(vertex_count, k)`` limits of ``(control_count, k)`` values at the vertices, also evaluated for copies."""
        limits = np.empty((self.vertex_count, values.shape[1]))
        for part in self.polynomials:
            for vertex, vertex_values, _ in part.evaluated(self.controls, self._refined(values)):
                limits[vertex] = vertex_values
        return limits

    def _refined(self, control_points: FloatArray) -> FloatArray:
        """``(n, k)`` points that `controls` indexes, from ``(control_count, k)`` control points of the cage."""
        return control_points if self.refinement is None else self.refinement @ control_points


class VertexMatrices(NamedTuple):
    """The vertices of a tessellation as weights over the cage's control points.

    Attributes
    ----------
    p : (n, n_v) CSR array of float64
        Times ``(n_v, k)`` control points: the vertices. Rows sum to one.
    tangent_u, tangent_v : (n, n_v) CSR array of float64
        Tangents whose cross product is along the normal. Rows sum to zero. They are the derivatives of a patch by u and
        v, times a positive factor that differs from vertex to vertex, except at extraordinary points, borders and sharp
        features, where derivatives may vanish but these tangents do not. For derivatives see `LimitSurface.matrix`.
    """

    p: sparse.csr_array
    tangent_u: sparse.csr_array
    tangent_v: sparse.csr_array


@dataclass(frozen=True, eq=False)
class Tessellation:
    """Triangles on a limit surface.

    Attributes
    ----------
    positions, normals : (n, 3) float64
        Exact points and unit normals of the limit surface.
    triangles : (m, 3) uint32
        0-based vertices, counter-clockwise from outside. Neighbours share vertices: there are no cracks.
    element : (m,) uint32
        0-based element of each triangle.
    texcoords : (n, 2) float64 or None
        Texture coordinates. Along seams of these and of other attributes, vertices have a copy for each side, with the
        same position and normal.
    attributes : dict of str to (n, k) float64
        The cage's other attributes.
    """

    positions: FloatArray
    normals: FloatArray
    triangles: NDArray[np.uint32]
    element: NDArray[np.uint32]
    texcoords: FloatArray | None = None
    attributes: Mapping[str, FloatArray] = field(default_factory=dict)

    def __repr__(self) -> str:
        data = [*([] if self.texcoords is None else ["texcoords"]), *self.attributes]
        parts = [f"{len(self.positions)} vertices", f"{len(self.triangles)} triangles", *data]
        return f"Tessellation({', '.join(parts)})"

    def save(self, path: str | Path) -> None:
        """Write to a file: ``.obj`` with every digit; ``.ply``, ``.usd``, ``.usda`` or ``.usdc`` in single precision.

        Raises
        ------
        ValueError
            If the format is unknown, or the package that writes it is missing.
        OSError
            If the file cannot be written; an existing one is then left as it was.
        """
        from ..files.formats import write_triangles

        write_triangles(path, self.positions, self.normals, self.triangles, self.texcoords, self.attributes)
