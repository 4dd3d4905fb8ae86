"""Curves of stages: their conversion beside de Casteljau's algorithm, and where rays hit them."""

from functools import partial, reduce

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.studio import Look, StillPicture
from mitsuba_subdivision.studio.saving import save_scene
from mitsuba_usd import StageScenes
from mitsuba_usd.stage_curves import CurveTopology
from scipy.interpolate import BSpline
from usd import stages
from usd.stages import bound, camera, material, moved, prim, shader, told

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")

# Of two ways to a point in double precision.
ROUNDING = 1e-12
# Part of a radius within which rays hit or miss: roots are found in single precision.
EDGE = 0.01
PLACES = np.linspace(0, 1, 5)
# Points of each segment's Bezier form, of those around it.
TO_BEZIER = {
    "bezier": np.eye(4),
    "bspline": np.array([[1, 4, 1, 0], [0, 4, 2, 0], [0, 2, 4, 0], [0, 1, 4, 1]]) / 6,
    "catmullRom": np.array([[0, 6, 0, 0], [-1, 6, 1, 0], [0, 1, 6, -1], [0, 0, 6, 0]]) / 6,
}


def casteljau(points):
    """Points at `PLACES` of a Bezier curve."""
    t = PLACES[:, None, None]
    return reduce(lambda given, _: (1 - t) * given[:, :-1] + t * given[:, 1:], range(3), points[None])[:, 0]


@pytest.mark.parametrize("wrap", ["nonperiodic", "periodic", "pinned"])
@pytest.mark.parametrize("basis", TO_BEZIER)
@pytest.mark.parametrize("interpolation", ["uniform", "varying", "vertex"])
def test_converted_curves_are_those_of_de_casteljau(basis, wrap, interpolation):
    step, counts = (3, [6, 9] if wrap == "periodic" else [4, 10]) if basis == "bezier" else (1, [5, 7])
    rng = np.random.default_rng(1)
    topology = CurveTopology(np.array(counts), basis, wrap)
    ends = [int(n) + (wrap != "periodic") for n in topology.segments]
    sizes = {"uniform": [1, 1], "varying": ends, "vertex": counts}[interpolation]
    points, radii = ([rng.random((n, k)) for n in of_curves] for of_curves, k in ((counts, 3), (sizes, 1)))
    made = topology.curve_set(np.concatenate(points), np.concatenate(radii), interpolation)
    found = []
    for controls in np.split(made.points, np.cumsum(made.counts)[:-1]):
        spline = BSpline(np.arange(len(controls) + 4), controls, 3)
        found += [spline(3 + number + PLACES) for number in range(len(controls) - 3)]
    expected = []
    for of_curve, r in zip(points, radii, strict=True):
        values = np.column_stack([of_curve, r if interpolation == "vertex" else np.zeros(len(of_curve))])
        if wrap == "periodic":
            values = np.concatenate([values, values[: 4 - step]])
        elif wrap == "pinned" and basis != "bezier":
            values = np.array([2 * values[0] - values[1], *values, 2 * values[-1] - values[-2]])
        for number, row in enumerate(range(0, len(values) - 3, step)):
            along = casteljau(TO_BEZIER[basis] @ values[row : row + 4])
            if interpolation != "vertex":
                ends = r[[0, 0]] if interpolation == "uniform" else r[[number, (number + 1) % len(r)]]
                along[:, 3:] = ends[0] + PLACES[:, None] * (ends[1] - ends[0])
            expected.append(along)
    np.testing.assert_allclose(found, expected, atol=ROUNDING)


# Two straight curves along x, one above the other, on which the parameter of a segment is linear.
STRAIGHT = [(x, y, 0) for y in (0, 2) for x in range(-3, 4)]


def hair(*lines, name="hair", kind="cubic", basis="bezier"):
    kinds = f'uniform token type = "{kind}"\nuniform token basis = "{basis}"\nuniform token wrap = "nonperiodic"'
    points = f"int[] curveVertexCounts = [7, 7]\npoint3f[] points = {STRAIGHT}"
    return prim("BasisCurves", name, kinds, points, *lines, apis=["MaterialBindingAPI"])


def widths(interpolation, values):
    return f'float[] widths = {values} (interpolation = "{interpolation}")'


def hits(scene, places):
    rays = (mi.Ray3f(mi.Point3f(*place, 9), mi.Vector3f(0, 0, -1)) for place in places)
    return [scene.ray_intersect(ray) for ray in rays]


@pytest.fixture
def stage(tmp_path):
    return partial(stages.write, tmp_path)


