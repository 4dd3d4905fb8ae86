import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.cage.contents import Attribute
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.schemes import scheme_named
from patches.closed_cages import bipyramid, prism, torus
from peers.fidelity_cages import MODES, fan, grid, with_islands
from reference.refined_cages import channel_of, half_disc, tagged
from reference.refinement import refined

INFINITE = 10.0
# Rounding of values of size one, in float64.
ROUNDING = 2e-14


def repeated(cage, count):
    """Copies of a cage, each of which will have seams of its own."""
    corners = np.add.outer(cage.vertex_count * np.arange(count), cage.face_vertices)
    arrays = np.tile(cage.positions, (count, 1)), np.tile(cage.face_sizes, count), corners.ravel()
    return ControlCage.from_arrays(*arrays)


CAGES = {
    "cube": ("catmull_clark", cube()),
    "dome": ("catmull_clark", fan(5)),
    "polygons": ("catmull_clark", prism()),
    "fans": ("catmull_clark", repeated(half_disc(5), 8)),
    "loop ball": ("loop", bipyramid(5)),
    "loop fans": ("loop", repeated(half_disc(4), 8)),
}
EVERY_CAGE = pytest.mark.parametrize(("scheme", "cage"), CAGES.values(), ids=CAGES.keys())


def random_locations(surface, rng, count=150):
    t = surface.cage.topology
    element = rng.integers(0, t.face_count, count)
    corner = rng.integers(0, t.face_sizes[element])
    # In the part of the element that one refinement leaves at the corner.
    reach = 0.5 if surface.scheme.domain.corner_count == 4 else 0.25
    uv = rng.random((count, 2)) * reach * 2.0 ** -rng.integers(0, 20, (count, 1))
    uv[: count // 5] = 0
    return element, uv, corner


def random_tags(cage, rng, share, sharpness=(INFINITE,)):
    t = cage.topology
    corners = np.flatnonzero(rng.random(t.vertex_count) < share / 2)
    half_edges = t.edge_half_edge[rng.random(t.edge_count) < share]
    return {
        "creases": [(t.face_vertices[h], t.face_vertices[t.next[h]], rng.choice(sharpness)) for h in half_edges],
        "corners": [(v, rng.choice(sharpness)) for v in corners],
    }


def face_varying(values, indices):
    return Attribute(values, "face_varying", indices)


def random_indices(cage, rng, kind):
    """Face-varying indices with seams of many kinds."""
    t = cage.topology
    if kind == "islands":
        return t.face_vertices * 4 + rng.integers(0, 2, t.face_count)[t.face]
    if kind == "joined islands":
        # Some vertices have one value only: seams end there, or touch.
        island = rng.integers(0, 3, t.face_count)[t.face]
        return t.face_vertices * 4 + np.where((rng.random(t.vertex_count) < 0.5)[t.face_vertices], 0, island)
    # Single corners torn off, and rows shared by vertices that have nothing else in common.
    own = t.face_vertices * 2 + (rng.random(t.half_edge_count) < 0.15)
    return np.where(rng.random(t.half_edge_count) < 0.05, 0, own)


def as_cage(points, texcoords, options):
    """Cage of points and texture coordinates that the reference has refined."""
    positions = {vertex: point for (vertex, _), point in points.values.items()}
    row = {key: i for i, key in enumerate(texcoords.values)}
    keys = [key for face in zip(texcoords.faces, texcoords.indices, strict=True) for key in zip(*face, strict=True)]
    return ControlCage(
        [positions[vertex] for vertex in range(len(positions))],
        points.faces,
        creases=[(*edge, sharpness) for edge, sharpness in points.creases.items()],
        corners=[*points.corners.items()],
        texcoords=face_varying(list(texcoords.values.values()), [row[key] for key in keys]),
        **options,
    )


KINDS = ("islands", "joined islands", "torn corners")


def mixed(scheme, cage, mode):
    """A generator and numbers for what else varies, so that all pairs of it with cages and with modes come up."""
    name = next(name for name, known in CAGES.items() if known == (scheme, cage))
    number = list(CAGES).index(name) + MODES.index(mode)
    return np.random.default_rng(number), KINDS[number % 3], ("uniform", "chaikin")[number % 2]


def assert_refined_alike(cage, scheme, refinements, rng):
    """The surface and texture coordinates are those of the cage that the reference has refined once or twice."""
    surface, domain = LimitSurface(cage, scheme), scheme_named(scheme).domain
    points = channel_of(cage, cage.positions, cage.face_vertices)
    texcoords = channel_of(cage, cage.texcoords.values, cage.texcoords.indices, cage.face_varying)
    element, uv, corner = random_locations(surface, rng, 60)
    (points, child), (texcoords, _) = refined(points, scheme), refined(texcoords, scheme)
    place = [child[at] for at in zip(element, corner, strict=True)]
    fine = uv = 2 * uv
    if refinements == 2:
        (points, child), (texcoords, _) = refined(points, scheme), refined(texcoords, scheme)
        second = rng.integers(0, domain.corner_count, len(element))
        fine = rng.random((len(element), 2)) / (2 if domain.corner_count == 3 else 1)
        uv = np.stack([domain.rotation(k)(at / 2) for k, at in zip(second, fine, strict=True)])
        place = [child[at] for at in zip(place, second, strict=True)]
    # A whole element's corner is an element at twice the parameters; that of another polygon is at its own.
    halved = (cage.face_sizes[element] == domain.corner_count)[:, None]
    here, there = (element, np.where(halved, uv / 2, uv), corner), (place, fine)
    options = {rule: getattr(cage, rule) for rule in ("boundary", "face_varying", "crease_method")}
    finer = LimitSurface(as_cage(points, texcoords, options), scheme)
    size = np.abs(cage.positions).max()
    np.testing.assert_allclose(surface.evaluate(*here).p, finer.evaluate(*there).p, rtol=0, atol=ROUNDING * size)
    values, expected = surface.evaluate_attribute("texcoords", *here), finer.evaluate_attribute("texcoords", *there)
    np.testing.assert_allclose(values, expected, rtol=0, atol=ROUNDING)


# Two refinements decay all of them. Beside 0.2, Chaikin's method ends 1.2 at once, of which more than one was left.
# With half of the edges, some vertices are semi-sharp for less long than an edge on the other side of their seam.
SHARP, SEMI_SHARP = (1, 0.1, (INFINITE,)), (2, 0.5, (0.2, 1, 1.2, 1.7))
# Each lasts for a refinement more than what it becomes, down to those above.
LASTING = 1, 0.3, (9.9, 9, 8.3, 7.6, 6.5, 5.2, 4.8, 3.7, 2.4, 1.7)


@pytest.mark.parametrize(
    ("scheme", "cage", "mode", "refinements", "share", "sharpness"),
    [
        # Of both methods for creases, which alternate with cages and with modes.
        *(
            (*cage, mode, *(SEMI_SHARP if (c // 2 + m) % 2 and mode != "all" else SHARP))
            for c, cage in enumerate(CAGES.values())
            for m, mode in enumerate(MODES)
        ),
        *((*cage, mode, *LASTING) for cage in CAGES.values() for mode in MODES[:1]),
    ],
    ids=[*(f"{name}-{mode}" for name in CAGES for mode in MODES), *(f"{name}-lasting" for name in CAGES)],
)
def test_reference_refinements_have_the_same_points_and_values(scheme, cage, mode, refinements, share, sharpness):
    rng, kind, method = mixed(scheme, cage, mode)
    options = {"boundary": str(rng.choice(["edge_and_corner", "edge_only"])), "face_varying": mode}
    # As the reference states it; no triangles are left by a refinement.
    options["triangle_rule"] = "smooth" if scheme == "catmull_clark" and rng.random() < 0.5 else "catmull_clark"
    options |= random_tags(cage, rng, share, sharpness)
    indices = random_indices(cage, rng, kind)
    texcoords = face_varying(rng.random((indices.max() + 1, 2)), indices)
    assert_refined_alike(tagged(cage, texcoords=texcoords, crease_method=method, **options), scheme, refinements, rng)


def test_semi_sharp_edges_hold_values_across_creases_but_not_semi_sharp_vertices_across_seams(np_rng):
    """Copies of smooth vertices are held across seams, too, in the first mode: this one is sharp for less long."""
    at_vertex = with_islands(fan(6, creases=[(0, 2, 1.7)], corners=[(0, 0.5)]), [(0, 1), (0, 4)], "corners_plus1")
    crease, seam = ([(row + at, row + 5 + at) for row in range(0, 20, 5)] for at in (2, 1))
    beside = grid(4, 4, creases=[*((*edge, INFINITE) for edge in crease), (12, 13, 1.7)])
    for cage in (at_vertex, with_islands(beside, seam, "corners_only")):
        assert_refined_alike(cage, "catmull_clark", 2, np_rng)


@EVERY_CAGE
def test_without_seams_values_are_subdivided_as_points_are(scheme, cage, np_rng):
    tags = random_tags(cage, np_rng, 0.1, (0.5, 1.75, INFINITE))
    points, vertices = cage.positions, cage.face_vertices
    attributes = {
        "vertex": Attribute(points),
        "face_varying": face_varying(points, vertices),
        # Other numbers for the same points.
        "renamed": face_varying(points[::-1], cage.vertex_count - 1 - vertices),
    }
    for mode in MODES[:-1]:
        # On borders, modes may ask for corners that the surface has not.
        if mode != "boundaries" or not cage.topology.is_border_vertex.any():
            options = {"crease_method": "chaikin", "face_varying": mode, "attributes": attributes}
            surface = LimitSurface(tagged(cage, **tags, **options), scheme)
            places = random_locations(surface, np_rng, 20)
            expected = surface.evaluate(*places).p
            for name in attributes:
                np.testing.assert_array_equal(surface.evaluate_attribute(name, *places), expected)
                assert surface.channel(name).layout.patches is surface.patches


@pytest.mark.core
@EVERY_CAGE
def test_linear_values_are_bilinear_over_each_face(scheme, cage, np_rng):
    t, values = cage.topology, np_rng.random((cage.vertex_count, 2))
    texcoords, varying = face_varying(values, cage.face_vertices), Attribute(values, "varying")
    given = tagged(cage, face_varying="all", texcoords=texcoords, attributes={"varying": varying})
    surface = LimitSurface(given, scheme)
    element, uv, corner = random_locations(surface, np_rng)
    expected = []
    for face, i, (u, v) in zip(element, corner, uv, strict=True):
        ring = np.roll(values[cage.face_vertices[t.face_offsets[face] : t.face_offsets[face + 1]]], -i, axis=0)
        if scheme == "loop":
            expected.append((1 - u - v) * ring[0] + u * ring[1] + v * ring[2])
            continue
        if len(ring) == 4:
            a, b, c, d = ring
        else:
            a, b, c, d = ring[0], (ring[0] + ring[1]) / 2, ring.mean(axis=0), (ring[0] + ring[-1]) / 2
        expected.append((1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d)
    for name in ("texcoords", "varying"):
        values_here = surface.evaluate_attribute(name, element, uv, corner)
        np.testing.assert_allclose(values_here, expected, rtol=0, atol=ROUNDING)


def test_a_constant_stays_one(np_rng):
    cage = CAGES["polygons"][1]
    indices = random_indices(cage, np_rng, "islands")
    constant = face_varying(np.full((indices.max() + 1, 1), 0.1), indices)
    surface = LimitSurface(tagged(cage, attributes={"one": constant}))
    assert (surface.evaluate_attribute("one", *random_locations(surface, np_rng)) == 0.1).all()


def test_doo_sabin_interpolates_attributes_without_seams(np_rng):
    cage = torus(5, 4)
    texcoords, attributes = face_varying(cage.positions[:, :2], cage.face_vertices), {"vertex": cage.positions}
    surface = LimitSurface(tagged(cage, texcoords=texcoords, attributes=attributes), "doo_sabin")
    places = np_rng.integers(0, cage.vertex_count, 40), np_rng.random((40, 2))
    expected = surface.evaluate(*places).p
    np.testing.assert_array_equal(surface.evaluate_attribute("vertex", *places), expected)
    np.testing.assert_array_equal(surface.evaluate_attribute("texcoords", *places), expected[:, :2])
    assert surface.tessellate(3).texcoords.shape == (len(surface.tessellate(3).positions), 2)


@pytest.mark.parametrize(
    ("attribute", "mode", "message"),
    [
        (Attribute(np.zeros((24, 1)), "face_varying"), "corners_plus1", 'no rules for seams, as of the attribute "a"'),
        (Attribute(np.zeros((8, 1)), "varying"), "corners_plus1", "no rules for linear interpolation"),
        (face_varying(np.zeros((8, 1)), cube().face_vertices), "all", "no rules for linear interpolation"),
    ],
)
def test_doo_sabin_refuses_seams_and_linear_attributes(attribute, mode, message):
    surface = LimitSurface(tagged(cube(), attributes={"a": attribute}, face_varying=mode), "doo_sabin")
    with pytest.raises(SchemeError, match=message):
        surface.evaluate_attribute("a", 0, [[0, 0]])
    with pytest.raises(SchemeError, match=message):
        surface.tessellate(2)


@pytest.mark.parametrize(("attributes", "expected"), [({}, "a cage with attribut"), ({"a": np.zeros((8, 1))}, "of a")])
def test_unknown_attributes_name_the_known_ones(attributes, expected):
    surface = LimitSurface(tagged(cube(), attributes=attributes))
    with pytest.raises(ValueError, match=f'control cage has no attribute "texcoords"; .*{expected}'):
        surface.evaluate_attribute("texcoords", 0, [[0, 0]])
