"""The hook that lets exact shading answer for Mitsuba: a copy of a mesh's table of virtual functions."""
