"""Exact evaluation of an element's limit surface from the control points of its one-ring.

From the ground up:

- `refined_rings` runs the rules of a scheme once on an element.
- `patch_pieces` finds the pieces that an element consists of: regular patches, and patches with one extraordinary
  point, for which it finds the subdivision matrices. `divided_element` divides elements, equal parts of any elements
  once; `divided_tile` for bounds.
- `eigenbasis` has the eigenvectors of a subdivision matrix, `equations` the equations that evaluate a patch by them.
- `tangent_frame` has tangents for the normal where the derivatives fail, `normals` the normals.
- `irregular_patch` puts these together for a patch with one extraordinary point, `sample_weights` for samples in any
  parts of elements, and `element` has what they make: points, derivatives, curvature and limit stencils.
- `polynomial_basis` and `bernstein` have regular patches as polynomials, `sampled_polynomials` those pieces of an
  element that hold given samples, `piece_tree` all pieces, and `scheme_laws` the laws that the rules of every scheme
  keep.
"""
