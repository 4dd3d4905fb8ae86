"""Exact evaluation of an element's limit surface from the control points of its one-ring.

In the order in which they build on each other:

- `eigenbasis` contains the linear algebra, `equations` the equations (4) to (13).
- `normals` computes unit normals, and tangent frames where the derivatives give no normal.
- `irregular_patch` combines these for a patch with one extraordinary point.
- `patch_tree` runs the rules of a scheme on an element, and so divides it into pieces: regular patches, and patches
  with one extraordinary point with their subdivision matrices. Equal parts of all elements are divided once.
- `located_samples` finds the leaves that contain samples, and the samples' weights over the one-ring. `element`
  computes points, derivatives, curvature and limit stencils from these.
- `polynomials` converts regular patches to polynomials. `divided_tile` divides tiles for bounds.
- `scheme_laws` tests the laws that the rules of every scheme obey.
"""
