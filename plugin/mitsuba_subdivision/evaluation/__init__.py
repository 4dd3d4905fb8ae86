"""Exact evaluation of an element's limit surface from the control points of its one-ring.

From the ground up:

- `refined_rings` runs the rules of a scheme once on an element, or on many elements at once; `refined_fans` on faces
  around a vertex of high valence, which share most of the result.
- `patch_pieces` finds the pieces that an element consists of: regular patches, and patches with one extraordinary
  point, for which it finds the subdivision matrices. `LocatedSamples` does so only where there are samples;
  `divided_element` divides all of an element, and equal parts of any elements once.
- `eigenbasis` has the eigenvectors of a subdivision matrix, `ring_symmetry` those of high valences, `equations` the
  equations that evaluate a patch by them.
- `tangent_frame` has tangents for the normal where the derivatives fail, `normals` the normals, `curvature` the
  curvature.
- `irregular_patch` puts these together for a patch with one extraordinary point, `element` for a whole element, and
  `stencils_by_signature` for the same samples on many elements.
- `limit_stencil` has limit stencils of vertices, `product_patch` regular patches whose weights are products, and
  `scheme_laws` the laws that the rules of every scheme keep.
"""
