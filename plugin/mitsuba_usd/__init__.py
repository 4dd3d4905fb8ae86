"""Whole USD files as scenes of Mitsuba, subdivided where they ask for it.

Meshes, cameras, lights, and materials of MaterialX and of UsdPreviewSurface become entries of a scene dictionary.
The package needs nothing of `mitsuba_subdivision` but its public names.

stage_walk.py, stage_*.py, polygons.py   read a stage to plain data
materialx_layers.py          the USD layers and the node library of MaterialX
contents.py                  the plain data
surface_models.py            models of surfaces, by the inputs that all share
materialx_nodes.py, materialx_noise.py, baking.py   nodes of MaterialX, evaluated to numbers or pictures
copies.py                    replaces many instances by meshes
bsdfs.py, textures.py, texture_*.py, emitters.py, sensors.py, shapes.py   build scene entries from the data
scene_entries.py             combines the entries, for one scene or for frames
limit_surfaces.py, rates.py  limit surfaces and their tessellation rates
studio_defaults.py           adds the studio's camera and lights if the stage has none
stage_scenes.py, scene.py    all of it, at one time or in frames
stage_warnings.py            warnings, one for each kind
"""

from .scene import usd_scene
from .stage_scenes import StageScenes

__all__ = ["StageScenes", "usd_scene"]
