"""Whole USD files as scenes of Mitsuba, subdivided where they ask for it.

Meshes, cameras, lights, and materials of MaterialX and of UsdPreviewSurface become entries of a scene dictionary.
The package needs nothing of `mitsuba_subdivision` but its public names.

stage_walk.py, stage_*.py    read a stage to plain data; stage_warnings.py gives warnings, one for each kind
materialx_layers.py          the USD layers and the node library of MaterialX
contents.py                  the plain data
surface_models.py            models of surfaces, by the inputs that all share
materialx_nodes.py           nodes of MaterialX, evaluated to numbers or pictures
scaling.py                   contents in a larger unit
copies.py                    replaces many instances by meshes
own_parameters.py           displacements and rates of single shapes
picture_detail.py            triangles and pixels of textures that a picture needs
bsdfs.py, textures.py, texture_image.py, emitters.py, sensors.py   build scene entries from the data
scene_entries.py             shapes, and all entries, for one scene or for frames
stage_scenes.py              all of it, at one time or in frames
"""

from .stage_scenes import StageScenes, usd_scene

__all__ = ["StageScenes", "usd_scene"]
