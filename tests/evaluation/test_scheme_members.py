"""Every member of a scheme, taken away and damaged in turn: told when the scheme is registered, not when it is used."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from mitsuba_subdivision import LimitSurface, SchemeError, register_scheme
from mitsuba_subdivision.cage.attributes import Attribute
from mitsuba_subdivision.cage.named_cages import cube, extraordinary_triangles
from mitsuba_subdivision.inspection import inspect
from mitsuba_subdivision.schemes import CatmullClark, DooSabin, Loop, Refinement, StencilTable, Unsupported
from mitsuba_subdivision.schemes.domain import SQUARE, TRIANGLE, AffineMap, ParameterDomain
from mitsuba_subdivision.schemes.scheme import OptionalMembers, PhantomPoint
from mitsuba_subdivision.schemes.scheme_members import optional_member, require_members
from reference.refined_cages import sheet, tagged

REQUIRED = (
    *("name", "element", "domain", "regular_face_size", "regular_valence", "regular_lattice", "first_edge"),
    *("edge_turn", "unsupported", "refine", "children", "regular_basis"),
)
OPTIONAL = {
    CatmullClark: (
        "phantom_points",
        "splits_corners",
        "has_convex_rules",
        "has_local_borders",
        "crease_method",
        "triangle_rule",
    ),
    Loop: ("phantom_points", "has_convex_rules", "has_local_borders", "crease_method"),
    DooSabin: ("phantom_points", "regular_border_faces", "has_convex_rules"),
}
CLOSED = {CatmullClark: cube(), Loop: extraordinary_triangles(5), DooSabin: cube()}
EVERY_SCHEME = pytest.mark.parametrize("original", OPTIONAL, ids=lambda original: original.name)
QUARTER = (SQUARE.children[0], *SQUARE.children[:0:-1])


class Members:
    """The members of another scheme, each its own, so that any can be taken away or be another."""

    def __init__(self, original, **others):
        for name in (*REQUIRED, "regular_border_faces", *OPTIONAL[type(original)]):
            setattr(self, name, getattr(original, name))
        self.name = "members"
        vars(self).update(others)

    def without(self, *names):
        for name in names:
            delattr(self, name)
        return self


@pytest.fixture(autouse=True)
def _forget_registered(monkeypatch):
    from mitsuba_subdivision.schemes import scheme_table

    monkeypatch.setattr(scheme_table, "_SCHEMES", dict(scheme_table._SCHEMES))


def use(cage):
    """Whatever reads members: patches, points, triangles, and what is said of the surface."""
    surface = LimitSurface(cage, "members")
    found = surface.evaluate(int(np.argmax(surface.patches.elements.face_sizes > 0)), [[0.0, 0.0], [0.25, 0.25]])
    assert np.isfinite(found.p).all()
    assert np.isfinite(found.n).all()
    assert np.isfinite(surface.tessellate(2).normals).all()
    str(inspect(surface))


@EVERY_SCHEME
def test_the_members_of_a_scheme_make_a_scheme(original):
    register_scheme(Members(original()))
    use(CLOSED[original])


@EVERY_SCHEME
@pytest.mark.parametrize("member", REQUIRED)
def test_a_missing_member_is_named(original, member):
    scheme = Members(original()).without(member)
    with pytest.raises(SchemeError, match=rf"Members is no scheme: it has no {member}"):
        register_scheme(scheme)
    with pytest.raises(SchemeError, match=rf"Members is no scheme: it has no {member}"):
        LimitSurface(CLOSED[original], scheme)


@pytest.mark.parametrize(("original", "member"), [(o, member) for o, names in OPTIONAL.items() for member in names])
def test_closed_cages_do_without_optional_members(original, member):
    register_scheme(Members(original()).without(member))
    use(CLOSED[original])


@EVERY_SCHEME
def test_closed_cages_do_without_all_optional_members(original):
    names = {*OPTIONAL[original], "regular_border_faces"}
    register_scheme(Members(original()).without(*names))
    use(CLOSED[original])


def test_vertices_on_borders_have_no_patch_and_need_no_phantom_points():
    register_scheme(Members(DooSabin()).without("phantom_points", "regular_border_faces"))
    use(sheet(3, 3))


@EVERY_SCHEME
def test_a_scheme_can_inherit_the_optional_members_that_it_does_not_state(original):
    class Inheriting(Members, OptionalMembers):
        pass

    names = {*OPTIONAL[original], "regular_border_faces"}
    scheme = Inheriting(original()).without(*names)
    assert {name: getattr(scheme, name) for name in names} == {name: getattr(OptionalMembers, name) for name in names}
    register_scheme(scheme)
    use(CLOSED[original])


@pytest.mark.parametrize("original", [CatmullClark, Loop])
@pytest.mark.parametrize("value", ["none", "absent"])
def test_without_phantom_points_open_cages_and_sharp_features_are_refused(original, value):
    scheme = Members(original(), phantom_points=None)
    register_scheme(scheme.without("phantom_points") if value == "absent" else scheme)
    refused = (
        r"the scheme members has no rules for borders, nor for infinitely sharp creases and corners, as it states no "
        r"phantom_points; expected a closed cage"
    )
    closed = CLOSED[original]
    a, b, c = (int(v) for v in closed.face_vertices[:3])
    options = {"creases": [(a, b, np.inf), (b, c, np.inf)]}, {"creases": [(a, b, np.inf)]}, {"corners": [(a, np.inf)]}
    for cage in (sheet(2, 2, triangles=original is Loop), *(tagged(closed, **option) for option in options)):
        with pytest.raises(SchemeError, match=refused):
            LimitSurface(cage, "members")


def test_without_phantom_points_seams_of_texture_coordinates_are_refused():
    register_scheme(Members(CatmullClark()).without("phantom_points"))
    closed = cube()
    corners = np.arange(24)
    cage = tagged(closed, texcoords=Attribute(np.random.default_rng(0).random((24, 2)), "face_varying", corners))
    surface = LimitSurface(cage, "members")
    with pytest.raises(
        SchemeError, match='no rules for seams, as of the attribute "texcoords", as it states no phantom'
    ):
        surface.evaluate_attribute("texcoords", 0, [[0.5, 0.5]])


def test_without_a_crease_method_semi_sharp_features_are_refused():
    closed = cube()
    cage = tagged(closed, creases=[(0, 1, 1.5)])
    register_scheme(Members(CatmullClark(), crease_method=None))
    with pytest.raises(SchemeError, match="the scheme members has no rules for semi-sharp creases and corners"):
        LimitSurface(cage, "members")


def test_phantom_points_need_the_faces_beside_the_border():
    with pytest.raises(SchemeError, match="members: has phantom_points, but no regular_border_faces; expected both"):
        register_scheme(Members(Loop()).without("regular_border_faces"))


def test_a_class_is_not_its_object():
    with pytest.raises(SchemeError, match="CatmullClark is no scheme but a class; expected one of its objects"):
        register_scheme(CatmullClark)


def test_a_scheme_must_be_a_key():
    class Equal(CatmullClark):
        def __eq__(self, other):
            return isinstance(other, Equal)

        __hash__ = None

    with pytest.raises(SchemeError, match="catmull_clark: has no hash"):
        register_scheme(Equal())


WRONG = {
    "name": [None, "", 3],
    "element": ["edge", None, ["face"]],
    "domain": [None, "square", TRIANGLE, ParameterDomain("square", SQUARE.corners, QUARTER)],
    "regular_face_size": ["4", 4.0, 3, 2, True],
    "regular_valence": [None, 2, 4.5],
    "regular_lattice": [
        None,
        CatmullClark.regular_lattice.tolist(),
        np.zeros(16),
        np.zeros((16, 3)),
        np.zeros((16, 2)),
    ],
    "first_edge": [None, ((0, 0), (1, 0)), np.zeros((2, 3)), np.zeros((2, 2)), np.full((2, 2), np.nan)],
    "edge_turn": [None, np.eye(2), np.eye(3), np.array([(0, -1), (1, 0)]).tolist(), np.array([("a", "b")] * 2)],
    "phantom_points": [
        3,
        "rules",
        (3,),
        (PhantomPoint(((1, 0),), (2, -1)),),
        (PhantomPoint(((1, 0), (2, 0)), (2, -2)),),
        (PhantomPoint(((1, 0, 0), (2, 0, 0)), (2, -1)),),
        (PhantomPoint(None, None),),
        (PhantomPoint(((1, 0), (2, 0)), ("2", "-1")),),
    ],
    "regular_border_faces": [None, 0, "2", 1.5],
    "splits_corners": [None, 1, "yes"],
    "has_convex_rules": [None, 1, "yes"],
    "has_local_borders": [None, 1, "yes"],
    "crease_method": [1, "normal", ["uniform"]],
    "triangle_rule": [0.47, "smoothed"],
    "unsupported": [None, 3],
    "refine": [None, 3],
    "children": [None, "four"],
    "regular_basis": [None, np.zeros((1, 1, 16))],
}


def test_every_optional_member_has_a_default_and_is_damaged_here():
    declared = OptionalMembers.__annotations__
    assert set(declared) <= set(WRONG)
    defaults = {name: optional_member(object(), name) for name in declared}
    assert defaults == {name: vars(OptionalMembers)[name] for name in declared}
    # Nothing is claimed of a scheme that does not say so.
    assert not any(defaults.values())


@EVERY_SCHEME
def test_our_schemes_have_convex_rules_and_say_so(original):
    scheme = original()
    weights = scheme.refine(CLOSED[original].topology).stencils.matrix.toarray()
    assert weights.min() >= 0
    assert scheme.has_convex_rules


@pytest.mark.parametrize(
    ("member", "number"), [(member, number) for member, values in WRONG.items() for number in range(len(values))]
)
def test_a_member_of_another_kind_or_shape_is_named(member, number):
    scheme = Members(CatmullClark(), **{member: WRONG[member][number]})
    with pytest.raises(SchemeError, match=rf"(members|Members): (\w+ is no scheme|{member}|edge_turn|regular_\w+) "):
        register_scheme(scheme)
    with pytest.raises(SchemeError):
        LimitSurface(cube(), scheme)


def test_a_domain_with_other_children_is_named():
    with pytest.raises(SchemeError, match=r"domain is .*; expected SQUARE or TRIANGLE"):
        require_members(Members(CatmullClark(), domain=type(SQUARE)("square", SQUARE.corners, QUARTER)))


def test_three_faces_may_meet_at_a_regular_vertex():
    # As in schemes on hexagons.
    require_members(Members(CatmullClark(), regular_valence=3))


SMOOTH = CatmullClark()


def refined(**changes):
    """`refine` with another topology or other stencils."""
    return lambda topology: SMOOTH.refine(topology)._replace(
        **{name: change(SMOOTH.refine(topology)) for name, change in changes.items()}
    )


def some_children(change):
    return lambda *mesh: change(SMOOTH.children(*mesh))


def basis(change):
    return lambda uv, derivatives: change(SMOOTH.regular_basis(uv, derivatives), uv, derivatives)


def raising(*_):
    return [].missing


def without_rules(refinement):
    t = refinement.topology
    return type(t)(t.vertex_count, t.face_sizes, t.face_vertices)


def wrong_slope(weights, *_):
    weights[1:] *= 1.01
    return weights


def changed(table, **members):
    """The same stencils but for some members of the table."""
    return StencilTable(**{**vars(table), **members})


# What each method does instead, and what is said then.
OTHER_BEHAVIOUR = {
    "unsupported raises": ("unsupported", raising, "unsupported raises AttributeError"),
    "unsupported says no": ("unsupported", lambda _: False, "unsupported returns bool; expected None, or Unsupported"),
    "unsupported names none": (
        *("unsupported", lambda _: Unsupported("face", np.array([], dtype=int), "", "")),
        "unsupported returns Unsupported; expected None, or Unsupported of one face or vertex",
    ),
    "unsupported names another": (
        *("unsupported", lambda t: Unsupported("vertex", np.array([t.vertex_count]), "", "")),
        "unsupported returns Unsupported",
    ),
    "unsupported refuses all": (
        *("unsupported", lambda _: Unsupported("face", np.array([0]), "is one", "none")),
        "unsupported refuses a face with fans",
    ),
    "refine raises": ("refine", raising, "refine raises AttributeError"),
    "refine takes nothing": ("refine", lambda: None, "refine raises TypeError"),
    "refine returns nothing": ("refine", lambda _: None, "refine returns NoneType; expected Refinement"),
    "refine returns a pair": (
        *("refine", lambda t: (SMOOTH.refine(t).topology, SMOOTH.refine(t).stencils)),
        "refine returns tuple",
    ),
    "refine returns a matrix": ("refine", refined(stencils=lambda r: r.stencils.matrix), "refine returns Refinement"),
    "refine leaves rows out": (
        *("refine", refined(stencils=lambda r: changed(r.stencils, row_count=r.stencils.row_count - 1))),
        "refine returns stencils of",
    ),
    "refine takes columns that are not there": (
        *("refine", refined(stencils=lambda r: changed(r.stencils, columns=r.stencils.columns + 1))),
        "refine returns stencils with entries out of range",
    ),
    "refine has no numbers": (
        *("refine", refined(stencils=lambda r: changed(r.stencils, weights=np.nan * r.stencils.weights))),
        "refine returns stencils with entries out of range",
    ),
    "refine forgets corners": (
        *("refine", refined(topology=without_rules)),
        "with the phantom points, .* child 0 of a regular element is not regular",
    ),
    "children raises": ("children", raising, "children raises AttributeError"),
    "children returns nothing": ("children", lambda *_: None, "children returns None; expected a list of pairs"),
    "children returns half-edges": (
        *("children", some_children(lambda parts: [half_edge for _, half_edge in parts])),
        "children returns .* expected a list of pairs",
    ),
    "children returns others": (
        *("children", some_children(lambda parts: [(m, 10**6) for m, _ in parts])),
        "children returns .* expected a list of pairs",
    ),
    "children returns three": ("children", some_children(lambda parts: parts[:-1]), "children returns 3 parts"),
    "children returns another order": (
        "children",
        some_children(lambda parts: parts[::-1]),
        "children returns 4 parts",
    ),
    "children returns other maps": (
        *("children", some_children(lambda parts: [(AffineMap(m.matrix, m.offset + 1), h) for m, h in parts])),
        "children returns 4 parts with other maps",
    ),
    "children returns one face four times": (
        *("children", some_children(lambda parts: [(m, parts[0][1]) for m, _ in parts])),
        "the regular basis does not fit the rules",
    ),
    "basis raises": ("regular_basis", raising, "regular_basis raises AttributeError"),
    "basis has no points": ("regular_basis", lambda *_: None, r"regular_basis\(.* returns a NoneType"),
    "basis is short": ("regular_basis", basis(lambda w, *_: w[:, :, :-1]), r"regular_basis\(.* returns the shape"),
    "basis has one precision": (
        *("regular_basis", basis(lambda w, *_: w.astype(np.float64))),
        r"regular_basis\(uv, 0\) with uv of float32 returns float64; expected float32",
    ),
    "basis sums to two": ("regular_basis", basis(lambda w, *_: 2 * w), "weights whose sums are wrong by 1.0e"),
    "basis is no number": ("regular_basis", basis(lambda w, *_: np.nan * w), "weights whose sums are wrong by nan"),
    "basis has other slopes": ("regular_basis", basis(wrong_slope), "regular_basis returns a d/du wrong by"),
    "basis depends on derivatives": (
        *("regular_basis", basis(lambda w, _, derivatives: w[..., ::-1] if derivatives == 1 else w)),
        "regular_basis returns other weights with 1 derivatives than with 2",
    ),
    "lattice and basis in other orders": (
        *("regular_lattice", CatmullClark.regular_lattice[::-1].copy()),
        "the regular basis does not fit the rules",
    ),
    "lattice between vertices": (
        *("regular_lattice", CatmullClark.regular_lattice + 0.5),
        "regular_lattice has points where no vertex of a regular one-ring is",
    ),
    "phantom points leave points out": (
        *("phantom_points", CatmullClark.phantom_points[:1]),
        "the phantom points give no control point at",
    ),
    "phantom points of another border": (
        *("phantom_points", tuple(rule._replace(weights=(3, -2)) for rule in CatmullClark.phantom_points)),
        "members: with the phantom points, .* the regular basis does not fit the rules",
    ),
    "more faces at the border": (
        *("regular_border_faces", 3),
        "members: .*",
    ),
}


@pytest.mark.parametrize("damage", OTHER_BEHAVIOUR)
def test_a_member_that_does_something_else_is_named(damage):
    member, value, message = OTHER_BEHAVIOUR[damage]
    with pytest.raises(SchemeError, match=message):
        register_scheme(Members(CatmullClark(), **{member: value}))


@pytest.mark.parametrize(("kind", "own"), [("vertex", 4), ("face", 1)])
def test_a_scheme_needs_rules_for_a_regular_face_and_its_corners_and_not_for_what_lies_beside_them(kind, own):
    """Those of the face come first in its one-ring."""

    def refusing(index):
        return Members(CatmullClark(), unsupported=lambda _: Unsupported(kind, np.array([index]), "is here", "none"))

    for index in range(own):
        with pytest.raises(SchemeError, match="unsupported refuses a face with fans"):
            register_scheme(refusing(index))
    register_scheme(refusing(own))


def test_faces_that_are_not_the_corners_do_not_split_corners():
    class Turned(CatmullClark):
        """Each refined face begins at the middle of an edge."""

        name = "turned"

        def refine(self, topology):
            refinement = super().refine(topology)
            t = refinement.topology
            turned = np.roll(t.face_vertices.reshape(-1, 4), -1, axis=1)
            kept = type(t)(t.vertex_count, t.face_sizes, turned.ravel(), rules=t.rules)
            return Refinement(kept, refinement.stencils)

        def children(self, topology, refined, half_edge):
            return [(m, h - h % 4 + (h + 3) % 4) for m, h in super().children(topology, refined, half_edge)]

    with pytest.raises(
        SchemeError, match="turned: refine returns other faces; expected a quadrilateral at every corner"
    ):
        register_scheme(Turned())
    scheme = Turned()
    scheme.splits_corners = False
    register_scheme(scheme)


def test_convex_rules_have_no_negative_weights():
    original = CatmullClark()

    def sharpened(topology):
        """Every vertex moves away from the middle of the rule's two first points, by as much."""
        refinement = original.refine(topology)
        matrix = refinement.stencils.matrix.toarray()
        matrix[0] += matrix[0] - matrix[1]
        return Refinement(refinement.topology, StencilTable.from_matrix(scipy.sparse.csr_array(matrix)))

    with pytest.raises(
        SchemeError, match=r"refine returns a weight of -.*; expected none below 0, as has_convex_rules"
    ):
        register_scheme(Members(original, refine=sharpened))
    basis = Members(original, regular_basis=lambda uv, derivatives: _tilted(original.regular_basis(uv, derivatives)))
    with pytest.raises(SchemeError, match=r"regular_basis.* returns a weight of -.*; expected none below 0"):
        register_scheme(basis)


