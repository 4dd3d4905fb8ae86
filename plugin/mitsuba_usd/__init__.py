"""Whole USD files as scenes of Mitsuba, with meshes subdivided by their schemes.

Meshes, cameras, lights, and materials of MaterialX and of UsdPreviewSurface become entries of a scene dictionary. The
package uses only public names of `mitsuba_subdivision`.

Data flows one way, from a stage to contents to scene entries.

stage_walk.py, stage_*.py    a stage as contents; stage_warnings.py issues one warning for each kind of problem
materialx_layers.py          USD layers and node library of MaterialX contents.py                  contents: numbers,
names and arrays surface_models.py            inputs of all material models in common terms materialx_nodes.py
expressions of nodes of MaterialX, and their values scaling.py                   contents in a larger unit copies.py
contents with meshes in place of many instances picture_detail.py            triangles, rates of displacements and
pixels of textures that a picture needs bsdfs.py, textures.py, texture_image.py, emitters.py, sensors.py   scene entries
of parts of contents scene_entries.py             scene entries of shapes, and of all contents stage_scenes.py
scenes at one time or in frames
"""

from .stage_scenes import StageScenes, usd_scene

__all__ = ["StageScenes", "usd_scene"]
