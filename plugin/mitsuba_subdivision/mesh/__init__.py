"""Polygon meshes: half-edges, sharpness, cuts and seams, and the one-rings of elements."""
