"""Tessellations as sparse matrices: vertices and their tangents as weights over control points."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ..patches.stencil_matrices import joined_matrices

if TYPE_CHECKING:
    from scipy import sparse

    from .vertex_table import VertexTable


class VertexMatrices(NamedTuple):
    """The vertices of a tessellation as weights over the cage's control points.

    Attributes
    ----------
    p : (n, n_v) CSR array of float64
        Times ``(n_v, k)`` control points: the vertices. Rows sum to one.
    tangent_u, tangent_v : (n, n_v) CSR array of float64
        Tangents whose cross product is along the normal. Rows sum to zero. They are the derivatives by u and v of a
        patch, but for a positive factor that differs from vertex to vertex, and but for extraordinary points, borders
        and sharp features, where derivatives may vanish and these do not. `LimitSurface.matrix` has the derivatives.
    """

    p: sparse.csr_array
    tangent_u: sparse.csr_array
    tangent_v: sparse.csr_array


def vertex_matrices(table: VertexTable) -> VertexMatrices:
    """Limit stencils of all vertices of a tessellation, in its order."""
    width = table.control_count if table.refinement is None else table.refinement.shape[0]
    matrices = joined_matrices(table.stencil_rows(), 3, (table.vertex_count, width))
    if table.refinement is not None:
        matrices = [matrix @ table.refinement for matrix in matrices]
    points, *tangents = matrices
    return VertexMatrices(points[table.weld_target], *tangents)
