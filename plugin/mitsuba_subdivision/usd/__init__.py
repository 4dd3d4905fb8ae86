"""A whole USD file as a scene of Mitsuba.

stage_*.py, polygons.py   read a stage to plain data, maybe in a process of its own
contents.py               that data
bsdfs.py, textures.py, emitters.py, sensors.py, shapes.py   make entries of a scene of it
scene.py                  puts them together
notes.py                  what is not taken
"""

from .scene import usd_scene

__all__ = ["usd_scene"]
