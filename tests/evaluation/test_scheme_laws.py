import numpy as np
import pytest
from evaluation.common import ChangedCatmullClark
from mitsuba_subdivision import LimitSurface, SchemeError, check_scheme, register_scheme
from mitsuba_subdivision.cage.contents import Attribute
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.schemes import CatmullClark, DooSabin, Loop, Refinement, Scheme, StencilTable
from mitsuba_subdivision.schemes.domain import SQUARE
from mitsuba_subdivision.schemes.scheme import PhantomPoint, tensor_basis
from patches.closed_cages import extraordinary_triangles
from reference.refined_cages import sheet, tagged

# Rounding over some levels of refinement of the unit ball.
POINT = 1e-12


class Warren(Loop):
    """Loop's scheme with Warren's simpler weights: the example of the guide."""

    name = "warren"

    def vertex_weight(self, valence):
        return np.where(valence == 3, 3 / 16, 3 / (8 * valence))


class Bilinear(Scheme):
    """The simplest scheme that states every rule itself: quads split at midpoints, whose limit is the cage itself."""

    name = "bilinear"
    element = "face"
    domain = SQUARE
    regular_face_size = 4
    regular_valence = 4
    regular_lattice = np.array([(0, 0), (1, 0), (0, 1), (1, 1)], dtype=float)
    first_edge = np.array([(0, 0), (1, 0)], dtype=float)
    edge_turn = np.array([(0, -1), (1, 0)], dtype=float)

    def refine(self, topology):
        t = topology
        smooth = CatmullClark().refine(t)
        edges, faces = t.vertex_count + t.edge, t.vertex_count + t.edge_count + t.face
        first, vertices = t.edge_half_edge, np.arange(t.vertex_count)
        stencils = StencilTable.of(
            smooth.topology.vertex_count,
            t.vertex_count,
            (vertices, vertices, 1.0),
            (edges[first], t.face_vertices[first], 0.5),
            (edges[first], t.face_vertices[t.next[first]], 0.5),
            (faces, t.face_vertices, 1 / t.face_sizes[t.face]),
        )
        return Refinement(smooth.topology, stencils)

    def children(self, topology, refined, half_edge):
        return CatmullClark().children(topology, refined, half_edge)

    def regular_basis(self, uv, derivatives):
        one = np.ones_like(uv[:, 0])
        rows = [np.array([(1 - t, t), (-one, one), (0 * one, 0 * one)]) for t in uv.T]
        return tensor_basis(*(row[: derivatives + 1] for row in rows), derivatives)


@pytest.fixture
def known(monkeypatch):
    from mitsuba_subdivision.schemes import scheme

    monkeypatch.setattr(scheme, "_SCHEMES", dict(scheme._SCHEMES))


@pytest.mark.usefixtures("known")
def test_a_users_scheme_is_known_by_its_name_and_exact():
    register_scheme(Warren())
    cage = extraordinary_triangles(5, rows=2)
    limit, errors = LimitSurface(cage, "warren").tessellate(1).positions, []
    finer = cage
    for level in range(5):
        finer = finer.refined("warren")
        errors.append(np.abs(finer.positions[: cage.vertex_count] - limit).max())
        # One refinement of the whole mesh has the same surface.
        if level == 0:
            assert np.abs(LimitSurface(finer).tessellate(1).positions[: cage.vertex_count] - limit).max() < POINT
    # Vertices approach the limit by a factor of about 4 a level.
    assert errors[4] < errors[2] / 10 < 1e-3
    assert np.abs(limit - LimitSurface(cage, "loop").tessellate(1).positions).max() > 1e-3


@pytest.mark.usefixtures("known")
def test_a_users_scheme_works_in_a_scene(variant_scalar_rgb):  # noqa: ARG001
    import mitsuba as mi

    register_scheme(Warren())
    properties = extraordinary_triangles(5).as_properties(mi)
    shape = mi.load_dict({"type": "subdivision", "scheme": "warren", "tessellation_rate": 2, **properties})
    assert 'scheme = "warren"' in str(shape)


def test_schemes_may_define_all_rules_and_need_no_registration():
    cage = extraordinary(4)
    samples = LimitSurface(cage, Bilinear()).evaluate(0, [[0.25, 0.5]])
    a, b, c, d = cage.positions[cage.face_vertices[:4]]
    assert np.abs(samples.p[0] - (0.375 * a + 0.125 * b + 0.125 * c + 0.375 * d)).max() < POINT


class TooWide(Warren):
    name = "too_wide"

    def vertex_weight(self, valence):
        return 1.9 / valence


class OtherBasis(DooSabin):
    name = "other_basis"

    def regular_basis(self, uv, derivatives):
        return super().regular_basis(uv**1.01, derivatives)


