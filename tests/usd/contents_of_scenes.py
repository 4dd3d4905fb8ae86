"""Small scenes as the reader of stages gives them, and a camera that looks at them."""

import mitsuba as mi
from mitsuba_usd.contents import SceneContents

WIDTH, FOV = 640, 30.0


def scene_of(*shapes, groups=(), instances=(), materials=()):
    return SceneContents("z", [*shapes], [*groups], [*instances], [*materials], [], None, None)


def sensor_at(distance, width=WIDTH):
    """Looks along z from so far in front of the origin."""
    film = {"type": "hdrfilm", "width": width, "height": width // 2}
    view = {"type": "perspective", "fov": FOV, "fov_axis": "x", "near_clip": 0.01, "film": film}
    return {**view, "to_world": mi.ScalarTransform4f().translate([0, 0, -distance])}
