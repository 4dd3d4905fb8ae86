"""Files of control cages and of triangles. `mitsuba_subdivision.cage.formats` says which module reads which suffix."""
