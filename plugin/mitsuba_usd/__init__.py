"""Whole USD files as scenes of Mitsuba, with meshes subdivided by their schemes.

Meshes, cameras, lights, and materials of MaterialX and of UsdPreviewSurface become entries of a scene dictionary. The
package uses only public names of `mitsuba_subdivision`.

Data flows one way. `stage_walk` and the other modules ``stage_*`` read a stage as plain data, `contents`, in which
`surface_models` has the inputs of all material models in common terms. `copies` puts meshes in place of many instances,
and `picture_detail` finds the triangles and pixels that a picture needs. `scene_entries` makes the entries of a scene,
with those of `bsdfs`, `textures` and `lights_and_camera`; `stage_scenes` makes scenes of one time, and of frames.
"""

from .stage_scenes import StageScenes, usd_scene

__all__ = ["StageScenes", "usd_scene"]
