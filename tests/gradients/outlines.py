"""What triangles cover of a picture: areas of outlines by scan lines, without any renderer."""

import mitsuba as mi
import numpy as np
from gradients.scenes import EYE, FOV, TARGET, UP
from gradients.surfaces import ALL
from kernels.surfaces import CAGES
from mitsuba_subdivision import ControlCage, LimitSurface

LINES = 8192
# Segments per edge, and the step of differences of areas.
RATE, STEP = 2, 1e-3
STAR = CAGES / "star.obj"
SURFACES = {
    "concave, catmull_clark": lambda: LimitSurface(ControlCage.from_file(STAR), "catmull_clark"),
    "concave, loop": lambda: LimitSurface(ControlCage.from_file(STAR), "loop"),
    "concave, doo_sabin": lambda: LimitSurface(ControlCage.from_file(STAR), "doo_sabin"),
    **{name: ALL[name] for name in ("creased", "semi-sharp", "open")},
}


def properties(surface, rate=RATE, **more):
    cage, scheme = surface.cage.as_properties(mi), surface.scheme.name
    return {"type": "subdivision", **cage, "scheme": scheme, "tessellation_rate": rate, **more}


def change(surface, direction, rate=RATE):
    """Derivative of the share of the picture that the tessellation covers, by differences."""

    def area(step):
        moved = surface.cage.with_positions(surface.cage.positions + step * direction)
        made = LimitSurface(moved, surface.scheme).tessellate(rate)
        return covered(made.positions, made.triangles, EYE, TARGET, UP, FOV)

    return (area(STEP) - area(-STEP)) / (2 * STEP)


def covered(positions, triangles, eye, target, up, fov, lines=LINES):
    """Share of a square picture that is covered by triangles, all of them before the eye and inside the picture.

    Along each of many lines, triangles cover intervals with known ends. Their union is exact; the sum over lines is
    the midpoint rule, of second order as the widths of an outline of straight edges are continuous.
    """
    triangles = _projected(positions, eye, target, up, fov)[triangles]
    upwards = np.argsort(triangles[..., 1], axis=1)
    low, middle, high = np.take_along_axis(triangles, upwards[..., None], 1).swapaxes(0, 1)
    step = 2 / lines
    first, end = (np.ceil((corner[:, 1] + 1) / step - 0.5).astype(int) for corner in (low, high))
    counts = end - first
    which = np.repeat(np.arange(len(triangles)), counts)
    line = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts) + first[which]
    y = (line + 0.5) * step - 1

    def met(begin, end):
        height = (end - begin)[which, 1]
        part = (y - begin[which, 1]) / np.where(height == 0, 1, height)
        return begin[which, 0] + part * (end - begin)[which, 0]

    ends = np.stack([met(low, high), np.where(y < middle[which, 1], met(low, middle), met(middle, high))])
    # One line after the other, further apart than a picture is wide.
    begin, end = np.sort(ends, axis=0) + 8 * line
    order = np.argsort(begin)
    begin, reached = begin[order], np.maximum.accumulate(end[order])
    before = np.concatenate([[-np.inf], reached[:-1]])
    return np.maximum(reached - np.maximum(begin, before), 0).sum() * step / 4


def _projected(positions, eye, target, up, fov):
    """``(n, 2)`` places in the picture, which reaches from -1 to 1."""
    forward = np.subtract(target, eye)
    right = np.cross(forward, up)
    axes = [axis / np.linalg.norm(axis) for axis in (right, np.cross(right, forward), forward)]
    seen = (positions - eye) @ np.array(axes).T
    return seen[:, :2] / (seen[:, 2:] * np.tan(np.radians(fov) / 2))
