"""The rules that a control cage chooses between."""

# As OpenSubdiv and USD name them; each first one is the default.
RULES = {
    "boundary": ("edge_and_corner", "edge_only", "none"),
    "crease_method": ("uniform", "chaikin"),
    "triangle_rule": ("catmull_clark", "smooth"),
    "face_varying": ("corners_plus1", "none", "corners_only", "corners_plus2", "boundaries", "all"),
}
