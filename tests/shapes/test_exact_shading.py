"""Exact shading in renders, against the limit surface itself and against tessellations far finer than any pixel."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface, example_file, upload
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.shapes.interaction_hook import hook_problem
from patches.closed_cages import cube_with_hexagon, extraordinary_triangles, tetrahedron
from reference.refined_cages import sheet
from scipy import ndimage
from shapes.cages import MIRRORED, RING, SHEARED, bitmap, cube, described, textured
from shapes.scenes import camera_rays, perspective, rays, rows, scene_with
from shapes.variants import llvm

if hook_problem():
    pytest.skip(str(hook_problem()), allow_module_level=True)

pytestmark = llvm

FINE, RESOLUTION = 12, 32
# Resolution of pictures of which only the hits are compared.
EDGE = 64
# Places and normals in float32, relative to a cage of size one.
SINGLE = 5e-6
NORMAL = 2e-5
# Derivatives are differences of control points; those of normals, of derivatives.
DERIVATIVE, SECOND = 2e-5, 1e-3
# Where two tessellations have the same image but for noise, and the pixels' noise is the same for both.
ENERGY = 0.01
# A normal this far away is that of another place. Rounding makes 1e-5.
ELSEWHERE = 1e-2


def make(cage, **parameters):
    return described(cage, **{"shading": "exact", "tessellation_rate": 2, **parameters})


def bowl():
    x, y, _ = sheet(8, 8).positions.T / 4 - 1
    return sheet(8, 8).with_positions(np.stack([x, y, 0.7 * (x**2 + y**2)], axis=1))


SURFACES = {
    "cube": (cube, "catmull_clark"),
    "textured": (textured, "catmull_clark"),
    "plane": (lambda: sheet(2, 2), "catmull_clark"),
    "far": (lambda: cube().with_positions(cube().positions + 1000), "catmull_clark"),
    "dome": (lambda: named_cages.extraordinary(7, closed=False), "catmull_clark"),
    "mixed": (cube_with_hexagon, "catmull_clark"),
    "crease": (lambda: cube(creases=RING), "catmull_clark"),
    "semi-sharp": (lambda: cube(creases=[(a, b, 2.5) for a, b, _ in RING]), "catmull_clark"),
    "Loop ball": (lambda: extraordinary_triangles(8), "loop"),
    "Doo-Sabin cube": (cube, "doo_sabin"),
    "Doo-Sabin tetrahedron": (tetrahedron, "doo_sabin"),
}
EYE = (2.2, -3.2, 2.0)


def sensor(origin=EYE, target=(0, 0, 0), fov=30, resolution=RESOLUTION):
    return perspective(resolution, origin, target, fov=fov)


def scene_of(shape, integrator="direct", light=None, view=None, **more):
    integrator = {"type": integrator} if isinstance(integrator, str) else integrator
    light = light or {"type": "constant"}
    return scene_with(integrator=integrator, sensor=sensor(**view or {}), light=light, shape=shape, **more)


def image(*arguments, spp=16, seed=1, **keywords):
    return np.array(mi.render(scene_of(*arguments, **keywords), spp=spp, seed=seed))


def images(rates, cage, parameters, *arguments, **keywords):
    return [image(make(cage, tessellation_rate=rate, **parameters), *arguments, **keywords) for rate in rates]


def hits(shape, met_by, flags=None):
    flags = mi.RayFlags.All | mi.RayFlags.dNSdUV if flags is None else flags
    si = scene_with(shape=shape).ray_intersect(met_by, flags, True)
    # In one kernel: each of its values alone would have one of its own, for each surface and rate.
    dr.eval(si)
    return si


def inside(si, other, resolution=RESOLUTION):
    """Pixels inside both outlines, and away from where the surface hides itself."""
    both = (np.array(si.is_valid()) & np.array(other.is_valid())).reshape(resolution, resolution)
    depth = np.where(both, np.array(other.t).reshape(both.shape), 0)
    jumps = np.zeros_like(both)
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis, append=0)) > 0.5
        jumps |= step | np.roll(step, 1, axis)
    # Twice without the pixels next to others.
    return ndimage.binary_erosion(both & ~jumps, iterations=2).ravel()


TRIANGLES = [{"tessellation_rate": FINE}, {"tessellation_rate": 1}, {"tessellation": "adaptive", "max_edge": 0.5}]


@pytest.mark.parametrize("name", ["dome", "mixed", "crease", "Loop ball", "Doo-Sabin tetrahedron"])
def test_normals_do_not_depend_on_the_tessellation(name):
    cage, scheme = SURFACES[name]
    shapes = (described(cage(), shading="exact", scheme=scheme, **triangles) for triangles in TRIANGLES)
    fine, *coarse = (hits(shape, camera_rays(EDGE), mi.RayFlags.All) for shape in shapes)
    for si in coarse:
        seen = inside(si, fine, EDGE)
        assert seen.sum() > EDGE
        assert (np.linalg.norm(rows(si.n) - rows(fine.n), axis=1)[seen] < ELSEWHERE).all()
        is_hit = np.array(si.is_valid())
        for value in (si.p, si.n, si.sh_frame.n, si.uv, si.dp_du, si.dp_dv):
            assert np.isfinite(rows(value)[is_hit]).all()


@pytest.mark.parametrize(
    ("name", "matrix", "flips"),
    [
        ("semi-sharp", np.eye(4), False),
        ("crease", MIRRORED, True),
        ("far", np.eye(4), False),
        ("textured", SHEARED, False),
        ("plane", np.eye(4), True),
        ("mixed", SHEARED, True),
        ("Loop ball", MIRRORED, False),
        ("Doo-Sabin cube", SHEARED, False),
    ],
)
def test_hits_lie_on_the_limit_surface(name, matrix, flips, np_rng):
    """Of rays at points all over it; derivatives by texture coordinates where there are any, in the world."""
    made, scheme = SURFACES[name]
    cage, (linear, offset), step = made(), (matrix[:3, :3], matrix[:3, 3]), 1e-4
    surface, sign = LimitSurface(cage, scheme), -1 if flips else 1
    element = np_rng.integers(0, surface.patches.elements.face_count, 100)
    corner = np_rng.integers(0, surface.patches.elements.face_sizes[element]) * ~surface.patches.is_whole[element]
    uv = np_rng.uniform(0.05, 0.45 if scheme == "loop" else 0.95, (100, 2))

    def at(uv):
        """Points, normals and texture coordinates."""
        samples = surface.evaluate(element, uv, corner)
        n = sign * samples.n @ np.linalg.inv(linear)
        st = surface.evaluate_attribute("texcoords", element, uv, corner) if name == "textured" else uv
        return samples.p @ linear.T + offset, n / np.linalg.norm(n, axis=1, keepdims=True), st

    p, n, st = at(uv)
    by_uv = [[(a - b) / (2 * step) for a, b in zip(at(uv + d), at(uv - d), strict=True)] for d in step * np.eye(2)]
    dp, dn, dst = (np.stack(pair, axis=-1) for pair in zip(*by_uv, strict=True))
    to_world = mi.ScalarTransform4f(matrix)
    si = hits(make(cage, scheme=scheme, flip_normals=flips, to_world=to_world), rays(p + 0.5 * sign * n, -sign * n))
    # The rays' own rounding far from the origin is that of their points.
    rounding = max(1, 4 * np.spacing(np.float32(np.abs(p).max())) / SINGLE)
    for values, expected in ((si.p, p), (si.n, n), (si.sh_frame.n, n), (si.uv, st)):
        assert np.abs(rows(values) - expected).max() < SINGLE * rounding
    for by_st, expected, tolerance in (((si.dp_du, si.dp_dv), dp, DERIVATIVE), ((si.dn_du, si.dn_dv), dn, SECOND)):
        off = np.abs(np.stack([rows(values) for values in by_st], axis=-1) @ dst - expected).max(axis=(1, 2))
        # Second derivatives of biquadratic pieces jump from one to the next.
        assert np.quantile(off, 0.95 if scheme == "doo_sabin" else 1) < tolerance * rounding


def test_rays_through_folds_move_less_than_a_triangle_and_symmetrically(np_rng):
    """Else one that passes an edge of a coarse triangle would be led to another part of the surface."""
    cage = ControlCage.from_file(example_file("cages/propeller.obj"))
    low, high = cage.positions.min(axis=0), cage.positions.max(axis=0)
    o = (low + high) / 2 + np.linalg.norm(high - low) * np_rng.normal(size=(8000, 3))
    d = np_rng.uniform(low, high, o.shape) - o
    d /= np.linalg.norm(d, axis=1)[:, None]

    def met_by_rays(mirror, shading="exact"):
        to_world = mi.ScalarTransform4f().scale(mirror)
        return hits(make(cage, tessellation_rate=1, to_world=to_world, shading=shading), rays(o * mirror, d * mirror))

    exact, mirrored, coarse = met_by_rays([1, 1, 1]), met_by_rays([-1, 1, 1]), met_by_rays([1, 1, 1], "vertex")
    met = np.array(coarse.is_valid())
    assert met.mean() > 0.3
    np.testing.assert_array_equal(np.array(exact.is_valid()), met)
    np.testing.assert_array_equal(np.array(mirrored.is_valid()), met)
    moved = np.linalg.norm(rows(exact.p) - rows(coarse.p), axis=1)
    large = np.maximum(*(np.linalg.norm(rows(side), axis=1) for side in (coarse.dp_du, coarse.dp_dv)))
    assert (moved[met] <= large[met]).all()
    apart = np.abs(rows(exact.sh_frame.n) - rows(mirrored.sh_frame.n) * [-1, 1, 1])[met].max(axis=1)
    # Rounding leads a search in a thousand elsewhere; beginnings in another place, one in fifty.
    assert (apart > NORMAL).mean() < 4e-3


def sky():
    """Stripes around the horizon, brighter upwards."""
    rows_, columns = np.indices((16, 64))
    radiance = (1 - rows_ / 20) * (1 + 0.8 * np.sin(2 * np.pi * columns / 16))
    return {"type": "envmap", "bitmap": mi.Bitmap(np.repeat(radiance[..., None], 3, axis=2).astype(np.float32))}


def matte():
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}}}


def test_no_facet_is_dark_on_a_convex_surface():
    rates, lamp = (FINE, 1), {"type": "point", "position": [-3, -1, 2.5], "intensity": 10.0}
    shapes = (make(cube(), tessellation_rate=rate) for rate in rates)
    where = inside(*(hits(shape, camera_rays(RESOLUTION), mi.RayFlags.All) for shape in shapes))
    pictures = images(rates, cube(), {"bsdf": matte()}, "direct", lamp, spp=64)
    lit, seen = (picture.mean(axis=2).ravel()[where] for picture in pictures)
    assert seen.sum() == pytest.approx(lit.sum(), rel=ENERGY)
    # The same samples meet the same surface, so that only those near the terminator can differ.
    assert (np.abs(seen - lit) > 0.1 * lit.max()).sum() <= 2


def test_a_bowl_seen_from_inside_does_not_shadow_itself():
    integrator, view = {"type": "path", "max_depth": 6}, {"origin": (0.1, -1, 3)}
    pictures = images((1, 16), bowl(), {"bsdf": matte()}, integrator, view=view, spp=64)
    seen, fine = (picture.mean(axis=2) for picture in pictures)
    assert seen.mean() == pytest.approx(fine.mean(), rel=ENERGY)
    # Noise of 64 samples; a false shadow would halve a pixel.
    assert np.abs(seen - fine).max() < 0.25 * fine.mean()


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def checkerboard():
    colours = {"color0": rgb(0.2, 0.3, 0.2), "color1": rgb(0.8, 0.6, 0.9)}
    return {"type": "checkerboard", **colours, "to_uv": mi.ScalarTransform4f().scale([2, 2, 1])}


def waves(channels):
    y, x = np.indices((32, 32)) / 32
    heights = 0.5 + 0.2 * np.sin(2 * np.pi * x) * np.cos(2 * np.pi * y)
    return bitmap(np.stack([heights, 1 - heights, 0 * x + 1], axis=-1)[..., :channels])


def metal(**parameters):
    return {"type": "roughconductor", "alpha": 0.15, **parameters}


MATERIALS = {
    "brushed": lambda: {"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 0.4},
    "normal map": lambda: {"type": "normalmap", "normalmap": waves(3), "bsdf": metal()},
    "bump map": lambda: {"type": "bumpmap", "arbitrary": waves(1), "scale": 0.2, "bsdf": metal()},
    "mask": lambda: {"type": "mask", "opacity": checkerboard(), "bsdf": {"type": "diffuse"}},
    "blend": lambda: {"type": "blendbsdf", "weight": waves(1), "one": {"type": "diffuse"}, "two": metal()},
    "principled": lambda: {"type": "principled", "roughness": 0.3, "metallic": 0.7, "anisotropic": 0.6},
    "attributes": lambda: {"type": "principled", "roughness": attribute("heat"), "base_color": attribute("colour")},
}


def heat_and_colour():
    colour = np.random.default_rng(0).uniform(0.2, 0.8, (8, 3))
    heat = np.linspace(0.1, 0.6, 8)[:, None]
    return {"vertex_heat": upload(mi.TensorXf, heat), "vertex_colour": upload(mi.TensorXf, colour)}


def attribute(name):
    return {"type": "mesh_attribute", "name": f"vertex_{name}"}


# Without texture coordinates, those that need tangents or the surface's own parameters.
SHOWN = [
    *((name, name != "attributes") for name in MATERIALS),
    *((name, False) for name in ("brushed", "normal map", "bump map")),
]


@pytest.mark.long
def test_materials_look_the_same_at_every_rate():
    """All in one picture, far from each other and each before a sensor of its own: one kernel for all."""

    def seen(rate):
        sensors, shapes = {}, {}
        for i, (material, has_texcoords) in enumerate(SHOWN):
            aside = [30.0 * (i % 4 - 1.5), 30.0 * (i // 4 - 1.5), 0.0]
            # Of one side, so that no pixel lies at an outline.
            sensors[f"view_{i:02}"] = sensor(np.add(EYE, aside), aside, fov=12)
            cage, given = (textured(), {}) if has_texcoords else (cube(), heat_and_colour())
            given["to_world"] = mi.ScalarTransform4f().translate(aside)
            shapes[f"shape_{i:02}"] = make(cage, tessellation_rate=rate, bsdf=MATERIALS[material](), **given)
        wide = {**sensor()["film"], "width": len(SHOWN) * RESOLUTION}
        integrator, batch = {"type": "path"}, {"type": "batch", "film": wide, **sensors}
        scene = scene_with(integrator=integrator, sensor=batch, light=sky(), **shapes)
        return np.split(np.array(mi.render(scene, spp=16, seed=1)), len(SHOWN), axis=1)

    for name, coarse, fine in zip(SHOWN, seen(2), seen(32), strict=True):
        assert np.isfinite(coarse).all(), name
        assert fine.mean() > 0.05, name
        assert coarse.mean() == pytest.approx(fine.mean(), rel=ENERGY), name
        apart = np.abs(coarse - fine).mean(axis=2)
        # The same samples but for a pixel that rounding moves to another lobe or square.
        assert np.median(apart) < 1e-3, name
        assert (apart > 0.1).mean() < 0.02, name


def test_emitters_light_a_floor_with_every_sampling_strategy():
    """Emitters are sampled on triangles; what hits them counts with the weight of that place and normal."""
    below, dark = mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(3), {"type": "constant", "radiance": 1e-6}
    floor, emitter = {"type": "rectangle", "to_world": below}, {"type": "area", "radiance": rgb(1, 1, 1)}
    view = {"origin": (0, -4, 3), "target": (0, 0, -1)}
    coarse, fine = images((8, 16), cube(), {"emitter": emitter}, light=dark, view=view, spp=256, floor=floor)
    assert coarse.mean() == pytest.approx(fine.mean(), rel=ENERGY)
    shape = make(cube(), tessellation_rate=1, emitter=emitter)
    view = {"origin": (0, -4, 1), "target": (0, 0, -1.2), "fov": 12}
    rough = {**floor, "bsdf": {"type": "roughconductor", "alpha": 0.3}}
    strategies = [{"type": "direct", "emitter_samples": e, "bsdf_samples": b} for e, b in ((1, 0), (0, 1), (1, 1))]
    means = [image(shape, strategy, dark, view, spp=256, floor=rough).mean() for strategy in strategies]
    assert means == pytest.approx([means[2]] * 3, rel=ENERGY)
    # The ray goes on from where it has hit: from before the triangle, it would hit it for ever.
    for integrator in ("path", "direct"):
        assert np.isfinite(image(shape, {"type": integrator, "hide_emitters": True}, floor=floor, spp=4)).all()


@pytest.mark.parametrize("eye", [(0.3, -0.2, 5), (0.3, -0.2, -5)])
def test_attributes_agree_on_both_sides(eye, np_rng):
    """`twosided` turns the direction to the viewer over where it shows the back."""
    heat = upload(mi.TensorXf, np_rng.uniform(size=(81, 1)))
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": attribute("heat")}}
    integrator, view = {"type": "aov", "aovs": "albedo:albedo"}, {"origin": eye, "target": (0, 0, 0.3), "fov": 12}
    coarse, fine = images((1, 16), bowl(), {"vertex_heat": heat, "bsdf": bsdf}, integrator, view=view, spp=1)
    assert np.median(np.abs(coarse - fine)[..., -3:]) < 1e-4


def test_light_passes_through():
    fog, pictures = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 1.0}, []
    for rate in (8, 32):
        left, right = (mi.ScalarTransform4f().translate([x, 0, 0]) for x in (-0.8, 0.8))
        glass = make(cube(), tessellation_rate=rate, bsdf={"type": "dielectric"}, to_world=left)
        cloud = make(cube(), tessellation_rate=rate, bsdf={"type": "null"}, interior=fog, to_world=right)
        scene = scene_of(glass, {"type": "volpath", "max_depth": 8}, sky(), {"fov": 24}, cloud=cloud)
        pictures.append(np.array(mi.render(scene, spp=64, seed=1)))
    assert np.isfinite(pictures[0]).all()
    for seen, fine in zip(*(np.split(picture, 2, axis=1) for picture in pictures), strict=True):
        assert seen.mean() == pytest.approx(fine.mean(), rel=2 * ENERGY)


# Instances are in test_interaction_hook.py.
def test_merged_shapes_are_hit_like_others():
    to_world = mi.ScalarTransform4f().translate([1, 2, 3]).rotate([0.6, 0.8, 0], 50).scale([1, 0.6, 1.4])
    along = camera_rays(RESOLUTION, origin=(5, -4, 5), target=(1, 2, 3), fov=16)
    placed, aside = (make(cube(), to_world=t) for t in (to_world, mi.ScalarTransform4f().translate([9, 0, 0])))
    scene = scene_with(merged={"type": "merge", "aside": aside, "placed": placed})
    si, expected = scene.ray_intersect(along), hits(placed, along, mi.RayFlags.All)
    seen = inside(si, expected)
    assert seen.sum() > RESOLUTION
    for value, other in ((si.sh_frame.n, expected.sh_frame.n), (si.uv, expected.uv), (si.dp_du, expected.dp_du)):
        np.testing.assert_allclose(rows(value)[seen], rows(other)[seen], atol=NORMAL)
