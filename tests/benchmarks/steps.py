"""Steps of inverse rendering with many shapes: `mi.Mesh` of the same triangles, vertex shading, exact shading, and the
cages of all of them in one shape with exact shading.

python tests/benchmarks/steps.py [--counts 16 64] [--repeats 5]

A step is a picture of `prb`, 64 by 64 pixels with 4 samples, whose gradients come to the control points of all shapes,
or to the vertices of the meshes; then all of these move. In the last column, the picture and its gradients are within a
frozen function. Milliseconds of all processors, the median of the repeats after the first.
"""

import argparse
import time

# Before Dr.Jit, so that it finds an LLVM library that works; it registers the shape, too.
import mitsuba_subdivision as msub

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_subdivision.cage import without_warnings
from mitsuba_subdivision.mitsuba_mesh import mitsuba_mesh
from processes import print_row

from scenes import SIX_CAGES, scene_around, spread

KINDS = {"mesh": "vertex_positions", "vertex": "control_points", "exact": "control_points", "joined": "control_points"}


def scene_of(kind, count):
    """A scene of so many shapes, and its parameters that move."""
    shapes = spread("exact" if kind in ("exact", "joined") else "vertex", SIX_CAGES, count)
    if kind == "mesh":
        shapes = {name: mesh_of(name, shape) for name, shape in shapes.items()}
    elif kind == "joined":
        shapes = {"joined": joined(list(shapes.values()))}
    scene = mi.load_dict(scene_around(shapes, 64, 4, {"type": "prb", "max_depth": 3}))
    parameters = mi.traverse(scene)
    parameters.keep([key for key in parameters.keys() if key.endswith(KINDS[kind])])  # noqa: SIM118
    return scene, parameters


def mesh_of(name, shape):
    """A mesh with the triangles of a shape."""
    source = mi.traverse(mi.load_dict(shape))
    buffers = {key: np.array(source[key]).reshape(-1, 3) for key in ("faces", "vertex_positions", "vertex_normals")}
    return mitsuba_mesh(name, buffers.pop("faces"), buffers)


def joined(shapes):
    """One shape of the cages of all shapes, in world space."""
    cages = []
    for shape in shapes:
        cage, matrix = msub.ControlCage.from_file(shape["filename"]), np.array(shape["to_world"].matrix, dtype=float)
        cages.append(cage.with_positions(cage.positions @ matrix[:3, :3].T + matrix[:3, 3]))
    kept = {key: value for key, value in shapes[0].items() if key not in ("filename", "to_world")}
    with without_warnings():  # Not all of them have texture coordinates
        return {**kept, **msub.joined_cage(cages).as_properties(mi)}


def milliseconds(kind, count, repeats, *, is_frozen):
    """Of a step."""
    scene, parameters = scene_of(kind, count)

    def gradients(scene, parameters, seed):
        dr.backward(dr.mean(mi.render(scene, parameters, seed=seed, spp=4) ** 2, axis=None))

    apply, start, taken = dr.freeze(gradients) if is_frozen else gradients, dict(parameters), []
    for step in range(repeats + 3):
        begun = time.process_time()
        for key, value in start.items():
            moved = dr.opaque(type(value), 0) + dr.detach(value) + dr.opaque(mi.Float, 1e-4 * step)
            dr.enable_grad(moved)
            parameters[key] = moved
        parameters.update()
        apply(scene, parameters, dr.opaque(mi.UInt32, step))
        dr.eval([dr.grad(parameters[key]) for key in start])
        dr.sync_thread()
        taken.append(time.process_time() - begun)
    # A frozen function is recorded twice.
    return np.median(taken[3:]) * 1e3


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--counts", nargs="+", type=int, default=[16, 64])
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    print_row("shapes", "ms a step", "frozen")
    for count in options.counts:
        for kind in KINDS:
            plain, frozen = (milliseconds(kind, count, options.repeats, is_frozen=each) for each in (False, True))
            print_row(f"{count}, {kind}", f"{plain:.0f}", f"{frozen:.0f}")


if __name__ == "__main__":
    main()
