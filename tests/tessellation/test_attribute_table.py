import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.contents import Attribute
from mitsuba_subdivision.cage.named_cages import extraordinary
from patches.closed_cages import bumpy, extraordinary_triangles, mixed_torus, prism
from reference.refined_cages import tagged
from scipy.spatial import cKDTree

ROUNDING = 1e-13


def with_seams(cage, rng, mode="corners_plus1"):
    """A cage with creases, texture coordinates and attributes of every kind, with seams of their own."""
    t = cage.topology
    creased = t.edge_half_edge[rng.random(t.edge_count) < 0.08]

    def face_varying(width, share):
        indices = t.face_vertices * 3 + rng.choice(3, t.half_edge_count, p=[1 - 2 * share, share, share])
        return Attribute(rng.random((3 * cage.vertex_count, width)), "face_varying", indices)

    return tagged(
        cage,
        creases=[(t.face_vertices[h], t.face_vertices[t.next[h]], 10) for h in creased],
        face_varying=mode,
        texcoords=face_varying(2, 0.05),
        attributes={
            "other_seams": face_varying(3, 0.02),
            "without_seams": Attribute(rng.random((cage.vertex_count, 1)), "face_varying", cage.face_vertices),
            "vertex": Attribute(rng.random((cage.vertex_count, 3))),
            "varying": Attribute(rng.random((cage.vertex_count, 4)), "varying"),
        },
    )


CAGES = {
    "dome": ("catmull_clark", extraordinary(3, closed=False)),
    "polygons": ("catmull_clark", prism()),
    "triangles": ("loop", extraordinary_triangles(7, rows=2)),
}
EVERY_CAGE = pytest.mark.parametrize(("scheme", "cage"), CAGES.values(), ids=CAGES.keys())
# Odd rates differ from even ones in polygons only, which they cut through the middle of their edges.
GRIDS = {
    f"{name}, rate {rate}, {mode}": (*CAGES[name], rate, mode)
    for mode in ("corners_plus1", "all")
    for name, rate in (*(("polygons", rate) for rate in (1, 2, 3, 4)), ("dome", 4), ("triangles", 4))
}


@pytest.mark.parametrize(("scheme", "cage", "rate", "mode"), GRIDS.values(), ids=GRIDS)
def test_every_vertex_has_the_values_of_its_element_at_its_place(scheme, cage, rate, mode, np_rng):
    """And positions and normals do not change by a bit."""
    cage = bumpy(cage)
    given = with_seams(cage, np_rng, mode)
    surface = LimitSurface(given, scheme)
    without_seams = LimitSurface(tagged(cage, creases=given.contents.creases), scheme)
    mesh, plain = surface.tessellate(rate), without_seams.tessellate(rate)
    assert len(mesh.normals) == len(mesh.texcoords) == len(mesh.positions) > len(plain.positions)
    np.testing.assert_array_equal(mesh.positions[mesh.triangles], plain.positions[plain.triangles])
    np.testing.assert_array_equal(mesh.normals[mesh.triangles], plain.normals[plain.triangles])
    np.testing.assert_array_equal(mesh.element, plain.element)
    # The fewest corners and the most among them.
    for element in np.argsort(surface.cage.face_sizes, kind="stable")[[0, 1, 2, 5, -3, -2, -1]]:
        vertices = np.unique(mesh.triangles[mesh.element == element])
        corner, uv = lattice(surface, element, rate)
        # Places are known again by the positions that they have.
        distance, at = cKDTree(surface.evaluate(element, uv, corner).p).query(mesh.positions[vertices])
        assert distance.max() <= ROUNDING
        for name, values in (("texcoords", mesh.texcoords), *mesh.attributes.items()):
            expected = surface.evaluate_attribute(name, element, uv[at], corner[at])
            np.testing.assert_allclose(values[vertices], expected, rtol=0, atol=ROUNDING)


def lattice(surface, element, rate):
    size, domain = surface.cage.face_sizes[element], surface.scheme.domain
    whole = size == domain.corner_count
    steps = np.arange(rate + 1) / rate if whole else np.append(np.arange(rate // 2 + 1) * 2 / rate, 1.0)
    uv = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    uv = uv[domain.inside(uv) >= -ROUNDING]
    corners = np.arange(1 if whole else size)
    return np.repeat(corners, len(uv)), np.tile(uv, (len(corners), 1))


@EVERY_CAGE
def test_vertices_are_split_where_seams_or_creases_are_only(scheme, cage, np_rng):
    cage = with_seams(bumpy(cage), np_rng)
    surface = LimitSurface(cage, scheme)
    mesh, t = surface.tessellate(3), cage.topology
    seam = surface.channel("texcoords").layout.seam | surface.channel("other_seams").layout.seam
    cut = ((seam | cage.tags.is_infinite) & (t.twin >= 0)).sum() + (t.twin < 0).sum()
    edges = np.concatenate([mesh.triangles[:, [i, i - 1]] for i in range(3)])
    counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]
    assert set(counts) <= {1, 2}
    assert (counts == 1).sum() == 3 * cut


@pytest.mark.parametrize("scheme", ["catmull_clark", "doo_sabin"])
def test_attributes_without_seams_use_the_vertices_of_the_surface(scheme, np_rng):
    cage = bumpy(mixed_torus())
    colour = np_rng.random((cage.vertex_count, 3))
    surface = LimitSurface(tagged(cage, attributes={"colour": Attribute(colour)}), scheme)
    table = surface.sampling(3)
    layout, attributes = surface.attribute_table(table)
    assert layout.surface_vertex is None
    assert layout.triangles is table.triangles
    assert layout.gathered(colour) is colour
    # The same weights as for points, so that these come out as points do.
    np.testing.assert_allclose(attributes["colour"], table.apply(colour)[0], rtol=0, atol=ROUNDING)


def test_other_evaluators_keep_the_values(np_rng):
    surface = LimitSurface(with_seams(bumpy(extraordinary(5)), np_rng))
    exact, stam = surface.tessellate(2), surface.tessellate(2, "stam", np.float32, 1e-3)
    np.testing.assert_array_equal(stam.texcoords, exact.texcoords)
    np.testing.assert_allclose(stam.positions, exact.positions, rtol=0, atol=1e-2)


def test_smooth_attributes_are_the_same_on_both_sides_of_a_crease(np_rng):
    base = extraordinary(5)
    creases = [(0, far, 10) for far in base.face_vertices.reshape(-1, 4)[:3, 1].tolist()]
    attribute = Attribute(np_rng.standard_normal((base.vertex_count, 3)))
    mesh = LimitSurface(tagged(base, creases=creases, attributes={"weight": attribute})).tessellate(5)
    places = np.unique(mesh.positions, axis=0)
    assert len(places) < len(mesh.positions)
    assert len(np.unique(np.hstack([mesh.positions, mesh.attributes["weight"]]), axis=0)) == len(places)
