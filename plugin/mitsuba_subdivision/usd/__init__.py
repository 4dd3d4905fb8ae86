"""A whole USD file as a scene of Mitsuba.

stage_*.py, polygons.py   read a stage to plain data, maybe in a process of its own
contents.py               that data
copies.py                 that data with meshes in place of many instances
bsdfs.py, textures.py, emitters.py, sensors.py, shapes.py   make entries of a scene of it
entries.py                puts these together
staging.py, bounds.py     what of a studio the stage lacks
scene.py                  all of it at one time
films.py, loaded_shapes.py   in frames
notes.py                  what is not taken
"""

from .scene import usd_scene

__all__ = ["usd_scene"]
