"""Fixtures for kernels."""

import sys

import pytest
from mitsuba_subdivision.llvm import llvm_problem


@pytest.fixture(params=["Float", "Float64"])
def float_type(request):
    """Flat arrays of either precision."""
    problem = llvm_problem()
    if problem:
        pytest.skip(problem)
    return getattr(sys.modules["drjit.llvm.ad"], request.param)