class WrongDerivatives(CatmullClark):
    name = "wrong_derivatives"

    def regular_basis(self, uv, derivatives):
        rows = super().regular_basis(uv, derivatives)
        rows[1:] *= 1.01
        return rows


def standing(matrix, t):
    """Refined vertices around an extraordinary one stay where they are."""
    if not is_regular(t):
        edge_points = t.vertex_count + t.edge
        matrix[edge_points] = 0
        matrix[edge_points, t.face_vertices[t.edge_half_edge[t.edge]]] = 1
    return matrix


def sharpened(matrix, t):
    """The first vertex moves away from the others."""
    if not is_regular(t):
        matrix[0, :2] += 0.9, -0.9
    return matrix


def is_regular(t):
    return (t.vertex_face_count[~t.is_border_vertex] == 4).all()


def far_border(matrix, t):
    """Vertices on borders of more than three faces take from one within."""
    if is_far_border(t):
        matrix[0, [0, t.face_vertices[2]]] += -0.01, 0.01
    return matrix


def by_valence(matrix, t):
    """Edge points beside such vertices depend on their valence."""
    if is_far_border(t):
        weight = 0.01 * t.vertex_face_count[0]
        matrix[t.vertex_count + t.edge[0], [0, t.face_vertices[1]]] += -weight, weight
    return matrix


def is_far_border(t):
    return t.is_border_vertex[0] and t.vertex_face_count[0] > 3


SHARPENED = ChangedCatmullClark("sharpened", sharpened)
SHARPENED.phantom_points = None


class OtherBorder(CatmullClark):
    name = "other_border"
    phantom_points = tuple(PhantomPoint(point.offsets, (1.9, -0.9)) for point in CatmullClark.phantom_points)


@pytest.mark.parametrize(
    ("scheme", "message"),
    [
        (ChangedCatmullClark("leaking", lambda matrix, _: 1.001 * matrix), "leaking: .* has weights that sum to 1.001"),
        (OtherBasis(), "other_basis: row 1 of the regular basis is wrong by"),
        (OtherBorder(), "other_border: the regular basis does not fit the rules"),
        (WrongDerivatives(), "wrong_derivatives: row 1 of the regular basis is wrong by"),
        (TooWide(), "too_wide: "),
        (ChangedCatmullClark("standing", standing), "standing: .*: the second eigenvalue has modulus 1;"),
        (SHARPENED, "sharpened: has_convex_rules, but a weight of -"),
        (ChangedCatmullClark("far_border", far_border), "has_local_borders, but an inner vertex has a weight"),
        (ChangedCatmullClark("by_valence", by_valence), "but weights beside a border depend on a valence"),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_broken_laws_are_errors(scheme, message):
    with pytest.raises(SchemeError, match=message):
        check_scheme(scheme)


@pytest.mark.parametrize("scheme", [CatmullClark(), DooSabin(), Loop(), Warren(), Bilinear()], ids=lambda s: s.name)
def test_schemes_keep_the_laws(scheme):
    check_scheme(scheme)


class WithoutPhantomPoints(CatmullClark):
    name = "closed"
    phantom_points = None


@pytest.mark.parametrize(
    "cage",
    [sheet(2, 2), tagged(cube(), creases=[(0, 1, np.inf)]), tagged(cube(), corners=[(0, np.inf)])],
    ids=["border", "crease", "corner"],
)
def test_without_phantom_points_open_cages_and_sharp_features_are_refused(cage):
    with pytest.raises(SchemeError, match=r"closed has no rules for borders, .* states no phantom_points; expected"):
        LimitSurface(cage, WithoutPhantomPoints())


def test_without_phantom_points_seams_of_texture_coordinates_are_refused(np_rng):
    texcoords = Attribute(np_rng.random((24, 2)), "face_varying", np.arange(24))
    surface = LimitSurface(tagged(cube(), texcoords=texcoords), WithoutPhantomPoints())
    with pytest.raises(SchemeError, match='no rules for seams, as of the attribute "texcoords"'):
        surface.evaluate_attribute("texcoords", 0, [[0.5, 0.5]])


@pytest.mark.parametrize("scheme", [CatmullClark, object(), 3])
def test_other_objects_than_schemes_are_refused(scheme):
    for use in (register_scheme, lambda s: LimitSurface(cube(), s)):
        with pytest.raises(SchemeError, match="expected a scheme's name, or an object of a class derived from Scheme"):
            use(scheme)


def test_a_scheme_states_its_rules():
    class Silent(Scheme):
        name = "silent"

    with pytest.raises(TypeError, match="abstract methods"):
        Silent()
    silent = CatmullClark()
    silent.name = ""
    with pytest.raises(SchemeError, match="CatmullClark has no name"):
        register_scheme(silent)
