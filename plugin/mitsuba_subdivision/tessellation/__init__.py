"""Tessellation of patches into triangles: sample locations, shared vertices, and the polynomials on which they lie.

`uniform_table` and `adaptive_table` both build a `VertexTable`: a vertex is a point on a polynomial, whose coefficients
are the weights of a class of patches times the control points of one patch. Their grids (`UniformGrid`,
`AdaptiveGrid`) number and locate vertices and triangles.

This package, `kernels` and `shapes` distinguish five kinds of points:

=================  ====================================================================================================
control point      A vertex of the cage, which may move. If the patches are those of the cage refined once, refined
                   control points are computed from these.
mesh vertex        A vertex of `PatchTable.topology`: the cage cut along its creases, where a control point has a copy
                   on each side. Attributes have separate meshes, cut along their seams as well.
sample             A point of a patch's grid. All patches of a class have the same samples.
vertex             A vertex of the tessellation. Neighbouring patches share vertices; one of the patches evaluates them.
split vertex       A vertex of the tessellation with attributes (`AttributeLayout`), and of Mitsuba's mesh: vertices on
                   seams are split into a copy for each side.
=================  ====================================================================================================

A patch belongs to a class (`PatchClass`), whose weights (`VertexPolynomials`) are computed once for all its patches.
The corner of an element is identified by the half-edge of `PatchTable.elements` that begins there.
"""

# Segments along an edge of the control cage. Triangles are numbered by 32 bits, and memory ends long before that.
HIGHEST_RATE = 1024
