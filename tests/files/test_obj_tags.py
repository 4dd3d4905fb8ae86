"""OpenSubdiv's tags in OBJ files."""

import time

import numpy as np
import pytest
from mitsuba_subdivision import CageError, CageWarning, ControlCage
from mitsuba_subdivision.cage import contents
from mitsuba_subdivision.cage.contents import same
from mitsuba_subdivision.cage.named_cages import extraordinary

SHEET = "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 0 1 0\nv 1 1 0\nv 2 1 0\nf 1 2 5 4\nf 2 3 6 5\n"


@pytest.fixture
def read(tmp_path):
    def read(text, **options):
        (tmp_path / "cage.obj").write_text(SHEET + text)
        return ControlCage.from_file(tmp_path / "cage.obj", **options)

    return read


def sharp_edges(cage):
    t = cage.topology
    sharp = t.edge_half_edge[cage.tags.is_infinite[t.edge_half_edge]]
    ends = np.stack([t.face_vertices[sharp], t.face_vertices[t.next[sharp]]], 1)
    return sorted(tuple(sorted(edge)) for edge in ends.tolist())


def test_items_of_tags_count_from_0(read):
    """A sharpness of 0 is smooth, and one of 10 and more is infinite."""
    cage = read("t crease 2/1/0 4 1 10\nt corner 1/1/0 2 10.0\n")
    assert (sharp_edges(cage), np.flatnonzero(cage.tags.is_corner).tolist()) == ([(1, 4)], [2])
    cage = read("t crease 2/1/0 1 4 0\nt corner 1/1/0 1 0\n")
    assert not cage.tags.any
    assert read("t corner 1/1/0 0 1e400\n").tags.is_corner[0]
    cage = read("t crease 4/1/0 1 4 0 1 2.5\nt crease 4/2/0 1 2 0 3 3 4\nt corner 2/1/0 0 2 1.5\nt hole 1/0/0 1\n")
    sharpness_of = {tuple(sorted(edge)): sharpness for *edge, sharpness in cage.contents.creases.tolist()}
    assert sharpness_of == {(1, 4): 2.5, (0, 1): 2.5, (1, 2): 3, (0, 3): 4}
    assert (cage.contents.corners.tolist(), cage.holes.tolist()) == ([[0, 1.5], [2, 1.5]], [1])


# As OpenSubdiv's regression/common/far_utils.h reads them.
FACE_VARYING = ("none", "corners_only", "corners_plus1", "corners_plus2", "boundaries", "all")
RULES = {
    ("boundary", "interpolateboundary 1/0/0 {}"): dict(enumerate(("none", "edge_and_corner", "edge_only"))),
    # The last one counts.
    ("boundary", "interpolateboundary 1/0/0 0\nt interpolateboundary 1/0/0 {}"): {2: "edge_only"},
    ("face_varying", "facevaryinginterpolateboundary 1/0/0 {}"): dict(enumerate(FACE_VARYING)),
    ("face_varying", "facevaryingpropagatecorners 1/0/0 {}"): {0: "corners_plus1", 1: "corners_plus2"},
    ("crease_method", "creasemethod 0/0/1 {}"): {"normal": "uniform", "chaikin": "chaikin"},
    ("triangle_rule", "smoothtriangles 0/0/1 {}"): {"catmark": "catmull_clark", "smooth": "smooth"},
}


@pytest.mark.parametrize(("rule", "tag"), RULES)
def test_rules_are_those_of_tags_unless_an_argument_overrides_them(read, rule, tag):
    override = contents.RULES[rule][-1]
    for given, expected in RULES[rule, tag].items():
        assert getattr(read(f"t {tag.format(given)}\n"), rule) == expected
        assert getattr(read(f"t {tag.format(given)}\n", **{rule: override}), rule) == override


def test_corners_propagate_with_their_rule_only(read):
    text = "t facevaryingpropagatecorners 1/0/0 1\nt facevaryinginterpolateboundary 1/0/0 {}\n"
    assert read(text.format(2)).face_varying == "corners_plus2"
    with pytest.warns(CageWarning, match='line 9: tag "facevaryingpropagatecorners" has no effect .* rule "all"'):
        assert read(text.format(5)).face_varying == "all"


