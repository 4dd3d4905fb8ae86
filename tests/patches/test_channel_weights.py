import numpy as np
import pytest
from kernels.surfaces import grid_locations
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.cage.contents import Attribute
from mitsuba_subdivision.patches import channel
from mitsuba_subdivision.patches.channel import Channel
from patches.closed_cages import mixed_torus, tetrahedron, torus
from reference.refined_cages import refine_first, tagged

# Sums of some tens of terms of order one, in double precision.
ROUNDING = 1e-13


def with_attributes(cage, rng, **options):
    """Every interpolation, with a seam around the first face."""
    corners, count = len(cage.face_vertices), cage.vertex_count
    of_first = np.arange(corners) < cage.face_sizes[0]
    attributes = {
        "vertex": Attribute(rng.random((count, 3))),
        "varying": Attribute(rng.random((count, 2)), "varying"),
        "seam": Attribute(rng.random((2 * count, 2)), "face_varying", cage.face_vertices + count * of_first),
        "smooth": Attribute(rng.random((count, 1)), "face_varying", cage.face_vertices),
        "islands": Attribute(rng.random((corners, 1)), "face_varying"),
    }
    return tagged(cage, attributes=attributes, **options)


CAGES = {
    "quadrilaterals": (named_cages.cube, {"creases": [(0, 1, 10), (1, 3, 10), (3, 2, 2.5)]}),
    "polygons": (mixed_torus, {}),
    "linear": (mixed_torus, {"face_varying": "all"}),
    "boundary": (lambda: named_cages.extraordinary(7, closed=False), {}),
    "triangles": (tetrahedron, {}),
}


@pytest.mark.core
@pytest.mark.parametrize("refines", [False, True], ids=["plain", "refined"])
@pytest.mark.parametrize("name", CAGES)
def test_values_are_weights_times_the_cages(name, refines, np_rng, monkeypatch):
    if refines:
        refine_first(monkeypatch)
    made, options = CAGES[name]
    surface = LimitSurface(with_attributes(made(), np_rng, **options), "loop" if name == "triangles" else None)
    start, uv = grid_locations(surface, 4)
    for attribute in surface.attribute_names:
        channel = surface.channel(attribute)
        weights = channel.weights(start, uv)
        assert weights.shape == (len(start), len(channel.values))
        assert channel.weights(start[:0], uv[:0]).shape == (0, len(channel.values))
        np.testing.assert_allclose(weights @ channel.values, channel.evaluate(start, uv), rtol=0, atol=ROUNDING)
        np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=0, atol=ROUNDING)


def test_values_of_doo_sabin_are_weights_times_the_cages(np_rng):
    cage = torus(5, 4)
    surface = LimitSurface(tagged(cage, attributes={"heat": np_rng.random((cage.vertex_count, 1))}), "doo_sabin")
    channel, locations = surface.channel("heat"), grid_locations(surface, 3)
    weights = channel.weights(*locations)
    np.testing.assert_allclose(weights @ channel.values, channel.evaluate(*locations), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("mode", ["corners_only", "corners_plus1", "corners_plus2", "boundaries"])
@pytest.mark.parametrize("name", ["quadrilaterals", "boundary", "triangles"])
def test_values_of_separated_faces_are_linear(name, mode, np_rng, monkeypatch):
    """As their subdivision has it, which is the other path."""
    made, options = CAGES[name]
    cage = with_attributes(made(), np_rng, face_varying=mode, **options)
    surface = LimitSurface(cage, "loop" if name == "triangles" else None)
    start, uv = grid_locations(surface, 4)
    direct = surface.channel("islands")
    assert direct.layout.is_linear
    assert not surface.channel("seam").layout.is_linear
    monkeypatch.setattr(channel, "_is_cut_into_faces", lambda *_: False)
    layout = channel._layout_of("islands", cage.attributes["islands"], cage, surface.scheme, surface.patches)
    assert not layout.is_linear
    subdivided = Channel(layout, direct.values)
    np.testing.assert_allclose(direct.evaluate(start, uv), subdivided.evaluate(start, uv), rtol=0, atol=ROUNDING)


def test_values_of_separated_faces_are_subdivided_under_nonlinear_schemes(np_rng):
    """Without corners there, and around the middle of polygons."""
    polygons = with_attributes(mixed_torus(), np_rng)
    for cage in (with_attributes(named_cages.cube(), np_rng, face_varying="none"), polygons):
        assert not LimitSurface(cage).channel("islands").layout.is_linear
