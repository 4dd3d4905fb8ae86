"""A camera that looks at small scenes."""

import mitsuba as mi

WIDTH, FOV = 640, 30.0


def sensor_at(distance, width=WIDTH):
    """Looks along z from so far in front of the origin."""
    film = {"type": "hdrfilm", "width": width, "height": width // 2}
    view = {"type": "perspective", "fov": FOV, "fov_axis": "x", "near_clip": 0.01, "film": film}
    return {**view, "to_world": mi.ScalarTransform4f().translate([0, 0, -distance])}
