"""Under exact shading, all fields of an interaction have the derivatives of the point at which the ray hits."""

import json
import subprocess
import sys
from operator import attrgetter
from pathlib import Path

if __name__ == "__main__":
    sys.path.append(str(Path(__file__).parents[1]))
    import quick_kernels  # noqa: F401 - before drjit, as it chooses the LLVM library

# Before Mitsuba, for an LLVM library that works.
from patches.closed_cages import extraordinary_triangles

import mitsuba_subdivision as msub  # isort: skip
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import Attribute, ControlCage, LimitSurface
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.llvm import llvm_problem

RAYS = 256
# Differences over twice this step, in single precision: what values bend within it, and rounding over it, beside a
# derivative and the median of all.
STEP, DIFFERENCE = 2e-3, 1e-2
# Second derivatives of a displaced surface are differences themselves, and have no derivatives.
DISPLACED = 4e-2
# The part of rays that may differ: tangents beside extraordinary points (a 64th of each element there), rays that graze
# the surface, and places at which texture coordinates fold.
MOST_OTHERS = 0.08
PLAIN, DISPLACING = ("control_points", "to_world", "cage_texcoords"), ("displacement_scale", "cage_height")
# What moves at once, as compiling takes longest. Forward mode by attributes that displace a surface ends in an error of
# Dr.Jit's under Doo-Sabin.
BY = {
    "catmull_clark": [PLAIN, DISPLACING],
    "loop": [PLAIN, DISPLACING],
    "doo_sabin": [PLAIN, DISPLACING[:1]],
}

FIELDS = ("t", "p", "n", "sh_frame.n", "uv", "dp_du", "dp_dv", "dn_du", "dn_dv")


def cage_of(scheme):
    """With texture coordinates on the surface, and heights."""
    cage = extraordinary_triangles(5) if scheme == "loop" else named_cages.cube()
    x, y, z = cage.positions.T
    texcoords = np.stack([0.3 * x + 0.11 * z, 0.3 * y + 0.23 * z], axis=1)
    height = Attribute((0.2 + 0.1 * x * y - 0.05 * z)[:, None])
    given = cage.positions, cage.face_sizes, cage.face_vertices
    return ControlCage.from_arrays(*given, texcoords=Attribute(texcoords, "vertex"), attributes={"height": height})


def rays_at(cage, scheme):
    """From outside towards places within, aslant: along its normals, a surface moves by no texture coordinate."""
    inside, centre = LimitSurface(cage, scheme).sample(RAYS, 1), cage.positions.mean(axis=0)
    o = inside.p + inside.n
    d = centre + 0.5 * (np.roll(inside.p, 1, axis=0) - centre) - o
    return mi.Ray3f(msub.upload(mi.Point3f, o), msub.upload(mi.Vector3f, d))


def wrong_parts(scheme, moved):
    """Of each field, the part of the rays whose derivative by parameters that move is not that of differences."""
    cage, is_displaced = cage_of(scheme), moved[0] in DISPLACING
    shape = {"type": "subdivision", **cage.as_properties(mi), "scheme": scheme, "shading": "exact"}
    shape |= {"displacement": "vertex_height"} if is_displaced else {}
    scene = mi.load_dict({"type": "scene", "shape": {**shape, "tessellation_rate": 8}})
    parameters, ray, rng = mi.traverse(scene), rays_at(cage, scheme), np.random.default_rng(0)
    given = {f"shape.{name}": type(parameters[f"shape.{name}"])(parameters[f"shape.{name}"]) for name in moved}
    moves = {key: msub.upload(mi.Float, 0.3 * rng.normal(size=dr.width(value))) for key, value in given.items()}

    def fields(step):
        for key, value in given.items():
            if key == "shape.to_world":
                parameters[key] = mi.AffineTransform4f().translate([0.3 * step, step, -0.5 * step]) @ value
            else:
                parameters[key] = value + step * moves[key]
        parameters.update()
        si = scene.ray_intersect(ray, mi.RayFlags.All | mi.RayFlags.dNSdUV, True)
        # Dr.Jit clears the derivatives of what others are computed from.
        derivatives = {name: dr.ravel(1 * attrgetter(name)(si)) for name in FIELDS}
        dr.eval(derivatives)
        return derivatives

    ahead, behind = (fields(dr.opaque(mi.Float, sign * STEP)) for sign in (1, -1))
    # In Dr.Jit 1.5, products with a literal zero change its width.
    step = dr.opaque(mi.Float, 0)
    dr.enable_grad(step)
    derivatives = fields(step)
    dr.set_grad(step, 1)
    dr.forward_to(*derivatives.values())
    wrong = {}
    for name in FIELDS:
        differences = (ahead[name].numpy() - behind[name].numpy()) / (2 * STEP)
        error = np.abs(dr.grad(derivatives[name]).numpy() - differences).reshape(RAYS, -1).max(axis=1)
        size = np.abs(differences).reshape(RAYS, -1).max(axis=1)
        unit = np.median(size) or 1.0
        wrong[name] = np.mean(error > (DISPLACED if is_displaced else DIFFERENCE) * (unit + size))
    return wrong


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop", "doo_sabin"])
@pytest.mark.skipif(llvm_problem() is not None, reason="no usable LLVM")
def test_every_field_follows_the_hit(scheme):
    """Those of `dp_du` and `dp_dv` left out that it moves, and were wrong by half.

    In a process of its own: forward mode through loops may raise an error of Dr.Jit's (1.5) after other derivatives.
    """
    done = subprocess.run([sys.executable, __file__, scheme], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for moved, wrong in zip(BY[scheme], json.loads(done.stdout.splitlines()[-1]), strict=True):
        for name, part in wrong.items():
            assert part <= MOST_OTHERS or (moved[0] in DISPLACING and name.startswith("dn_")), (moved, name)


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    print(json.dumps([wrong_parts(sys.argv[1], moved) for moved in BY[sys.argv[1]]]))  # noqa: T201
