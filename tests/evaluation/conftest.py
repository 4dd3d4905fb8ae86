import pytest
from mitsuba_subdivision import LimitSurface
from reference.exact_samples import SCHEMES, ExactSamples, samples_at

# Both sides of the ordinary ones, even and odd; beyond, they differ in numbers only.
VALENCES = (*range(3, 9), 20, 50)


@pytest.fixture(params=[(s, n) for s in SCHEMES for n in VALENCES], ids=lambda p: f"{p[0]}-{p[1]}")
def exact(request) -> ExactSamples:
    return samples_at(*request.param)


@pytest.fixture
def surface(exact) -> LimitSurface:
    return LimitSurface(exact.cage, exact.scheme)
