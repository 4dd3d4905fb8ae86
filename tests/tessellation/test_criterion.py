import re
import warnings

import numpy as np
import pytest
from kernels.surfaces import surface_named
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage.errors import without_warnings
from mitsuba_subdivision.cage.named_cages import extraordinary
from mitsuba_subdivision.evaluation.polynomials import BernsteinBasis
from mitsuba_subdivision.schemes.domain import SQUARE
from mitsuba_subdivision.tessellation.criterion import BESIDE_OUTLINE, Cone, Criterion, Sensor, least_product
from patches.closed_cages import bumpy, torus
from reference.refined_cages import sheet
from scipy.spatial import ConvexHull
from tessellation.distances import distances, distances_to
from tessellation.test_adaptive_grid import TWO_TRIANGLES, directed_edges, size_of, table_of

# Distances are square roots of sums with rounding errors of this part of the surface's size.
ROUNDING = 1e-7
# Places on triangles that are looked at: nine points, with the middles of sides.
WEIGHTS = np.array([(i, j, 4 - i - j) for i in range(5) for j in range(5 - i) if max(i, j, 4 - i - j) < 4]) / 4
OF_EACH_KIND = pytest.mark.parametrize("name", ["cube", "loop mixed torus", "doo_sabin mixed torus", "half disc of 6"])
# An even torus from aside.
TORUS, SENSOR = LimitSurface(torus(8, 6)), Sensor(np.array([0.0, -8, 5]), 2e-3)
BICUBIC = BernsteinBasis(SQUARE, 3)


def distance(surface, table, most=1000):
    corners = table.apply(surface.cage.positions)[0][np.random.default_rng(1).permutation(table.triangles)[:most]]
    return surface.closest_point((WEIGHTS @ corners).reshape(-1, 3)).distance.max()


# Surfaces with few elements, as every point is compared with all of them.
CHECKED = ["torus", "smooth triangles", "half disc of 6", "non-manifold", "corner", "propeller", "into a dart", "holes"]
CHECKED += ["valence 2", "loop mixed torus", "loop sheet", "loop corner", "doo_sabin mixed torus", "doo_sabin sheet"]


@pytest.mark.parametrize("name", CHECKED)
def test_triangles_and_surface_are_within_the_limit_of_each_other(name):
    surface, error = surface_named(name), 2e-3
    apart = distances(surface, table_of(surface, error, max_rate=256), 1000, 64)
    assert max(apart) <= (error + ROUNDING) * size_of(surface)


@pytest.mark.parametrize("name", CHECKED)
def test_no_edge_exceeds_the_limit(name):
    surface = surface_named(name)
    table = table_of(surface, 0.05, 256, "edge")
    start, end = table.apply(surface.cage.positions)[0][directed_edges(table.triangles)].swapaxes(0, 1)
    assert np.linalg.norm(end - start, axis=1).max() <= 0.05 * size_of(surface)


@OF_EACH_KIND
def test_rates_stay_below_the_highest(name):
    """No more segments lie on any edge of the cage than allowed, however small the error."""
    table = table_of(surface_named(name), 1e-9, max_rate=6)
    tiles, rates = table.grid.tiles, table.grid.tiles["rates"].max(axis=1)
    # Around extraordinary vertices rings get smaller, but have no more segments.
    assert rates[tiles["depth"] == 0].max(initial=0) <= 6
    assert rates[tiles["depth"] > 0].max(initial=0) <= 3
    assert (rates <= np.maximum(1, 6 >> tiles["halvings"].astype(int))).all()
    if name == "loop mixed torus":
        assert tiles["depth"].max() > 15