UNSUPPORTED, UNKNOWN = "is not supported and has no effect", "has an unknown value .* expected one of {}$"
WITHOUT_EFFECT = {
    **dict.fromkeys(
        ("odd 0/0/0", "faceedit 4/0/1 3 4 1 1 hole", "vertexedit 4/3/3 3 4 1 0 0 0 1 add P v"), UNSUPPORTED
    ),
    "interpolateboundary 1/0/0 3": UNKNOWN.format("0, 1, 2"),
    "facevaryinginterpolateboundary 1/0/0 6": UNKNOWN.format("0, 1, 2, 3, 4, 5"),
    "creasemethod 0/0/1 odd": UNKNOWN.format("normal, chaikin"),
    "smoothtriangles 0/0/1 normal": UNKNOWN.format("catmark, smooth"),
    "vertexedit 100/0/0" + " 0" * 100: UNSUPPORTED,
}


@pytest.mark.parametrize(("tag", "message"), WITHOUT_EFFECT.items())
def test_a_warning_names_what_has_no_effect_in_few_words(read, tag, message):
    shown = tag if len(tag) < 100 else r"vertexedit 100/0/0 0 0 [ 0]*\.\.\."
    with pytest.warns(CageWarning, match=rf'cage.obj", line 9: tag "{shown}" {message}'):
        read(f"t {tag}\n")


WRONG_TAGS = [
    ("crease 2/1/0 1 4", r'malformed tag "crease 2/1/0 1 4" \(2 values\); expected a name, counts'),
    ("crease 1/1/0 1 10", "tag crease has 1 integers and 1 floats; expected two integers per edge and a float"),
    ("crease 4/3/0 1 4 0 1 1 2 3", "tag crease has 4 integers and 3 floats; expected two integers per edge"),
    ("corner 1/0/0 1", "tag corner has 1 integers and 0 floats; expected one integer per vertex and a float"),
    ("hole 0/0/0", "tag hole has 0 integers and 0 floats; expected one or more integers and no floats"),
    ("hole 1/1/0 1 2.0", "tag hole has 1 integers and 1 floats; expected one or more integers"),
    ("creasemethod 1/0/0 1", 'tag "creasemethod 1/0/0 1" has the wrong values; expected one string'),
    ("interpolateboundary 2/0/0 1 1", 'tag "interpolateboundary .* has the wrong values; expected one integer'),
    ("crease -1/1/0 10", "malformed tag"),
    ("crease 2/1/0 1 x 10", "malformed tag"),
    ("crease", r'malformed tag "crease"; expected a name, counts'),
    ("", r'malformed tag ""; expected a name, counts'),
    *((f"hole 2/0/0 1 {face}", f"hole {face + 1} is no face; expected one of 2 faces") for face in (2, 7)),
    ("crease 2/1/0 1 4 -2.5", r"crease along edge \(2, 5\) has sharpness -2.5; expected 0 for smooth"),
    # Numbers of any size.
    (f"crease 2/1/0 0 1{'0' * 400} 1", r".*(\.\.\. is out of range|\(10+\.\.\.)"),
    ("hole 1/0/0 9223372036854775808", r".*\(9223372036854775808 is out of range\)"),
    (f"hole {'9' * 5000}/0/0 1", "malformed tag"),
    (f"hole 1/0/0 {'9' * 5000}", "malformed tag"),
    ("corner 1/1/0 4503599627370497000 1", "corners have the row .*; expected .vertex, sharpness"),
    ("crease 2/1/0 0 4611686018427387904 1", "creases have the row .*; expected .vertex, vertex, sharpness"),
    ("crease 2/1/0 0 1 nan", "crease along edge .* has sharpness nan"),
]


