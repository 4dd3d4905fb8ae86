import pytest
from mitsuba_subdivision import LimitSurface
from reference.exact_samples import SCHEMES, ExactSamples, samples_at

# Both sides of the ordinary ones, even and odd; beyond, they differ in numbers only.
CASES = [(scheme, valence) for scheme in SCHEMES for valence in (*range(3, 9), 20)]
CASES += [pytest.param((scheme, 50), marks=pytest.mark.long) for scheme in SCHEMES]


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def exact(request) -> ExactSamples:
    return samples_at(*request.param)


@pytest.fixture
def surface(exact) -> LimitSurface:
    return LimitSurface(exact.cage, exact.scheme)
