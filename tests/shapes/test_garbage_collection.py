"""Python's garbage collector rests while a shape is made, and is as it was afterwards."""

import gc
import threading

import mitsuba as mi
import pytest
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.shapes import subdivision_shape
from mitsuba_subdivision.shapes.device_state import paused_collection

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")


@pytest.fixture
def seen_in_constructor(monkeypatch):
    """Whether the collector runs whenever a shape reads its parameters."""
    read_parameters, found = subdivision_shape.read_parameters, []

    def noted(props):
        found.append(gc.isenabled())
        return read_parameters(props)

    monkeypatch.setattr(subdivision_shape, "read_parameters", noted)
    return found


def test_rests_while_a_shape_is_made(seen_in_constructor):
    mi.load_dict({"type": "subdivision", **named_cages.cube().as_properties(mi)})
    assert seen_in_constructor == [False]
    assert gc.isenabled()


def test_runs_again_after_a_shape_that_is_refused(seen_in_constructor):
    with pytest.raises(RuntimeError, match="filename"):
        mi.load_dict({"type": "subdivision"})
    assert seen_in_constructor == [False]
    assert gc.isenabled()


def test_stays_off_where_it_was_off():
    gc.disable()
    try:
        mi.load_dict({"type": "subdivision", **named_cages.cube().as_properties(mi)})
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_runs_again_after_pauses_that_overlap():
    begun, ended = threading.Event(), threading.Event()

    @paused_collection()
    def longer():
        begun.set()
        ended.wait()

    thread = threading.Thread(target=longer)
    with paused_collection():
        thread.start()
        begun.wait()
    # The first pause is over, and the other, which began within it, leaves the collector as it is.
    ended.set()
    thread.join()
    assert gc.isenabled()
