"""Texture coordinates and attributes at any place: laws, and refinement by an independent reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.cage.attributes import Attribute
from mitsuba_subdivision.cage.named_cages import cube, extraordinary, extraordinary_triangles, torus
from reference.exact_samples import faces_of
from reference.face_varying import Channel, refined
from reference.refined_cages import half_disc, sheet, tagged

SCENES = Path(__file__).parents[2] / "scenes"
INFINITE = 10.0
MODES = ("none", "corners_only", "corners_plus1", "corners_plus2", "boundaries", "all")
EVERY_MODE = pytest.mark.parametrize("mode", MODES)
# Of values of size one, in float64.
ROUNDING = 2e-14


CAGES = {
    "cube": ("catmull_clark", cube()),
    "valence 3": ("catmull_clark", extraordinary(3, closed=False)),
    "dome": ("catmull_clark", extraordinary(5, closed=False)),
    "sheet": ("catmull_clark", sheet(4, 3)),
    "polygons": ("catmull_clark", ControlCage.from_file(SCENES / "cages/propeller.obj")),
    "fan": ("catmull_clark", half_disc(5)),
    "loop ball": ("loop", extraordinary_triangles(5, rows=2)),
    "loop sheet": ("loop", sheet(3, 3, triangles=True)),
    "loop fan": ("loop", half_disc(4)),
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
    """Sharp edges and vertices."""
    t = cage.topology
    sharp = t.edge_half_edge[rng.random(t.edge_count) < share]
    return {
        "creases": [(t.face_vertices[h], t.face_vertices[t.next[h]], rng.choice(sharpness)) for h in sharp],
        "corners": [(v, rng.choice(sharpness)) for v in np.flatnonzero(rng.random(t.vertex_count) < share / 2)],
    }


def random_indices(cage, rng, kind):
    """Face-varying indices with seams of many kinds."""
    t = cage.topology
    if kind == "islands":
        return t.face_vertices * 4 + rng.integers(0, 3, t.face_count)[t.face]
    if kind == "joined islands":
        # Some vertices have one value only: seams end there, or touch.
        island = rng.integers(0, 3, t.face_count)[t.face]
        return t.face_vertices * 4 + np.where((rng.random(t.vertex_count) < 0.5)[t.face_vertices], 0, island)
    # Single corners torn off, and rows shared by vertices that have nothing else in common.
    own = t.face_vertices * 2 + (rng.random(t.half_edge_count) < 0.15)
    return np.where(rng.random(t.half_edge_count) < 0.05, 0, own)


def textured(cage, indices, rng, **options):
    return tagged(cage, texcoords=Attribute(rng.random((indices.max() + 1, 2)), "face_varying", indices), **options)


# Independent refinement


def as_channel(cage):
    """What the reference makes of a cage with texture coordinates."""
    faces = [tuple(map(int, face)) for face in faces_of(cage)]
    rows = np.split(cage.texcoords.indices, cage.topology.face_offsets[1:-1])
    return Channel(
        faces,
        [tuple(map(int, row)) for row in rows],
        {
            (v, i): cage.texcoords.values[i]
            for face, row in zip(faces, rows, strict=True)
            for v, i in zip(face, row, strict=True)
        },
        {frozenset((int(a), int(b))): float(s) for a, b, s in cage.tags.creases(cage.topology)},
        {int(vertex): float(s) for vertex, s in cage.tags.corners()},
        cage.boundary == "edge_and_corner",
        cage.face_varying,
        cage.crease_method,
    )


def as_cage(channel):
    """Cage, of no particular shape, with the texture coordinates of a channel."""
    number = {vertex: i for i, vertex in enumerate({vertex: None for face in channel.faces for vertex in face})}
    row = {key: i for i, key in enumerate(channel.values)}
    faces = [[number[vertex] for vertex in face] for face in channel.faces]
    indices = [row[key] for f, face in enumerate(channel.faces) for key in zip(face, channel.indices[f], strict=True)]
    return ControlCage(
        np.random.default_rng(0).random((len(number), 3)),
        faces,
        creases=[(*(number[vertex] for vertex in edge), s) for edge, s in channel.creases.items()],
        corners=[(number[vertex], s) for vertex, s in channel.corners.items()],
        boundary="edge_and_corner" if channel.sharp_boundary_corners else "edge_only",
        face_varying=channel.mode,
        texcoords=Attribute(list(channel.values.values()), "face_varying", indices),
    )


KINDS = ("islands", "joined islands", "torn corners")


def mixed(scheme, cage, mode):
    """A generator and numbers for what else varies, so that all pairs of it with cages and with modes come up."""
    name = next(name for name, known in CAGES.items() if known == (scheme, cage))
    number = list(CAGES).index(name) + MODES.index(mode)
    return np.random.default_rng(number), KINDS[number % 3], ("uniform", "chaikin")[number % 2]


@EVERY_CAGE
@EVERY_MODE
def test_one_refinement_by_the_reference_has_the_same_values(scheme, cage, mode):
    rng, kind, _ = mixed(scheme, cage, mode)
    boundary = ("edge_and_corner", "edge_only")[int(rng.integers(2))]
    options = {**random_tags(cage, rng, 0.1), "boundary": boundary, "face_varying": mode}
    coarse = textured(cage, random_indices(cage, rng, kind), rng, **options)
    surface = LimitSurface(coarse, scheme)
    channel, child = refined(as_channel(coarse), scheme)
    finer = LimitSurface(as_cage(channel), scheme)
    element, uv, corner = random_locations(surface, rng)
    here = surface.evaluate_attribute("texcoords", element, uv, corner)
    # A whole element's corner is an element at twice the parameters; that of another polygon is at its own.
    halved = (cage.face_sizes[element] == surface.scheme.domain.corner_count)[:, None]
    there = finer.evaluate_attribute(
        "texcoords", [child[place] for place in zip(element, corner, strict=True)], np.where(halved, 2 * uv, uv)
    )
    np.testing.assert_allclose(here, there, rtol=0, atol=ROUNDING)


# Two refinements decay all of them. Beside 0.2, Chaikin's method ends 1.2 at once, of which more than one was left.
DECAYING = (0.2, 1, 1.2, 1.7)


@EVERY_CAGE
@pytest.mark.parametrize("mode", MODES[:-1])
def test_semi_sharp_features_decay_at_seams_as_in_the_reference(scheme, cage, mode):
    rng, kind, method = mixed(scheme, cage, mode)
    options = {
        **random_tags(cage, rng, 0.4, DECAYING),
        "crease_method": method,
        "boundary": str(rng.choice(["edge_and_corner", "edge_only"])),
        "face_varying": mode,
    }
    coarse = textured(cage, random_indices(cage, rng, kind), rng, **options)
    once, child = refined(as_channel(coarse), scheme)
    twice, grandchild = refined(once, scheme)
    # Tags on a border are sharp with it.
    assert {0, INFINITE}.issuperset([*twice.creases.values(), *twice.corners.values()])
    finer, surface = LimitSurface(as_cage(twice), scheme), LimitSurface(coarse, scheme)

    domain = surface.scheme.domain
    element, _, corner = random_locations(surface, rng)
    second = rng.integers(0, domain.corner_count, len(element))
    uv = rng.random((len(element), 2)) / (2 if domain.corner_count == 3 else 1)
    inner = np.stack([domain.rotation(k)(place / 2) for k, place in zip(second, uv, strict=True)])
    halved = (cage.face_sizes[element] == domain.corner_count)[:, None]
    here = surface.evaluate_attribute("texcoords", element, np.where(halved, inner / 2, inner), corner)
    places = zip(element, corner, second, strict=True)
    there = finer.evaluate_attribute("texcoords", [grandchild[child[f, i], k] for f, i, k in places], uv)
    np.testing.assert_allclose(here, there, rtol=0, atol=ROUNDING)


# Laws


@EVERY_CAGE
@pytest.mark.parametrize("mode", MODES[:-1])
def test_without_seams_values_are_subdivided_as_points_are(scheme, cage, mode, np_rng):
    tags = random_tags(cage, np_rng, 0.1, (0.5, 1.75, INFINITE))
    # On borders, modes may ask for corners that the surface has not.
    mode = "none" if cage.topology.is_border_vertex.any() and mode == "boundaries" else mode
    points = cage.positions
    surface = LimitSurface(
        tagged(
            cage,
            **tags,
            crease_method="chaikin",
            face_varying=mode,
            attributes={
                "vertex": Attribute(points),
                "face_varying": Attribute(points, "face_varying", cage.face_vertices),
                # Other numbers for the same points.
                "renamed": Attribute(points[::-1], "face_varying", cage.vertex_count - 1 - cage.face_vertices),
            },
        ),
        scheme,
    )
    places = random_locations(surface, np_rng)
    expected = surface.evaluate(*places).p
    for name in ("vertex", "face_varying", "renamed"):
        np.testing.assert_array_equal(surface.evaluate_attribute(name, *places), expected)
        assert surface.channel(name).patches is surface.patches


@pytest.mark.parametrize("triangles", [False, True])
@pytest.mark.parametrize("mode", MODES[1:])
def test_flat_islands_keep_their_coordinates(triangles, mode, np_rng):
    cage = sheet(4, 4, triangles=triangles)
    t = cage.topology
    # Two islands side by side, the second one turned and moved. Where two triangles make a corner, tags make it sharp.
    middle = np.bincount(t.face, cage.positions[cage.face_vertices, 0]) / t.face_sizes
    island = (middle > 2)[t.face]
    corners = [(vertex, INFINITE) for vertex in (0, 2, 4, 20, 22, 24)] if triangles else []
    flat = cage.positions[:, :2]
    values = np.concatenate([flat, flat @ [[0, 2], [-2, 0]] + [5, 7]])
    surface = LimitSurface(
        tagged(
            cage,
            corners=corners,
            face_varying=mode,
            texcoords=Attribute(values, "face_varying", cage.face_vertices + island * cage.vertex_count),
        ),
        "loop" if triangles else "catmull_clark",
    )
    element, uv, corner = random_locations(surface, np_rng)
    found = surface.evaluate_attribute("texcoords", element, uv, corner)
    at = flat_place(cage, element, uv, corner)
    second = island[t.face_offsets[element]][:, None]
    expected = np.where(second, at @ [[0, 2], [-2, 0]] + [5, 7], at)
    np.testing.assert_allclose(found, expected, rtol=0, atol=20 * ROUNDING)


@pytest.mark.parametrize("method", ["uniform", "chaikin"])
@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
def test_an_island_is_the_surface_of_its_own_faces(scheme, method, np_rng):
    cage = extraordinary(5) if scheme == "catmull_clark" else extraordinary_triangles(5)
    t = cage.topology
    is_low = np.bincount(t.face, cage.positions[cage.face_vertices, 2]) / t.face_sizes < 0.5
    inside = is_low[t.face]
    # Semi-sharp edges of one side, up to the seam; on the other side nothing is sharp.
    half_edges = t.edge_half_edge[(np_rng.random(t.edge_count) < 0.3) & (inside & inside[t.twin])[t.edge_half_edge]]
    creases = [(t.face_vertices[h], t.face_vertices[t.next[h]], np_rng.choice([0.5, 1, 1.75])) for h in half_edges]
    surface = LimitSurface(
        tagged(
            cage,
            creases=creases,
            crease_method=method,
            face_varying="corners_only",
            attributes={
                "p": Attribute(
                    np.tile(cage.positions, (2, 1)), "face_varying", cage.face_vertices + inside * cage.vertex_count
                )
            },
        ),
        scheme,
    )
    faces = np.flatnonzero(is_low)
    kept, vertices = np.unique(cage.face_vertices[inside], return_inverse=True)
    number = dict(zip(kept.tolist(), range(len(kept)), strict=True))
    alone = LimitSurface(
        ControlCage.from_arrays(
            cage.positions[kept],
            cage.face_sizes[faces],
            vertices.ravel(),
            creases=[(number[a], number[b], sharpness) for a, b, sharpness in creases],
            crease_method=method,
        ),
        scheme,
    )
    element, uv, corner = random_locations(alone, np_rng)
    found = surface.evaluate_attribute("p", faces[element], uv, corner)
    np.testing.assert_allclose(found, alone.evaluate(element, uv, corner).p, rtol=0, atol=2 * ROUNDING)


@EVERY_MODE
@pytest.mark.parametrize("method", ["uniform", "chaikin"])
def test_sharpness_of_seams_does_not_act(mode, method, np_rng):
    cage = extraordinary(5, closed=False)
    t = cage.topology
    indices = random_indices(cage, np_rng, "islands")
    values = Attribute(np_rng.random((indices.max() + 1, 2)), "face_varying", indices)
    plain = LimitSurface(tagged(cage, texcoords=values, face_varying=mode))
    on_seams = np.flatnonzero(plain.channel("texcoords").seam & (t.twin > np.arange(t.half_edge_count)))
    creases = [(t.face_vertices[h], t.face_vertices[t.next[h]], np_rng.choice([0.5, 1.75])) for h in on_seams]
    sharp = LimitSurface(tagged(cage, texcoords=values, face_varying=mode, creases=creases, crease_method=method))
    places = random_locations(plain, np_rng)
    expected = plain.evaluate_attribute("texcoords", *places)
    np.testing.assert_allclose(sharp.evaluate_attribute("texcoords", *places), expected, rtol=0, atol=ROUNDING)
    assert np.abs(sharp.evaluate(*places).p - plain.evaluate(*places).p).max() > 1e-3


def two_rings(rng):
    """A torus of two rings with a seam between them, and creases on the first: semi-sharp ones and the seam's own.

    Its values at face corners are its points, so that each ring of values could be a surface.
    """
    cage = torus(8, 6)
    t = cage.topology
    first = (np.arange(cage.face_count) < 24)[t.face]
    lowest = t.edge_half_edge
    is_seam = first[lowest] != first[t.twin[lowest]]
    is_semi = (rng.random(t.edge_count) < 0.4) & first[lowest] & ~is_seam

    def creases(which, sharpness):
        return [(t.face_vertices[h], t.face_vertices[t.next[h]], sharpness) for h in lowest[which]]

    cage = cage.with_positions(cage.positions + rng.uniform(-0.1, 0.1, cage.positions.shape))
    values = Attribute(np.tile(cage.positions, (2, 1)), "face_varying", cage.face_vertices + first * cage.vertex_count)
    return cage, values, first, creases(is_semi, 1.75), creases(is_seam, INFINITE)


@pytest.mark.core
@pytest.mark.parametrize("mode", MODES[:-1])
def test_sharpness_beyond_a_seam_acts_where_values_depend_on_each_other(mode, np_rng):
    cage, values, first, semi, seam = two_rings(np_rng)
    # Sharpness of the seam itself is none of either side.
    on_seam = [(a, b, 2.5) for a, b, _ in seam]
    as_values = [
        LimitSurface(tagged(cage, face_varying=mode, creases=tags, attributes={"p": values}))
        for tags in ([], semi, semi + on_seam)
    ]
    places = random_locations(as_values[0], np_rng, 400)
    beyond = ~first[cage.topology.face_offsets[places[0]]]
    plain, sharp, sharper = (surface.evaluate_attribute("p", *places) for surface in as_values)
    np.testing.assert_allclose(sharper, sharp, rtol=0, atol=2 * ROUNDING)
    if mode.startswith("corners_plus"):
        # As if the seam were a crease: a vertex on it is a corner while anything is sharp there.
        creased = LimitSurface(tagged(cage, creases=semi + seam))
        np.testing.assert_allclose(sharp, creased.evaluate(*places).p, rtol=0, atol=2 * ROUNDING)
        assert np.abs(sharp - plain)[beyond].max() > 1e-3
    else:
        np.testing.assert_allclose(sharp[beyond], plain[beyond], rtol=0, atol=2 * ROUNDING)
    assert np.abs(sharp - plain)[~beyond].max() > 1e-3


@pytest.mark.core
@pytest.mark.parametrize("mode", MODES[:-1])
def test_values_at_a_semi_sharp_vertex_do_not_depend_on_each_other(mode, np_rng):
    """They are corners for as long as the vertex is sharp, and then for as long as their own edges are."""
    cage, values, first, semi, seam = two_rings(np_rng)
    corners = [(vertex, 0.5) for vertex in {end for *ends, _ in seam for end in ends}]
    plain, sharp, without = (
        LimitSurface(tagged(cage, face_varying=mode, creases=creases, corners=tags, attributes={"p": values}))
        for creases, tags in (([], corners), (semi, corners), ([], []))
    )
    places = random_locations(plain, np_rng, 400)
    beyond = ~first[cage.topology.face_offsets[places[0]]]
    plain, sharp, without = (surface.evaluate_attribute("p", *places) for surface in (plain, sharp, without))
    np.testing.assert_allclose(sharp[beyond], plain[beyond], rtol=0, atol=2 * ROUNDING)
    assert np.abs(sharp - plain)[~beyond].max() > 1e-3
    assert np.abs(plain - without)[beyond].max() > 1e-3 or mode == "boundaries"


def flat_place(cage, element, uv, corner):
    """Where parameters lie on a flat sheet."""
    t = cage.topology
    start = t.face_offsets[element] + corner
    origin, u, v = (cage.positions[cage.face_vertices[h], :2] for h in (start, t.next[start], t.prev[start]))
    return origin + uv[:, :1] * (u - origin) + uv[:, 1:] * (v - origin)


# Modes do not choose seams, but how values move there, if at all.
@EVERY_CAGE
@pytest.mark.parametrize("mode", ["none", "corners_plus2", "all"])
def test_sides_of_an_edge_differ_on_seams_only(scheme, cage, mode, np_rng):
    indices = random_indices(cage, np_rng, "joined islands")
    surface = LimitSurface(textured(cage, indices, np_rng, face_varying=mode), scheme)
    t = cage.topology
    half_edges = np.flatnonzero(t.twin > np.arange(t.half_edge_count))
    twins = t.twin[half_edges]
    if scheme == "catmull_clark":
        # Seen from a polygon's corner the parameters reach the middle of an edge only.
        whole = (t.face_sizes[t.face[half_edges]] == 4) & (t.face_sizes[t.face[twins]] == 4)
        half_edges, twins = half_edges[whole], twins[whole]

    def along(side, parameter):
        face = t.face[side]
        uv = np.stack([np.full(len(side), parameter), np.zeros(len(side))], axis=1)
        return surface.evaluate_attribute("texcoords", face, uv, side - t.face_offsets[face])

    agrees_at_start = indices[half_edges] == indices[t.next[twins]]
    agrees_at_end = indices[t.next[half_edges]] == indices[twins]
    for parameter in (0.25, 0.5):
        apart = np.abs(along(half_edges, parameter) - along(twins, 1 - parameter)).max(axis=1)
        np.testing.assert_array_equal(apart > 1e-9, ~(agrees_at_start & agrees_at_end))
    # Its ends may agree though.
    for parameter, agrees in ((0, agrees_at_start), (1, agrees_at_end)):
        apart = np.abs(along(half_edges, parameter) - along(twins, 1 - parameter)).max(axis=1)
        np.testing.assert_array_equal(apart > 1e-9, ~agrees)


@pytest.mark.core
@EVERY_CAGE
def test_linear_values_are_bilinear_over_each_face(scheme, cage, np_rng):
    t = cage.topology
    values = np_rng.random((cage.vertex_count, 2))
    surface = LimitSurface(
        tagged(
            cage,
            face_varying="all",
            texcoords=Attribute(values, "face_varying", cage.face_vertices),
            attributes={"varying": Attribute(values, "varying")},
        ),
        scheme,
    )
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
        found = surface.evaluate_attribute(name, element, uv, corner)
        np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)


def test_a_constant_stays_one(np_rng):
    cage = CAGES["polygons"][1]
    indices = random_indices(cage, np_rng, "islands")
    constant = np.full((indices.max() + 1, 1), 0.1)
    surface = LimitSurface(tagged(cage, attributes={"one": Attribute(constant, "face_varying", indices)}))
    assert (surface.evaluate_attribute("one", *random_locations(surface, np_rng)) == 0.1).all()


# Doo-Sabin


def test_doo_sabin_interpolates_what_has_no_seams(np_rng):
    cage = torus(5, 4)
    surface = LimitSurface(
        tagged(
            cage,
            texcoords=Attribute(cage.positions[:, :2], "face_varying", cage.face_vertices),
            attributes={"vertex": Attribute(cage.positions)},
        ),
        "doo_sabin",
    )
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
        (Attribute(np.zeros((8, 1)), "face_varying", cube().face_vertices), "all", "no rules for linear interpolation"),
    ],
)
def test_doo_sabin_has_no_rules_for_others(attribute, mode, message):
    surface = LimitSurface(tagged(cube(), attributes={"a": attribute}, face_varying=mode), "doo_sabin")
    with pytest.raises(SchemeError, match=message):
        surface.evaluate_attribute("a", 0, [[0, 0]])
    with pytest.raises(SchemeError, match=message):
        surface.tessellate(2)


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [({}, "a cage with attributes"), ({"a": Attribute(np.zeros((8, 1)))}, "expected one of a")],
)
def test_unknown_attributes_name_the_known_ones(attributes, expected):
    surface = LimitSurface(tagged(cube(), attributes=attributes))
    with pytest.raises(ValueError, match=f'control cage has no attribute "texcoords"; .*{expected}'):
        surface.evaluate_attribute("texcoords", 0, [[0, 0]])