@pytest.mark.parametrize(
    ("name", "measure"),
    [
        ("cube", "edge"),
        ("loop mixed torus", "chord"),
        ("doo_sabin mixed torus", "edge"),
        ("half disc of 6", "chord"),
    ],
)
def test_a_warning_names_the_highest_rate_that_the_limit_needs(name, measure):
    """Or one nearer to it: how many segments patches need that are not divided is not known."""
    surface, rates = surface_named(name), [2]
    criterion = Criterion(measure, {"chord": 1e-3, "edge": 0.05}[measure] * size_of(surface))
    while True:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            table = surface.adaptive_sampling(criterion, rates[-1])
        if not caught:
            break
        (warning,) = caught
        numbers = re.search(r"at (\d+) of (\d+) .* max_rate of (\d+)", str(warning.message)).groups()
        count, total, rate = map(int, numbers)
        assert 0 < count <= total == np.count_nonzero(surface.patches.elements.face_sizes)
        assert rate > rates[-1]
        rates.append(rate)
    assert 2 <= len(rates) <= 4
    np.testing.assert_array_equal(table.triangles, surface.adaptive_sampling(criterion, 1024).triangles)


def test_least_product_is_the_least(np_rng):
    """Of all integers up to 60, tried one by one."""
    forms = 10 ** np_rng.uniform(-2, 1.5, (3, 3, 400))
    products = least_product(forms)
    n, m = (index.ravel() for index in np.indices((60, 60)) + 1)
    a, b, c = forms[:, :, :, None].swapaxes(0, 1)
    holds = ((a / n**2 + 2 * b / (n * m) + c / m**2) <= 1).all(axis=0)
    assert holds[np.arange(len(products)), (products[:, 0] - 1) * 60 + products[:, 1] - 1].all()
    # Those next to the best real numbers are tried: a product that is a little less may be further away.
    own, least = products.prod(axis=1), np.where(holds, n * m, np.inf).min(axis=1)
    assert np.mean(own / least) < 1.01
    assert (own <= 1.25 * least + 1).all()


def pillow(thickness):
    """Two sheets, one on the other, that are joined along their borders."""
    flat, below = sheet(3, 3), np.arange(16)
    is_inside = (flat.positions[:, :2] % 3 != 0).all(axis=1)
    below[is_inside] = 16 + np.arange(4)
    points, faces = flat.positions + np.outer(is_inside, [0, 0, thickness]), flat.face_vertices.reshape(-1, 4)
    points = np.concatenate([points, points[is_inside] * [1, 1, -1]])
    return LimitSurface(ControlCage(points, np.concatenate([faces, below[faces][:, ::-1]])))


# By Catmull and Clark's rules the two triangles are folded inside, too.
TRIANGLES = [LimitSurface(TWO_TRIANGLES, scheme) for scheme in ("loop", "catmull_clark")]
FLAT = LimitSurface(sheet(3, 3, boundary="edge_only"))
FOLDED = [FLAT, pillow(0), pillow(1e-3), *TRIANGLES]


@pytest.mark.parametrize(("surface", "error"), [*((surface, 1e-3) for surface in FOLDED), (FLAT, 1e-2)])
def test_flat_surfaces_end_at_their_border(surface, error):
    """Along open borders and folds: triangles do not stick out, and do not fall short."""
    table, most = table_of(surface, error, max_rate=256), (error + ROUNDING) * size_of(surface)
    # Of two sheets that are one, both are as near: searches take ten times as long.
    assert distance(surface, table, 30) <= most
    # Points of the surface near its borders, and the triangles' edges, which are triangles without area.
    dense = surface.tessellate(24).positions
    outline = dense[ConvexHull(dense[:, [0, 2] if np.ptp(dense[:, 1]) == 0 else [0, 1]]).vertices]
    edges = np.unique(np.sort(directed_edges(table.triangles)), axis=0)
    assert distances_to(table.apply(surface.cage.positions)[0][edges[:, [0, 1, 1]]], outline).max() <= most