@pytest.mark.parametrize(("tag", "message"), WRONG_TAGS)
def test_wrong_tags_are_errors_that_name_their_line_in_few_words(read, tag, message):
    with pytest.raises(CageError, match=f'cage.obj", line 9: {message}') as caught:
        read(f"t {tag}\n")
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("tag", "message", "edges", "corners"),
    [
        ("crease 4/1/0 0 4 1 4 10", r"crease along edge \(1, 5\), which is no edge of a face, is ign", [(1, 4)], []),
        ("corner 2/1/0 6 1 10", "corner at vertex 7, which is none of 6 vertices, is ignored", [], [1]),
    ],
)
def test_tags_of_what_no_face_has_are_ignored_and_told(read, tag, message, edges, corners):
    """As OpenSubdiv's Far::TopologyRefinerFactory does; the others of the statement count."""
    with pytest.warns(CageWarning, match=f'cage.obj", line 9: {message}'):
        cage = read(f"t {tag}\n")
    assert (sharp_edges(cage), np.flatnonzero(cage.tags.is_corner).tolist()) == (edges, corners)


def test_many_tags_are_read_as_one_by_one(tmp_path):
    """Lines of the most common form take array passes; here each has a twin in another form, which does not."""
    rng, cage = np.random.default_rng(3), extraordinary(7)
    tags = [(f"t hole 1/0/0 {face}\n", f"t hole 1/0/0  +{face}\n") for face in range(3)]
    for a, b in cage.edges[rng.integers(0, len(cage.edges), 40)].tolist():
        crease = f"{a} {b} {rng.uniform(0, 12)!r}\n"
        tags.append((f"t crease 2/1/0 {crease}", f"t  crease\t2/1/0 {crease}"))
    for vertex in rng.integers(0, cage.vertex_count, 20).tolist():
        corner = f"{vertex} {vertex}e-1"
        tags.append((f"t corner 1/1/0 {corner}\n", f"t corner  1/1/0 {corner} # a comment\n"))
    plain, other = np.array(tags)[rng.permutation(len(tags))].T
    cages = []
    # Mixed, too, as the last of several tags of an edge counts.
    for lines in (plain, other, np.where(rng.random(len(tags)) < 0.5, plain, other)):
        cage.with_positions(cage.positions).save(tmp_path / "cage.obj")
        with open(tmp_path / "cage.obj", "a") as file:
            file.writelines(lines)
        cages.append(ControlCage.from_file(tmp_path / "cage.obj"))
    for again in cages[1:]:
        assert same((again.contents, again.source.tag_lines), (cages[0].contents, cages[0].source.tag_lines))


def test_a_malformed_line_among_many_tags_is_named(read):
    with pytest.raises(CageError, match="line 10: malformed tag"):
        read("t crease 2/1/0 4 1 10\nt crease 2/1/0 4 1.0 10\nt crease 2/1/0 1 4 2\n")
    with pytest.warns(CageWarning, match="line 10: crease along edge"):
        read("t crease 2/1/0 4 1 10\nt crease 2/1/0 4 99 10\n")


def test_time_of_tags_grows_with_their_number(tmp_path):
    """Each is some bytes of an array: a hundred thousand take less than a second."""
    path = tmp_path / "cage.obj"
    path.write_text(SHEET + "t crease 2/1/0 1 4 2.5\n" * 100_000)
    start = time.process_time()
    cage = ControlCage.from_file(path)
    assert time.process_time() - start < 1
    assert cage.tags.edges.max() == 2.5


def test_a_rule_that_no_tag_stands_for_is_lost_with_a_warning(tmp_path, monkeypatch):
    """As a new boundary rule would be, which OpenSubdiv's tags do not know."""
    monkeypatch.setitem(contents.RULES, "boundary", (*contents.RULES["boundary"], "new"))
    cage = ControlCage([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2, 3]], boundary="new")
    with pytest.warns(CageWarning, match="no place for boundary new"):
        cage.save(tmp_path / "cage.obj")
    assert ControlCage.from_file(tmp_path / "cage.obj").boundary == contents.RULES["boundary"][0]
