"""Faces at a large semi-sharp fan, refined by a window and the fan, against the whole one-ring refined by the rules."""

import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.evaluation.divided_element import element_of
from mitsuba_subdivision.evaluation.refined_fans import RefinedFace, window
from mitsuba_subdivision.evaluation.refined_rings import refined_ring
from mitsuba_subdivision.mesh.signature import BESIDE, LARGE_FAN, NEAR_FACES, fan_face_count, long_fan, window_of
from reference.refined_cages import tagged

VALENCE = LARGE_FAN + 5
# Of a fan that a crease cuts open.
LONG = NEAR_FACES + 6
# Roundings of sums of the same weights in another order.
ROUNDED = 1e-15
# Above 3, where refinements that only lower the sharpness are left out.
HIGH = 4.5


def wheel(corners, sharpness):
    """A vertex amid triangles, quadrilaterals or both, with spokes of some sharpness, and faces around all of these."""
    sizes = [corners if corners else 3 + (i % 3 == 0) for i in range(len(sharpness))]
    ring_count = sum(size - 2 for size in sizes)
    begins = np.cumsum([0, *(size - 2 for size in sizes)])
    ring = [[*range(begins[i], begins[i + 1] + 1)] for i in range(len(sharpness))]
    ring[-1][-1] = 0
    faces = [[2 * ring_count, *each] for each in ring]
    outer = [[i, ring_count + i, ring_count + (i + 1) % ring_count, (i + 1) % ring_count] for i in range(ring_count)]
    if corners == 3:
        outer = [half for a, b, c, d in outer for half in ([a, b, c], [a, c, d])]
    angle = 2 * np.pi * np.arange(ring_count) / ring_count
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points = np.concatenate([circle, 2 * circle, [[0, 0, 1]]])
    creases = [[2 * ring_count, int(begins[i]), value] for i, value in enumerate(sharpness) if value]
    # One edge that meets no spoke of a sharpness of its own, and one on the rim.
    creases += [[0, ring_count, 1.5], [3, 4, 2.25]]
    return ControlCage(points, faces + outer, creases=creases)


def sharp_spokes(kind, rng):
    return {
        "none": np.zeros(VALENCE),
        "one": np.eye(VALENCE)[2] * 2.5,
        "high": np.eye(VALENCE)[1] * HIGH + np.eye(VALENCE)[9] * HIGH,
        "all": np.round(rng.uniform(0, 4, VALENCE), 2),
        "dart": np.eye(LONG)[2] * 10,
        "semi-sharp dart": np.eye(LONG)[2] * 10 + np.eye(LONG)[5] * 2.5,
        "semi-sharp side": np.eye(2 * LONG)[0] * 10 + np.eye(2 * LONG)[LONG] * 10 + np.eye(2 * LONG)[5] * 2.5,
    }[kind]


def parts(element, most_depth):
    """Elements at the fan that are divided, at all depths."""
    if element.piece is None and most_depth and window(element.scheme, element.signature) is not None:
        yield element
        for number in range(len(element.domains)):
            yield from parts(element.child_element(number), most_depth - 1)


def is_at_crease(signature):
    """Whether a crease cuts the window."""
    corner = long_fan(signature)
    return corner is not None and fan_face_count(window_of(signature.fans[corner])) <= 2 * BESIDE


@pytest.mark.parametrize("kind", ["none", "one", "high", "all", "dart", "semi-sharp dart", "semi-sharp side"])
@pytest.mark.parametrize(
    ("scheme", "corners"), [("catmull_clark", 3), ("catmull_clark", 4), ("catmull_clark", 0), ("loop", 3)]
)
def test_children_are_those_of_the_whole_one_ring(scheme, corners, kind, np_rng):
    surface = LimitSurface(wheel(corners, sharp_spokes(kind, np_rng)), scheme)
    at_fan = [each.signature for each in surface.patches.classes if window(surface.scheme, each.signature) is not None]
    assert at_fan
    at_crease = [signature for signature in at_fan if is_at_crease(signature)]
    for signature in at_crease + at_fan[:: 7 if len(at_fan) < LONG else 29]:
        for element in parts(element_of(surface.scheme, signature), 3):
            whole, ring = refined_ring(surface.scheme, element.base.signature), element.base._ring
            assert isinstance(ring, RefinedFace)
            for number in range(len(element.domains)):
                expected = whole.stencils(0, number)
                assert ring.signature(number) == whole.signature(0, number)
                np.testing.assert_allclose(ring.stencils(number), expected, rtol=0, atol=ROUNDED)
                rows = np_rng.standard_normal((2, 1, len(expected)))
                over = ring.over_controls(rows, number)
                np.testing.assert_allclose(over, rows @ expected, rtol=0, atol=len(expected) * ROUNDED)


def test_faces_share_the_fan(np_rng):
    """Faces of a fan whose spokes all differ have signatures of their own, and one refinement of the fan."""
    surface = LimitSurface(wheel(4, sharp_spokes("all", np_rng)), "catmull_clark")
    elements = [element_of(surface.scheme, each.signature) for each in surface.patches.classes]
    rings = [each.base._ring for each in elements if window(surface.scheme, each.signature) is not None]
    assert len(rings) >= VALENCE
    assert len({id(ring._fan) for ring in rings}) == 1


def test_means_of_sharpness_need_the_whole_fan(np_rng):
    cage = wheel(4, sharp_spokes("one", np_rng))
    chaikin = LimitSurface(tagged(cage, creases=[(0, 1, 2.5)], crease_method="chaikin"), "catmull_clark")
    assert all(window(chaikin.scheme, each.signature) is None for each in chaikin.patches.classes)
