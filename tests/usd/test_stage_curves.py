"""Curves of stages: their conversion beside de Casteljau's algorithm, and where rays hit them."""

from functools import reduce

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.studio import Look, StillPicture
from mitsuba_subdivision.studio.saving import save_scene
from mitsuba_usd import StageScenes
from mitsuba_usd.stage_curves import CurveTopology
from scipy.interpolate import BSpline
from usd.stages import bound, camera, material, moved, prim, shader, told, write

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")

# Distance of equal points in double precision; part of a radius within which rays hit or miss in single precision.
ROUNDING, EDGE = 1e-12, 0.01
PLACES = np.linspace(0, 1, 5)
# Points of each segment's Bezier form, of those around it.
TO_BEZIER = {
    "bezier": np.eye(4),
    "bspline": np.array([[1, 4, 1, 0], [0, 4, 2, 0], [0, 2, 4, 0], [0, 1, 4, 1]]) / 6,
    "catmullRom": np.array([[0, 6, 0, 0], [-1, 6, 1, 0], [0, 1, 6, -1], [0, 0, 6, 0]]) / 6,
}


def casteljau(points):
    t = PLACES[:, None, None]
    return reduce(lambda given, _: (1 - t) * given[:, :-1] + t * given[:, 1:], range(3), points[None])[:, 0]


@pytest.mark.parametrize("wrap", ["nonperiodic", "periodic", "pinned"])
@pytest.mark.parametrize("basis", TO_BEZIER)
def test_converted_curves_equal_de_casteljaus(basis, wrap):
    step, counts = (3, [6, 9] if wrap == "periodic" else [4, 10]) if basis == "bezier" else (1, [5, 7])
    given = [np.random.default_rng(count).random((count, 4)) for count in counts]
    topology = CurveTopology(np.array(counts), basis, wrap)
    made = topology.curve_set(*np.split(np.concatenate(given), [3], axis=1), "vertex")
    found, expected = [], []
    for controls in np.split(made.points, np.cumsum(made.counts)[:-1]):
        spline = BSpline(np.arange(len(controls) + 4), controls, 3)
        found += [spline(3 + number + PLACES) for number in range(len(controls) - 3)]
    for points in given:
        added = [*points[: 4 - step]] if wrap == "periodic" else []
        ends = [2 * points[0] - points[1]], [2 * points[-1] - points[-2]]
        before, after = ends if wrap == "pinned" and step == 1 else ([], added)
        values = np.array([*before, *points, *after])
        rows = range(0, len(values) - 3, step)
        expected += [casteljau(TO_BEZIER[basis] @ values[row : row + 4]) for row in rows]
    np.testing.assert_allclose(found, expected, atol=ROUNDING)


def hair(given, *lines, kind="cubic", basis="bezier"):
    """Two straight curves along x, one above the other, on which the parameter of a segment is linear."""
    kinds = f'uniform token type = "{kind}"\nuniform token basis = "{basis}"\nuniform token wrap = "nonperiodic"'
    points = f"point3f[] points = {[(x, y, 0) for y in (0, 2) for x in range(-3, 4)]}"
    counts = f"int[] curveVertexCounts = [7, 7]\nfloat[] widths = {given}"
    return prim("BasisCurves", "hair", kinds, counts, points, *lines, apis=["MaterialBindingAPI"])


def along(interpolation, values):
    return f'{values} (interpolation = "{interpolation}")'


def hits(scene, places):
    rays = (mi.Ray3f(mi.Point3f(*place, 9), mi.Vector3f(0, 0, -1)) for place in places)
    return [scene.ray_intersect(ray) for ray in rays]


WIDTHS = [
    ("llvm_ad_rgb", "linear", "bezier", "constant", [0.4]),
    ("scalar_rgb", "cubic", "bspline", "uniform", [0.4, 0.2]),
    ("scalar_rgb", "cubic", "catmullRom", "constant", [0.4]),
    ("scalar_rgb", "cubic", "bezier", "varying", [0.6, 0.3, 0.0, 0.4, 0.4, 0.4]),
    ("scalar_rgb", "linear", "bezier", "vertex", [*np.linspace(0.6, 0, 7).tolist(), *[0.4] * 7]),
]


