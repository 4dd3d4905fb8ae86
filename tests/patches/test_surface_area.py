import numpy as np
import pytest
from kernels.surfaces import surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from patches.closed_cages import bumpy, cage_of
from reference.refined_cages import sheet, tagged

# Relative error of an area.
EXACT = 1e-10
# Triangles of 10, 20 and 40 segments, extrapolated twice for errors of second and fourth order. Around extraordinary
# points and along creases errors are of other orders; measured, up to 2e-7.
EXTRAPOLATED = 1e-6
SEGMENTS = (10, 20, 40)


def triangle_area(surface, rate):
    made = surface.tessellate(rate)
    a, b, c = made.positions[made.triangles].swapaxes(0, 1)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


@pytest.mark.core
@pytest.mark.parametrize("triangles", [False, True])
def test_area_of_a_flat_sheet(triangles):
    # Where its corners stay, the sheet is the rectangle.
    cage = tagged(sheet(4, 3, triangles=triangles), corners=[(vertex, 10.0) for vertex in (0, 4, 15, 19)])
    np.testing.assert_allclose(LimitSurface(cage, "loop" if triangles else "catmull_clark").area(), 12, rtol=EXACT)


@pytest.mark.core
def test_area_of_a_box_of_creases():
    box = tagged(cube(), creases=[(*edge, 10.0) for edge in cube().edges])
    np.testing.assert_allclose(LimitSurface(box).area(), 24, rtol=EXACT)


# Extrapolation does less for many triangles around a vertex, and where surfaces bend at several levels.
@pytest.mark.parametrize("name", ["hexagon", "dart", "half disc of 6", "chaikin", "loop corner", "doo_sabin sheet"])
def test_areas_are_limits_of_triangle_areas(name):
    surface = surface_named(name)
    coarse, middle, fine = (triangle_area(surface, rate) for rate in SEGMENTS)
    first, second = (4 * middle - coarse) / 3, (4 * fine - middle) / 3
    np.testing.assert_allclose(surface.area(), (16 * second - first) / 15, rtol=EXTRAPOLATED)


@pytest.mark.parametrize("name", ["smooth triangles", "propeller", "dart", "loop mixed torus", "doo_sabin mixed torus"])
def test_refinement_of_the_cage_leaves_the_area(name):
    surface = surface_named(name)
    refined = LimitSurface(surface.cage.refined(surface.scheme.name))
    np.testing.assert_allclose(refined.area(), surface.area(), rtol=EXACT)


@pytest.mark.core
def test_areas_turn_with_the_cage_and_grow_with_the_square_of_its_size(np_rng):
    cage = bumpy(cage_of("catmull_clark", "prism"))
    turn, _ = np.linalg.qr(np_rng.normal(size=(3, 3)))
    moved = cage.with_positions(3 * cage.positions @ turn + [1, 2, 3])
    np.testing.assert_allclose(LimitSurface(moved).area(), 9 * LimitSurface(cage).area(), rtol=EXACT)
    for scale in (1e-90, 1e-30, 1e30, 1e80):
        area = LimitSurface(cage.with_positions(scale * cage.positions)).area()
        assert area / scale / scale == pytest.approx(LimitSurface(cage).area(), rel=1e-12)