def _tilted(weights):
    weights = weights.copy()
    weights[0, :, 0] -= 1
    weights[0, :, 1] += 1
    return weights


def test_what_unsupported_says_of_a_cage_is_checked_there_too():
    scheme = Members(CatmullClark(), unsupported=lambda t: None if t.vertex_face_count.max() > 3 else True)
    with pytest.raises(SchemeError, match="members: unsupported returns bool; expected None, or Unsupported"):
        LimitSurface(cube(), scheme)


def test_tables_of_stencils_may_come_from_matrices():
    scheme = Members(CatmullClark(), refine=refined(stencils=lambda r: StencilTable.from_matrix(r.stencils.matrix)))
    register_scheme(scheme)
    use(cube())


def test_local_borders_have_weights_of_neighbours_on_the_border_only():
    original = CatmullClark()

    def refined(topology, row, other, share):
        """Rules that give a share of the first vertex to another, if that is on a border with more than three faces."""
        refinement = original.refine(topology)
        matrix = refinement.stencils.matrix.toarray()
        if topology.is_border_vertex[0] and topology.vertex_face_count[0] > 3:
            matrix[row, [0, other]] += -share, share
        return Refinement(refinement.topology, StencilTable.from_matrix(scipy.sparse.csr_array(matrix)))

    def by_inner_vertex(topology):
        return refined(topology, 0, topology.face_vertices[2], 0.01)

    def by_valence(topology):
        first_edge = topology.vertex_count + topology.edge[0]
        return refined(topology, first_edge, topology.face_vertices[1], 0.01 * topology.vertex_face_count[0])

    with pytest.raises(SchemeError, match=r"refine returns a weight of .* of an inner vertex .*has_local_borders"):
        register_scheme(Members(original, refine=by_inner_vertex))
    with pytest.raises(SchemeError, match=r"refine returns other weights at a border of 8 faces .*has_local_borders"):
        register_scheme(Members(original, refine=by_valence))
