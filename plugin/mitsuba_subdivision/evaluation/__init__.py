"""Exact evaluation of an element's limit surface from the control points of its one-ring.

In the order in which they build on each other:

- `refined_rings` runs the rules of a scheme once on an element.
- `eigenbasis` and `equations` have the linear algebra and the equations (4) to (13).
- `normals` has tangents for the normal where the derivatives fail, and the unit normals.
- `irregular_patch` puts these together for a patch with one extraordinary point.
- `patch_tree` divides an element into pieces: regular patches, and patches with one extraordinary point, for which it
  finds the subdivision matrices. Equal parts of any elements are divided once.
- `located_samples` finds the leaves in which samples lie, and their weights over the one-ring; `element` has what these
  make: points, derivatives, curvature and limit stencils.
- `polynomials` has regular patches as polynomials, `tree_arrays` all pieces of a tree, `divided_tile` parts for bounds.
- `scheme_laws` states the laws that the rules of every scheme obey.
"""
