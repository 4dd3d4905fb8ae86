import sys

import drjit as dr
import pytest
from mitsuba_subdivision.llvm import llvm_problem

# Sums of up to some tens of terms of order one.
SINGLE, DOUBLE = 2e-6, 1e-13


@pytest.fixture
def llvm():
    problem = llvm_problem()
    if problem:
        pytest.skip(problem)


@pytest.fixture(params=["Float", "Float64"])
def float_type(request, llvm):  # noqa: ARG001
    return getattr(sys.modules["drjit.llvm.ad"], request.param)


@pytest.fixture
def rounding(float_type):
    """What sums of these arrays lose."""
    return DOUBLE if dr.type_v(float_type) == dr.VarType.Float64 else SINGLE
