"""Copies of a domain: how often parameters are doubled, and that each copy has its parameters."""

import numpy as np
import pytest
from mitsuba_subdivision.kernels.array_types import ArrayTypes
from mitsuba_subdivision.kernels.locations import doublings, in_child
from mitsuba_subdivision.schemes import CatmullClark, Loop

MOST = 30
# Half a unit in the last place of one.
ROUNDED = 2.0**-24


@pytest.fixture
def types(float_type):
    return ArrayTypes(float_type)


def on_device(function, types, *numbers):
    """Results of a function for some numbers."""
    return [np.array(each) for each in function(*(types.floats(np.array(each)) for each in numbers))]


@pytest.mark.core
def test_doubled_so_often_a_number_is_between_a_half_and_one(types, np_rng):
    powers = 2.0 ** -np.arange(MOST + 10)
    # Rounding to single precision must not reach the next power of two.
    x = np.concatenate([powers, powers * (1 - 2.0**-23), np_rng.random(50) * powers[np_rng.integers(0, 40, 50)]])
    x = x.astype(np.float32).astype(np.float64)
    count, power = on_device(lambda x: doublings(types, x, types.index(MOST)), types, x.tolist())
    np.testing.assert_array_equal(power, 2.0**count)
    is_far = x * 2.0**MOST >= 0.5
    assert ((x * power >= 0.5) & (x * power <= 1))[is_far].all()
    assert (count[~is_far] == MOST).all()
    # What rounding takes beyond the domain is not doubled.
    assert on_device(lambda x: doublings(types, x, types.index(MOST)), types, [1, 1 + 2.0**-20])[0].tolist() == [0, 0]


@pytest.mark.parametrize("scheme", [CatmullClark(), Loop()])
def test_parameters_of_a_copy_lead_back_and_the_first_is_for_small_ones_only(scheme, types, np_rng):
    domain = scheme.domain
    uv = np_rng.random((200, 2))
    uv = np.concatenate([uv, np.round(4 * uv) / 4])
    uv = uv[domain.extent(uv) <= 1].astype(np.float32).astype(np.float64)
    number, u, v, scale = on_device(lambda u, v: in_child(domain, types, u, v), types, *uv.T.tolist())
    for k, child in enumerate(domain.children):
        of_child = number == k
        np.testing.assert_allclose(child(uv[of_child]), np.stack([u, v], axis=1)[of_child], rtol=0, atol=ROUNDED)
        np.testing.assert_array_equal(np.broadcast_to(scale, len(uv))[of_child], child.matrix[0, 0])
    assert min(map(np.min, domain.edge_distances(u, v))) >= -ROUNDED
    assert (number[domain.extent(uv) >= 0.5] != 0).all()
