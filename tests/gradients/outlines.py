"""Pictures of outlines, and what triangles cover of them: areas by scan lines, without any renderer."""

import mitsuba as mi
import numpy as np
from gradients.surfaces import ALL
from kernels.surfaces import CAGES
from mitsuba_subdivision import ControlCage, LimitSurface, upload
from patches.closed_cages import bumpy
from shapes.cages import RING, cube, described
from shapes.scenes import perspective, scene_with

EYE, TARGET, UP, FOV = (1, -5, 2), (0, 0, 0), (0, 0, 1), 40
BLACK = {"type": "diffuse", "reflectance": 0.0}
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


def bumpy_cube(**tags):
    return bumpy(cube(**tags).refined())


def dome():
    cage = bumpy_cube()
    faces = cage.face_vertices.reshape(-1, 4)
    kept, faces = np.unique(faces[cage.positions[faces, 2].mean(axis=1) < 0.7], return_inverse=True)
    return ControlCage(cage.positions[kept], faces.reshape(-1, 4))


def inside_out():
    cage = bumpy_cube()
    return ControlCage(cage.positions, cage.face_vertices.reshape(-1, 4)[:, ::-1])


LIT_CAGES = {
    "cube": lambda: cube().refined(),
    "bumpy": bumpy_cube,
    "open": dome,
    "inside out": inside_out,
    "creased": lambda: bumpy_cube(creases=RING),
}
CAMERA = (1.2, -3.6, 1.2)
LIGHTS = {
    "camera": {"type": "directional", "direction": np.negative(CAMERA).tolist(), "irradiance": 3.0},
    "side": {"type": "directional", "direction": [-1, 0.6, -0.4], "irradiance": 3.0},
    "around": {"type": "constant"},
    "lamp": {"type": "sphere", "center": [3, -4, 3], "emitter": {"type": "area", "radiance": 40.0}},
}
DIFFUSE = {"type": "diffuse"}
COLOURED = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_colour"}}
BOTH_SIDES = {"type": "twosided", "bsdf": DIFFUSE}
ROUGH = {"type": "roughconductor", "alpha": 0.3}
# Cage, light, material, rate, integrator, sizes, and parameters: of lit surfaces that no shadow falls on.
LIT = {
    "lit from the camera": ("cube", "camera", DIFFUSE, 2, "direct_projective", [1, 1, 1], {}),
    # Lines beside the outline soon leave the surface where it has another colour.
    "coloured, mirrored": ("cube", "side", COLOURED, 2, "prb_projective", [-1, 1, 1], {}),
    # Triangles are longer than 1.
    "large, flipped": ("inside out", "side", DIFFUSE, 2, "prb_projective", [100, 100, 100], {"flip_normals": True}),
    "rough below a lamp": ("cube", "lamp", ROUGH, 4, "direct_projective", [1, 1, 1], {}),
    "open": ("open", "camera", BOTH_SIDES, 4, "direct_projective", [1, 1, 1], {}),
    "creased": ("creased", "side", DIFFUSE, 2, "prb_projective", [1, 1, 1], {}),
    "lit from around": ("cube", "around", DIFFUSE, 12, "direct_projective", [1, 1, 1], {}),
}


def lit(name, light, bsdf, rate, integrator, sizes, parameters):
    cage = LIT_CAGES[name]()
    if bsdf is COLOURED:
        colours = np.random.default_rng(0).random((cage.vertex_count, 3))
        parameters = {"vertex_colour": upload(mi.TensorXf, colours), **parameters}
    to_world = mi.ScalarTransform4f().scale(sizes)
    shape = described(cage, to_world=to_world, tessellation_rate=rate, shading="exact", bsdf=bsdf, **parameters)
    depth = {"max_depth": 2} if integrator.startswith("prb") else {}
    seen = {"integrator": {"type": integrator, "sppi": 0, **depth}, "light": LIGHTS[light]}
    sampler = {"type": "stratified", "sample_count": 64}
    seen["sensor"] = perspective(64, np.multiply(CAMERA, sizes[1]), fov=FOV, sampler=sampler)
    return scene_with(**seen, shape=shape), cage.positions


def outline(shape, *, emits=False, resolution=32):
    """A black shape before a white sky, or one that emits before nothing: the picture's mean is the outline's area.

    The interior term is left out. It is zero, and so are shadows.
    """
    seen = {"integrator": {"type": "direct_projective", "sppi": 0, "sppc": 0}}
    seen["sensor"] = perspective(resolution, EYE, TARGET, UP, fov=FOV)
    light = {"emitter": {"type": "area", "radiance": 1.0}} if emits else {}
    seen |= {} if emits else {"sky": {"type": "constant"}}
    return scene_with(**seen, shape={**shape, "bsdf": BLACK, **light})


def outline_of(surface, rate=RATE, *, emits=False, **more):
    return outline(described(surface.cage, scheme=surface.scheme.name, tessellation_rate=rate, **more), emits=emits)


def change(surface, direction, rate=RATE):
    """Derivative of the share of the picture that the tessellation covers, by differences."""

    def area(step):
        moved = surface.cage.with_positions(surface.cage.positions + step * direction)
        made = LimitSurface(moved, surface.scheme).tessellate(rate)
        return covered(made.positions, made.triangles)

    return (area(STEP) - area(-STEP)) / (2 * STEP)


def covered(positions, triangles, eye=EYE, target=TARGET, up=UP, fov=FOV):
    """Share of a square picture that is covered by triangles, all of them before the eye and inside the picture.

    Along each of many lines, triangles cover intervals with known ends. Their union is exact; the sum over lines is
    the midpoint rule, of second order as the widths of an outline of straight edges are continuous.
    """
    forward = np.subtract(target, eye)
    right = np.cross(forward, up)
    axes = [axis / np.linalg.norm(axis) for axis in (right, np.cross(right, forward), forward)]
    seen = (positions - eye) @ np.array(axes).T
    # Places in the picture, which reaches from -1 to 1.
    triangles = (seen[:, :2] / (seen[:, 2:] * np.tan(np.radians(fov) / 2)))[triangles]
    upwards = np.argsort(triangles[..., 1], axis=1)
    low, middle, high = np.take_along_axis(triangles, upwards[..., None], 1).swapaxes(0, 1)
    step = 2 / LINES
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
