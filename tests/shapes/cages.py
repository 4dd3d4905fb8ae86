"""The cube with tags and attributes, and shapes of cages."""

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.cage import Attribute, named_cages
from reference.refined_cages import tagged

# Around the top of the cube, of edges that are sharp and of semi-sharp ones.
RING = [(0, 1, 10), (1, 3, 10), (3, 2, 10), (2, 0, 10)]
# The cube with a top of two triangles, and two sides joined to an L-shaped hexagon.
MIXED_FACES = [[0, 2, 3, 1], [4, 5, 7], [4, 7, 6], [3, 2, 6, 7], [0, 4, 6, 2], [1, 3, 7, 5, 4, 0]]
# Texture coordinates of the cube: each face is an island.
ISLANDS = Attribute(np.tile([[0.0, 0], [1, 0], [1, 1], [0, 1]], (6, 1)), "face_varying")


def cube(**tags):
    return tagged(named_cages.cube(), **tags)


def described(cage, **parameters):
    return {"type": "subdivision", **cage.as_properties(mi), **parameters}


def load(cage, **parameters):
    return mi.load_dict(described(cage, **parameters))


def textured(**tags):
    """A cube with an island of texture coordinates on each face, turned and sheared."""
    islands = [[0, 0], [1, 0.2], [0.9, 1], [0.1, 0.8]]
    return cube(
        texcoords=Attribute(np.vstack([np.add(islands, [face, 0]) for face in range(6)]), "face_varying"), **tags
    )


def with_attributes(**tags):
    """A cube with an attribute of every interpolation, and an island of texture coordinates on each face."""
    rng = np.random.default_rng(0)
    attributes = {
        "colour": Attribute(rng.random((8, 3))),
        "weight": Attribute(rng.random((8, 1)), "varying"),
        "label": Attribute(rng.random((24, 1)), "face_varying", np.arange(24)[::-1]),
    }
    return cube(texcoords=ISLANDS, attributes=attributes, **tags)
