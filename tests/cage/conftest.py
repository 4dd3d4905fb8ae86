import numpy as np
import pytest
from mitsuba_subdivision.cage import ControlCage, named_cages

# A cube of mixed face sizes: the top is two triangles, two sides are joined to an L-shaped hexagon.
MIXED_FACES = [[0, 2, 3, 1], [4, 5, 7], [4, 7, 6], [3, 2, 6, 7], [0, 4, 6, 2], [1, 3, 7, 5, 4, 0]]

CAGES = {
    "cube": named_cages.cube,
    "tetrahedron": named_cages.tetrahedron,
    "torus": lambda: named_cages.torus(5, 4),
    "small torus": lambda: named_cages.torus(3, 3),
    "valence 3": lambda: named_cages.extraordinary(3),
    "valence 5": lambda: named_cages.extraordinary(5),
    "dome": lambda: named_cages.extraordinary(7, closed=False),
    "mixed faces": lambda: ControlCage(named_cages.cube().positions, MIXED_FACES),
    "one triangle": lambda: ControlCage(np.eye(3), [[0, 1, 2]]),
}


@pytest.fixture(params=CAGES)
def any_cage(request):
    return CAGES[request.param]()


@pytest.fixture
def obj_file(tmp_path):
    """Function that writes text or bytes to ``cube.obj`` and returns its path."""

    def write(text):
        path = tmp_path / "cube.obj"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write