@pytest.mark.parametrize(("variant", "kind", "basis", "interpolation", "values"), WIDTHS)
def test_straight_curves_cover_their_widths(request, tmp_path, variant, kind, basis, interpolation, values):
    """Also mirrored and twice as large, in a saved scene, as instances, and as copies of many in JIT variants."""
    request.getfixturevalue(f"variant_{variant}")
    text, large = hair(along(interpolation, values), kind=kind, basis=basis), moved(scale=(-2, 2, 2))
    path = write(tmp_path, prim("Xform", "placed", large, text) + camera())
    save_scene(StillPicture(StageScenes(path, Look(has_studio=False), {})).scene, tmp_path / "saved.xml")
    reference = "instanceable = true\nreferences = </group>"
    parts = [camera(), prim("Xform", "group", large, text)]
    parts += [prim("Xform", f"i{n}", moved(translate=(0, 0, -n)), head=reference) for n in range(70)]
    scenes = [mi.load_dict(msub.usd_scene(path, mi)), mi.load_file(str(tmp_path / "saved.xml"))]
    for count in (4, len(parts)):
        scenes.append(mi.load_dict(msub.usd_scene(write(tmp_path, "".join(parts[:count]), f"{count}.usda"), mi)))
    # Where x is -1.9 in the curve, and widths that vary have lost 0.1 for each unit.
    wide = [0.49 if interpolation in ("varying", "vertex") else values[0], values[-1]]
    for scene in scenes:
        for y, width in zip((0, 4), wide, strict=True):
            places = [(3.8, y + sign * width * (1 + EDGE * edge)) for edge in (-1, 1) for sign in (-1, 1)]
            assert [np.all(si.is_valid()) for si in hits(scene, places)] == [True, True, False, False]


@pytest.mark.parametrize("binding", ["", bound()])
@pytest.mark.parametrize(
    ("interpolation", "values", "expected"),
    [
        ("uniform", [0.25, 0.75], [0.25, 0.25, 0.75, 0.75]),
        # In the first and the last of the eight steps of the first segment, from -3 to 0.
        ("varying", [0.0, 0.8, 0.8, 1.0, 0.2, 0.2], [0.05, 0.75, 0.95, 0.25]),
        ("vertex", [*np.linspace(0, 1.2, 7).tolist(), *[0.4] * 7], [0.0375, 0.5625, 0.4, 0.4]),
    ],
)
def test_colours_along_curves(tmp_path, interpolation, values, expected, binding):
    """Without a material, and of one that reads them."""
    colours = f"color3f[] primvars:displayColor = {along(interpolation, [(value, 0, 0) for value in values])}"
    reader = 'string inputs:varname = "displayColor"\nfloat3 outputs:result'
    connected = "color3f inputs:diffuseColor.connect = </paint/reader.outputs:result>"
    paint = material(connected, shader("reader", "UsdPrimvarReader_float3", reader))
    path = write(tmp_path, hair(along("constant", [0.4]), colours, binding) + camera() + paint)
    scene = mi.load_dict(msub.usd_scene(path, mi))
    seen = hits(scene, [(x, y) for y in (0, 2) for x in (-3 + 3 / 16, -3 / 16)])
    np.testing.assert_allclose([si.bsdf().eval_diffuse_reflectance(si)[0] for si in seen], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("(0, 0, 0)", "(0, 5, 0)"), "cubic curves with corners have gaps there"),
        (("float[] widths", "float[] sizes"), "curves without widths are wires of a thousandth of their size"),
        (("[7, 7]", "[7, 3, 4]"), "curves with too few points are left out"),
        (("point3f[]", f"{moved(scale=(1, 1, 2))}point3f[]"), "curves stay round where transforms stretch them"),
        (
            ("float[] widths", "asset primvars:widths = @a@\nfloat[] widths"),
            "widths is of the type asset; expected numbers",
        ),
        (("[0.4]", "[0.4, 0.4, 0.4]"), "there are 3 constant widths; expected one for each, 0 or more"),
        (("diffuseColor = (1, 0, 0)", "emissiveColor = (1, 0, 0)"), "emission of curves is ignored"),
    ],
)
def test_unsupported_features_of_curves_warn(tmp_path, change, message):
    text = hair(along("constant", [0.4]), bound()) + material("color3f inputs:diffuseColor = (1, 0, 0)") + camera()
    text += prim("Sphere", "ball")
    _, (warning,) = told(msub.usd_scene, write(tmp_path, text.replace(*change)), mi)
    assert message in warning