def test_an_isolated_point_of_high_rate_stays_isolated():
    """One vertex of a large flat sheet is pulled out: triangles are where it is."""
    flat = sheet(12, 12)
    pulled = (flat.positions[:, :2] == 6).all(axis=1)
    surface = LimitSurface(flat.with_positions(flat.positions + np.outer(pulled, [0, 0, 3])))
    table = surface.adaptive_sampling(Criterion("chord", 1e-3), 64)
    counts = np.bincount(table.element, minlength=144).reshape(12, 12)
    assert counts[4:8, 4:8].min() > 20
    # Faces beside these have more vertices on one side, all others are two triangles.
    counts[3:9, 3:9] = 2
    assert (counts == 2).all()


def test_an_even_torus_has_no_more_triangles_than_the_uniform_grid():
    uniform = TORUS.sampling(16)
    largest = distance(TORUS, uniform)
    table = TORUS.adaptive_sampling(Criterion("chord", largest), 64)
    assert len(table.triangles) <= 1.05 * len(uniform.triangles)
    assert distance(TORUS, table) <= largest


@pytest.mark.parametrize("valence", [3, 12])
def test_rings_follow_a_close_look_at_an_extraordinary_vertex(valence):
    """Seen from near, triangles around the vertex have about the same size in pixels, not in parameters."""
    surface = LimitSurface(bumpy(extraordinary(valence)))
    vertices, depths = surface.cage.face_vertices, []
    element, corner = divmod(int(np.argmax(vertices == np.argmax(np.bincount(vertices) == valence))), 4)
    point = surface.evaluate([element], [[0.0, 0.0]], corner)
    for away in (1e-1, 1e-4):
        eye = point.p[0] + away * point.n[0]
        table = surface.adaptive_sampling(Criterion("edge", 100.0, Sensor(eye, 1e-3)), 128)
        positions, _ = table.apply(surface.cage.positions)
        near = np.linalg.norm(positions - point.p[0], axis=1) < away
        corners = positions[table.triangles[near[table.triangles].all(axis=1)]]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        depths.append(table.grid.tiles["depth"].max())
        assert len(sides) > 100
        # A tenth of the distance, seen from twice as far at most.
        assert sides.max() <= 0.2 * away
        assert np.quantile(sides, 0.1) > 0.3 * np.median(sides)
    assert depths[1] >= depths[0] + 7


def derivatives_of(patches):
    """By u and v, and second ones, of bicubic patches ``(16, 3, t)``."""
    return list(np.einsum("dab,bxt->daxt", BICUBIC.two_derivatives, patches))


@pytest.mark.parametrize("scale", [1e-3, 1e-19, 1e-21, 1e-30, 1e-40, 0])
def test_for_nearly_zero_tangents_the_bound_is_the_whole_difference(scale):
    """At a curve in place of a surface, however much of the other tangent rounding leaves; in single precision."""
    u, _ = (BICUBIC.indices / 3).T
    points = np.stack([u, 0 * u, u**3], axis=1)[..., None].astype(np.float32)
    derivatives = [derivative.astype(np.float32) for derivative in derivatives_of(points)]
    derivatives[1][:] = np.float32(scale) * np.array([0, 0, 1])[:, None]
    form = Criterion("chord", 1.0).form(points, derivatives, 4)
    whole = np.sqrt(np.square(derivatives[2]).sum(axis=1).max(axis=0))
    assert (form[0] <= np.float32(1 + 1e-6) * whole / 8).all()
    assert (form[0] > 0).all()


