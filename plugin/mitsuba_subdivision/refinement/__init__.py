"""Cages refined once, and refinements as functions of sharpness."""
