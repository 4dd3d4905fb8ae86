"""Under exact shading, all fields of an interaction have the derivatives of the point at which the ray hits."""

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision import Attribute, ControlCage, LimitSurface
from mitsuba_subdivision.cage import named_cages

RAYS = 256
# Differences over twice this step, in single precision: what values bend within it, and rounding over it, beside a
# derivative and the median of all.
STEP, DIFFERENCE = 2e-3, 1e-2
# Second derivatives of a displaced surface are differences themselves, and have no derivatives.
DISPLACED = 4e-2
# Sums of some thousand derivatives in either order, in single precision.
TRANSPOSED = 1e-3
# The part of rays that may differ: tangents beside extraordinary points (a 64th of each element there), rays that graze
# the surface, and places at which texture coordinates fold.
MOST_OTHERS = 0.08

FIELDS = {
    "t": lambda si: si.t,
    "p": lambda si: si.p,
    "n": lambda si: si.n,
    "shading normal": lambda si: si.sh_frame.n,
    "uv": lambda si: si.uv,
    "dp_du": lambda si: si.dp_du,
    "dp_dv": lambda si: si.dp_dv,
    "dn_du": lambda si: si.dn_du,
    "dn_dv": lambda si: si.dn_dv,
}
FLAGS = mi.RayFlags.All | mi.RayFlags.dNSdUV


def cage_of(scheme):
    """With texture coordinates on the surface, and heights."""
    cage = named_cages.extraordinary_triangles(5) if scheme == "loop" else named_cages.cube()
    x, y, z = cage.positions.T
    return ControlCage(
        cage.positions,
        np.split(cage.face_vertices, np.cumsum(cage.face_sizes)[:-1]),
        texcoords=Attribute(np.stack([0.3 * x + 0.11 * z, 0.3 * y + 0.23 * z], axis=1), "vertex"),
        attributes={"height": Attribute((0.2 + 0.1 * x * y - 0.05 * z)[:, None])},
    )


def rays_at(cage, scheme):
    """From outside towards places within."""
    inside, centre = LimitSurface(cage, scheme).sample(RAYS, 1), cage.positions.mean(axis=0)
    o = inside.p + inside.n
    d = centre + 0.9 * (inside.p - centre) - o
    return mi.Ray3f(msub.upload(mi.Point3f, o.T), msub.upload(mi.Vector3f, d.T))


@pytest.mark.parametrize("by", ["control_points", "to_world", "cage_texcoords", "cage_height", "displacement_scale"])
@pytest.mark.parametrize("scheme", ["catmull_clark", "loop", "doo_sabin"])
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_every_field_follows_the_hit(scheme, by, np_rng):
    """Those of `dp_du` and `dp_dv` left out that it moves, and were wrong by half."""
    if (scheme, by) == ("doo_sabin", "cage_height"):
        pytest.skip("forward mode by attributes that displace the surface ends in an error of Dr.Jit's here")
    cage, is_displaced = cage_of(scheme), by in ("cage_height", "displacement_scale")
    shape = {"type": "subdivision", **cage.as_properties(mi), "scheme": scheme, "shading": "exact"}
    shape |= {"displacement": "vertex_height"} if is_displaced else {}
    scene = mi.load_dict({"type": "scene", "shape": {**shape, "tessellation_rate": 8}})
    parameters, key, ray = mi.traverse(scene), f"shape.{by}", rays_at(cage, scheme)
    given = type(parameters[key])(parameters[key])
    moves = 0.3 * np_rng.normal(size=dr.width(given))

    def fields(step):
        if by == "to_world":
            parameters[key] = mi.AffineTransform4f().translate([0.3 * step, step, -0.5 * step]) @ given
        elif by == "displacement_scale":
            parameters[key] = given + 0.3 * step
        else:
            parameters[key] = given + step * msub.upload(mi.Float, moves)
        parameters.update()
        si = scene.ray_intersect(ray, FLAGS, True)
        # Dr.Jit clears the derivatives of what others are computed from.
        found = {name: dr.ravel(1 * field(si)) for name, field in FIELDS.items()}
        dr.eval(found)
        return found

    ahead, behind = (fields(mi.Float(sign * STEP)) for sign in (1, -1))
    step = mi.Float(0)
    dr.enable_grad(step)
    found = fields(step)
    dr.set_grad(step, 1)
    dr.forward_to(*found.values())
    forward = {name: dr.grad(each).numpy() for name, each in found.items()}
    weights, expected, total = np_rng.choice([-1.0, 1.0], 3 * RAYS), 0.0, 0.0
    step = mi.Float(0)
    dr.enable_grad(step)
    found = fields(step)
    for name in FIELDS:
        differences = (ahead[name].numpy() - behind[name].numpy()) / (2 * STEP)
        error, size = (
            np.abs(each).reshape(RAYS, -1).max(axis=1) for each in (forward[name] - differences, differences)
        )
        unit = np.median(size) or 1.0
        if not (is_displaced and name.startswith("dn_")):
            assert np.mean(error > (DISPLACED if is_displaced else DIFFERENCE) * (unit + size)) <= MOST_OTHERS, name
        own = weights[: len(differences)] / unit
        total += dr.sum(found[name] * msub.upload(mi.Float, own))
        expected += (own * forward[name]).sum()
    dr.backward(total)
    assert dr.grad(step)[0] == pytest.approx(expected, rel=TRANSPOSED)
