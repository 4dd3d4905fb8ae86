"""A whole USD file as a scene of Mitsuba.

stage_reader.py, stage_walk.py, stage_*.py, polygons.py   read a stage to plain data, maybe in a process of its own
contents.py                  that data
copies.py                    that data with meshes in place of many instances
bsdfs.py, textures.py, emitters.py, sensors.py, shapes.py   make entries of a scene from it
entries.py, loaded_shapes.py  put these together, for one scene or for frames
surfaces.py, rates.py        limit surfaces, and how many triangles they get
staging.py                   what the stage lacks, from the studio
stage_scenes.py, scene.py    all of it, at one time or in frames
notes.py                     warnings, one for each kind
"""

from .scene import usd_scene

__all__ = ["usd_scene"]