@pytest.mark.parametrize("direction", [None, np.array([0.6, 0.0, -0.8])], ids=["perspective", "orthographic"])
def test_an_outline_in_view_is_noticed(direction, np_rng):
    """Where one point and normal of a part face the sensor and others face away; and hardly where none nearly do."""
    count, samples = 400, 60
    centre, half = np_rng.normal(size=(3, count)), np_rng.random((3, count))
    # Half of the parts are flat, and their points count alone.
    axis, angle = np_rng.normal(size=(3, count)), 0.5 * np_rng.random(count) * (np_rng.random(count) < 0.5)
    axis /= np.linalg.norm(axis, axis=0)
    eye = np.array([0.0, -4, 1])
    cone = Cone(axis, np.sin(angle))
    may_see = Sensor(eye, 1e-3, direction).may_see_outline(centre - half, centre + half, cone)
    places = np_rng.uniform(-1, 1, (samples, 3, count))
    places[::2] = np.sign(places[::2])
    points = centre + half * places
    across = np.cross(np_rng.normal(size=(samples, 3, count)), axis[None], axis=1)
    normals = np.cos(angle) * axis + np.sin(angle) * across / np.linalg.norm(across, axis=1, keepdims=True)
    view = points - eye[:, None] if direction is None else np.broadcast_to(direction[:, None], points.shape)
    tilt = np.einsum("sit,uit->sut", normals, view).reshape(-1, count)
    assert may_see[(tilt.min(axis=0) < 0) & (tilt.max(axis=0) > 0)].all()
    view_length = 1 if direction is not None else np.linalg.norm(view, axis=1).max(axis=0)
    margin = np.sin(BESIDE_OUTLINE) * view_length
    is_near = (tilt.min(axis=0) < margin) & (tilt.max(axis=0) > -margin)
    assert np.count_nonzero(may_see) < 1.2 * np.count_nonzero(is_near)


def test_pixels_are_as_small_as_at_the_nearest_point_of_a_box(np_rng):
    centre, half = np_rng.normal(size=(3, 100)), np_rng.random((3, 100))
    eye = np.array([0.5, -1, 1])
    nearest = np.clip(eye[:, None], centre - half, centre + half)
    expected = 1e-3 * np.linalg.norm(nearest - eye[:, None], axis=0)
    np.testing.assert_allclose(Sensor(eye, 1e-3).pixel_size(centre - half, centre + half), expected, rtol=1e-12)


def test_outline_criteria_refine_outlines_only():
    # As fine as the highest rate allows, without a warning: pictures by default settings ask for outlines of a tenth of
    # a pixel, and for few triangles first.
    TORUS.adaptive_sampling(Criterion("chord", 1e-3, SENSOR, SENSOR), 2)
    criteria = (Criterion("chord", 0.1, SENSOR, outline) for outline in (None, SENSOR))
    fine, at_outline = (TORUS.adaptive_sampling(criterion, 64) for criterion in criteria)
    assert len(at_outline.triangles) < len(fine.triangles) / 2
    points, normals = fine.apply(TORUS.cage.positions)
    sides = np.sign(np.einsum("ij,ij->i", normals, points - SENSOR.eye))[fine.triangles]
    # Elements with an outline are no coarser than where all are fine.
    elements = np.unique(fine.element[np.ptp(sides, axis=1) > 0])
    coarse, dense = (np.bincount(table.element, minlength=TORUS.cage.face_count) for table in (at_outline, fine))
    assert 0 < len(elements) < TORUS.cage.face_count
    assert (coarse[elements] > 0.2 * dense[elements]).all()


@pytest.mark.parametrize("name", ["mixed torus", "loop mixed torus", "doo_sabin mixed torus"])
def test_rates_follow_a_displacement(name):
    """Seen along the normals, triangles of the displaced surface are as near to it as asked."""
    surface, error = surface_named(name), 3e-3
    size = size_of(surface)

    def displaced(start, uv):
        samples = surface._sampler.evaluate(start.astype(np.int64), uv)
        x, _, z = samples.p.T / size
        height = 0.01 * size * np.sin(20 * x) * np.cos(15 * z)
        return samples.p + height[:, None] * samples.n, samples.n, height

    table = table_of(surface, error, 64, heights=lambda start, uv: displaced(start, uv)[2], highest=0.01 * size)
    assert len(table.triangles) > 1.2 * len(table_of(surface, error, 64).triangles)
    corner, uv = table.grid.triangle_locations
    corners = np.stack([displaced(corner, uv[:, i])[0] for i in range(3)], axis=1)
    for weights in WEIGHTS:
        point, normal, _ = displaced(corner, weights @ uv)
        away = np.abs(np.einsum("ij,ij->i", weights @ corners - point, normal))
        # At the same parameters: where the displacement is steep, what points are off along the surface counts as well.
        assert away.max() <= 1.5 * error * size


