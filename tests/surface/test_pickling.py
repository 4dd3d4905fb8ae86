import copy
import pickle

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import named_cages


@pytest.mark.core
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
@pytest.mark.parametrize("scheme", ["catmull_clark", "doo_sabin"])
def test_copies_of_used_surfaces_are_the_same_surfaces(copied, scheme):
    surface = LimitSurface(named_cages.cube(), scheme)
    surface.tessellate(2)
    surface.cage.refined()
    _ = surface.cage.edges, surface.area(), surface.bounds(), surface.on_device("llvm_ad_rgb")
    other_surface, cage = copied(surface), copied(surface.cage)
    for other in (other_surface, LimitSurface(cage, scheme)):
        np.testing.assert_array_equal(other.evaluate(1, [[0.2, 0.3]]).p, surface.evaluate(1, [[0.2, 0.3]]).p)