@pytest.mark.parametrize(
    ("kind", "basis", "interpolation", "values", "variant"),
    [
        ("linear", "bezier", "constant", [0.4], "llvm_ad_rgb"),
        ("cubic", "bspline", "uniform", [0.4, 0.2], "scalar_rgb"),
        ("cubic", "catmullRom", "constant", [0.4], "scalar_rgb"),
        ("cubic", "bezier", "varying", [0.6, 0.3, 0.0, 0.4, 0.4, 0.4], "scalar_rgb"),
        ("linear", "bezier", "vertex", [*np.linspace(0.6, 0, 7).tolist(), *[0.4] * 7], "scalar_rgb"),
    ],
)
def test_straight_curves_cover_their_widths(request, stage, tmp_path, kind, basis, interpolation, values, variant):
    """Also mirrored and twice as large, in a saved scene, as instances, and as copies of many in JIT variants."""
    request.getfixturevalue(f"variant_{variant}")
    text = hair(widths(interpolation, values), kind=kind, basis=basis)
    path = stage(prim("Xform", "placed", moved(translate=(0, 0, 1), scale=(-2, 2, 2)), text) + camera())
    entries = StillPicture(StageScenes(path, Look(has_studio=False), {})).scene
    save_scene(entries, tmp_path / "saved.xml")
    group = camera() + prim("Xform", "group", moved(scale=(-2, 2, 2)), text)
    reference = "instanceable = true\nreferences = </group>"
    many = [prim("Xform", f"i{n}", moved(translate=(0, 0, -n)), head=reference) for n in range(70)]
    scenes = [mi.load_dict(msub.usd_scene(path, mi)), mi.load_file(str(tmp_path / "saved.xml"))]
    scenes += [mi.load_dict(msub.usd_scene(stage(group + "".join(part)), mi)) for part in (many[:2], many)]
    wide = [0.49 if interpolation in ("varying", "vertex") else values[0], values[-1]]
    for scene in scenes:
        for y, width in zip((0, 4), wide, strict=True):
            # Where x is -1.9 in the curve, and widths that vary have lost 0.1 for each unit.
            places = [(3.8, y + sign * width * (1 + EDGE * edge)) for edge in (-1, 1) for sign in (-1, 1)]
            assert [np.all(si.is_valid()) for si in hits(scene, places)] == [True, True, False, False]


@pytest.mark.parametrize(
    ("interpolation", "values", "expected"),
    [
        ("constant", [0.5], [0.5, 0.5, 0.5, 0.5]),
        ("uniform", [0.25, 0.75], [0.25, 0.25, 0.75, 0.75]),
        # In the first and the last of the eight steps of the first segment, from -3 to 0.
        ("varying", [0.0, 0.8, 0.8, 1.0, 0.2, 0.2], [0.05, 0.75, 0.95, 0.25]),
        ("vertex", [*np.linspace(0, 1.2, 7).tolist(), *[0.4] * 7], [0.0375, 0.5625, 0.4, 0.4]),
    ],
)
@pytest.mark.parametrize("binding", ["", bound()])
def test_colours_along_curves(stage, interpolation, values, expected, binding):
    """Without a material, and of one that reads them."""
    colours = f"color3f[] primvars:displayColor = {[(value, 0, 0) for value in values]}"
    reader = 'string inputs:varname = "displayColor"\nfloat3 outputs:result'
    connected = "color3f inputs:diffuseColor.connect = </paint/reader.outputs:result>"
    paint = material(connected, shader("reader", "UsdPrimvarReader_float3", reader))
    colours += f' (interpolation = "{interpolation}")'
    text = hair(widths("constant", [0.4]), colours, binding) + camera() + paint
    scene = mi.load_dict(msub.usd_scene(stage(text), mi))
    places = [(x, y) for y in (0, 2) for x in (-3 + 3 / 16, -3 / 16)]
    found = [si.bsdf().eval_diffuse_reflectance(si)[0] for si in hits(scene, places)]
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("(0, 0, 0)", "(0, 5, 0)"), "cubic curves with corners have gaps there"),
        (("[7, 7]", "[7, 3, 4]"), "curves with too few points are left out"),
        (("point3f[]", "normal3f[] normals = [(0, 0, 1)]\npoint3f[]"), "normals of curves are ignored"),
        (("point3f[]", f"{moved(scale=(1, 1, 2))}point3f[]"), "curves stay round where transforms stretch them"),
        (('prepend apiSchemas = ["', 'prepend apiSchemas = ["SkelBindingAPI", "'), "skeletons of curves are ignored"),
        (("rel material", 'float[] primvars:a = [1, 2, 3] (interpolation = "vertex")\nrel material'), "another number"),
        (("[0.4]", "[0.4, 0.4, 0.4]"), "there are 3 constant widths; expected one for each, 0 or more"),
        (("[7, 7]", "[7, 8]"), "curveVertexCounts are 15; expected as many as points, 14, for curves; the prim is"),
        (('"bezier"', '"hermite"'), 'curves are "hermite" and "nonperiodic"; expected linear, bezier, bspline'),
        (("diffuseColor = (1, 0, 0)", "emissiveColor = (1, 0, 0)"), "emission of curves is ignored"),
    ],
)
def test_what_curves_of_mitsuba_lack_is_told(stage, change, message):
    reader = shader("reader", "UsdPrimvarReader_float", 'string inputs:varname = "a"\nfloat outputs:result')
    roughness = "float inputs:roughness.connect = </paint/reader.outputs:result>"
    paint = material(f"color3f inputs:diffuseColor = (1, 0, 0)\n{roughness}", reader)
    text = hair(widths("constant", [0.4]), bound()) + paint + prim("Sphere", "ball") + camera()
    assert told(msub.usd_scene, stage(text), mi)[1] == []
    assert change[0] in text
    _, (warning,) = told(msub.usd_scene, stage(text.replace(*change), "changed.usda"), mi)
    assert message in warning