def corners_on_sheet(scheme, heights, **criterion):
    """Corners ``(t, 3, 3)`` of triangles of a flat sheet that is displaced by a function of x and y."""
    cage = sheet(2, 2)
    surface = LimitSurface(cage if scheme == "catmull_clark" else ControlCage(cage.positions, cage.triangles), scheme)

    def places(start, uv):
        return surface._sampler.evaluate(start.astype(np.int64), uv).p[:, :2]

    criterion |= {"heights": lambda start, uv: heights(places(start, uv)), "highest": 16.0}
    start, uv = surface.adaptive_sampling(Criterion(**criterion), 64).grid.triangle_locations
    xy = np.stack([places(start, uv[:, i]) for i in range(3)], axis=1)
    return np.concatenate([xy, heights(xy)[..., None]], axis=2)


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
@pytest.mark.parametrize("bend", [(2, 0, 0), (0, 2, 0), (0, 0, 2), (1, -2, 1)], ids=str)
def test_a_flat_sheet_is_divided_where_its_heights_bend(bend, scheme):
    """Quadratic heights: their second derivatives by x, by both and by y are those of all tiles."""

    def heights(xy):
        return np.stack([xy[..., 0] ** 2 / 2, xy[..., 0] * xy[..., 1], xy[..., 1] ** 2 / 2], axis=-1) @ bend

    corners = corners_on_sheet(scheme, heights, measure="chord", error=0.02)
    points = WEIGHTS @ corners
    away = np.abs(heights(points[..., :2]) - points[..., 2]).max()
    assert 0.002 < away <= 0.02
    assert len(corners) < 1200


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
@pytest.mark.parametrize("slope", [(3, 0), (0, 3), (2, 2)], ids=str)
def test_edges_on_a_flat_sheet_are_short_where_its_heights_rise(slope, scheme):
    corners = corners_on_sheet(scheme, lambda xy: xy @ slope, measure="edge", error=0.25)
    length = np.linalg.norm(np.diff(corners[:, [0, 1, 2, 0]], axis=1), axis=2).max()
    assert 0.12 < length <= 0.25 + ROUNDING


def triangles_with_heights(surface, error, extent, heights):
    """How many there are. No rate reproduces steep sides."""
    displacement = {"heights": lambda _, uv: heights(uv), "highest": extent}
    with without_warnings():
        return len(surface.adaptive_sampling(Criterion("chord", error, **displacement), 64).triangles)


def test_narrow_bumps_inside_faces_are_noticed():
    """The criterion samples heights, also there: a face that is flat elsewhere is divided."""
    plane = ControlCage([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2, 3]], boundary="edge_and_corner")
    surface, bump = LimitSurface(plane), lambda uv: (np.abs(uv - 0.5).max(axis=1) < 1e-3) * 1.0
    flat = triangles_with_heights(surface, 0.05, 1.0, lambda uv: 0 * uv[:, 0])
    assert triangles_with_heights(surface, 0.05, 1.0, bump) > 2 * flat


def test_displacement_tightens_the_limit_of_borders():
    """On a flat sheet with a curved border, heights that take most of the limit leave the border a tenth."""
    flat = triangles_with_heights(FLAT, 1e-2, 1e-2, lambda uv: 0 * uv[:, 0])
    assert triangles_with_heights(FLAT, 1e-2, 1e-2, lambda uv: 0.9e-2 * (uv[:, 0] > 0.5)) > flat
