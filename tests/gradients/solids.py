"""Area, volume and moments: of triangles with derivatives by Dr.Jit, and of closed limit surfaces by quadrature.

Moments are integrals of x, y and z, then of their products, over the solid that a closed surface bounds. Derivatives of
exact ones follow from Hadamard's formula: a surface that moves by a field changes the integral of a function over its
solid by the integral of the function times the field's part along the normal.
"""

import drjit as dr
import numpy as np
from mitsuba_subdivision.kernels.vertex_kernel import VertexKernel
from mitsuba_subdivision.patches.polynomial_pieces import SurfacePieces

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))
# Exact for products of five polynomials of degree 3 in each parameter, two of them derivatives, or of degree 4.
ORDER = 10
# Quadrature order of `LimitSurface.stiffness`, which gives the derivatives of areas.
STIFFNESS_ORDER = 8
# Levels around extraordinary points are summed until one is smaller than this part of the sum.
LEFT_OUT, MOST_LEVELS = 1e-16, 200


def of_triangles(types, positions, triangles):
    """Area of triangles, and volume and moments of what they bound, as sums of flat Dr.Jit arrays."""
    a, b, c = (dr.gather(types.vector3, positions, types.indices(triangles[:, i])) for i in range(3))
    area = dr.sum(dr.norm(dr.cross(b - a, c - a))) / 2
    volume = dr.dot(a, dr.cross(b, c)) / 6
    total = a + b + c
    first = [dr.sum(volume * total[k]) / 4 for k in range(3)]
    second = [dr.sum(volume * (total[i] * total[j] + a[i] * a[j] + b[i] * b[j] + c[i] * c[j])) / 20 for i, j in PAIRS]
    return [area, dr.sum(volume), *first, *second]


def derivatives_of(surface, directions, rate, types):
    """Integrals over a tessellation, and their derivatives, for each of some directions of the control points."""
    table = surface.sampling(rate)
    kernel, derivatives = VertexKernel(table, types.float), []
    for direction in directions:
        points = types.floats(surface.cage.positions.ravel())
        dr.enable_grad(points)
        dr.set_grad(points, types.floats(direction.ravel()))
        integrals = of_triangles(types, kernel(points)[0], table.triangles)
        dr.forward_to(integrals)
        derivatives.append(np.ravel([np.array(gradient) for gradient in dr.grad(integrals)]))
    return np.ravel([np.array(dr.detach(value)) for value in integrals]), np.array(derivatives)


def of_surface(surface):
    """``(10,)`` volume and moments of what a limit surface bounds."""
    # With the points themselves for a field, Gauss's theorem gives 3, 4 and 5 times the integrals.
    return derivatives_of_surface(surface, [surface.cage.positions])[0] / np.repeat([3, 4, 5], [1, 3, 6])


def derivatives_of_surface(surface, directions):
    """``(n, 10)`` derivatives of volume and moments by moving the control points along each of ``n`` directions."""
    fields = [field[surface.cage.cut_mesh.vertex] for field in (surface.cage.positions, *directions)]
    points, *moves = (SurfacePieces.build(surface.patches, field) for field in fields)
    total = _integrated(points.regular, [pieces.regular for pieces in moves])
    for tips, *moved in zip(points.tips, *(pieces.tips for pieces in moves), strict=True):
        for level in range(MOST_LEVELS):
            of_level = _integrated(tips.level(level), [pieces.level(level) for pieces in moved])
            total += of_level
            if (np.abs(of_level).max(axis=1) <= LEFT_OUT * np.abs(total).max(axis=1)).all():
                break
    return total


def exact_derivatives(surface, directions):
    """``(n, 11)`` derivatives of the limit surface's area, volume and moments."""
    area = surface.stiffness(STIFFNESS_ORDER) @ surface.cage.positions
    areas = [(area * direction).sum() for direction in directions]
    return np.column_stack([areas, derivatives_of_surface(surface, directions)])


def _integrated(pieces, moves):
    """``(n, 10)`` integrals of 1, x, y, z and products of these, times each field's part along the normal."""
    uv, weights = pieces.basis.domain.quadrature(ORDER)
    at = pieces.basis.values(uv)
    by_u, by_v = (at @ part for part in pieces.basis.derivatives)
    p = pieces.origins[:, None] + at @ pieces.coefficients
    normal = np.cross(by_u @ pieces.coefficients, by_v @ pieces.coefficients)
    fields = (part.origins[:, None] + at @ part.coefficients for part in moves)
    flows = [((field * normal).sum(axis=2) * weights).ravel() for field in fields]
    functions = [np.ones(p.shape[:2]), *np.moveaxis(p, 2, 0), *(p[..., i] * p[..., j] for i, j in PAIRS)]
    return np.array(flows) @ np.array([part.ravel() for part in functions]).T
