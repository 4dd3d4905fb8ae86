from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest
from mitsuba_subdivision.mesh.shared import Content, shared_by_key

THREADS = 4
# Seconds, by far more than threads take to begin.
LIMIT = 20


class _Value:
    pass


@pytest.fixture
def pool():
    with ThreadPoolExecutor(THREADS) as pool:
        yield pool


def test_values_of_different_keys_are_made_at_the_same_time(pool):
    all_make = Barrier(THREADS)

    def make():
        all_make.wait(LIMIT)
        return _Value()

    assert len(set(pool.map(lambda key: shared_by_key(key, make), range(THREADS)))) == THREADS


def test_concurrent_requests_make_a_value_once(pool):
    all_request, made = Barrier(THREADS), []

    def make():
        made.append(_Value())
        return made[-1]

    def request(_):
        all_request.wait(LIMIT)
        return shared_by_key("key", make)

    assert {*pool.map(request, range(THREADS))} == {*made}
    assert len(made) == 1


def test_a_value_is_kept_while_it_is_referenced():
    value = shared_by_key("key", _Value)
    assert shared_by_key("key", _Value) is value
    del value
    other = _Value()
    assert shared_by_key("key", lambda: other) is other


def test_failed_values_are_tried_again():
    with pytest.raises(ZeroDivisionError):
        shared_by_key("key", lambda: 1 // 0)
    value = _Value()
    assert shared_by_key("key", lambda: value) is value


def test_values_may_depend_on_other_values():
    inner = _Value()
    assert shared_by_key("outer", lambda: shared_by_key("inner", lambda: inner)) is inner


def test_arrays_of_equal_values_type_and_shape_are_equal_keys():
    array = np.arange(6)
    same, copied = Content(array), Content(array.copy())
    assert same == copied
    assert hash(same) == hash(copied)
    for other in (array + 1, array.reshape(2, 3), array.astype(np.uint64), array[:5], None):
        assert same != Content(other)
    # Bits of a number are those of another of another type.
    assert Content(np.zeros(3)) != Content(np.zeros(3, np.int64))
    assert Content(None) == Content(None)
    assert same != hash(same)
