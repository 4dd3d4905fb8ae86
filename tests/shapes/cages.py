"""The cube with tags and attributes, and shapes of cages."""

import mitsuba as mi
import numpy as np
from mitsuba_subdivision import upload
from mitsuba_subdivision.cage import Attribute, named_cages
from reference.refined_cages import tagged

# Around the top of the cube, of edges that are sharp and of semi-sharp ones.
RING = [(0, 1, 10), (1, 3, 10), (3, 2, 10), (2, 0, 10)]
# Places a shape, which it shears.
SHEARED = np.array([[1.2, 0.3, 0.0, 2.0], [0.0, 0.7, 0.2, -1.0], [0.1, 0.0, 1.5, 0.5], [0, 0, 0, 1]])
MIRRORED = np.diag([-1, 1, 1, 1]) @ SHEARED
# Texture coordinates of the cube: each face is an island.
ISLANDS = Attribute(np.tile([[0.0, 0], [1, 0], [1, 1], [0, 1]], (6, 1)), "face_varying")


def cube(**tags):
    return tagged(named_cages.cube(), **tags)


def described(cage, **parameters):
    rate = {} if "tessellation" in parameters else {"tessellation_rate": 4}
    return {"type": "subdivision", **cage.as_properties(mi), **rate, **parameters}


def load(cage, **parameters):
    return mi.load_dict(described(cage, **parameters))


def textured(**tags):
    """A cube with an island of texture coordinates on each face, turned and sheared."""
    values = np.vstack([np.add([[0, 0], [1, 0.2], [0.9, 1], [0.1, 0.8]], [face, 0]) for face in range(6)])
    return cube(texcoords=Attribute(values, "face_varying"), **tags)


def with_attributes(cage, seed=0, **tags):
    """Random values of every interpolation, with seams; each face is an island of texture coordinates."""
    rng, corners, count = np.random.default_rng(seed), cage.face_vertices, cage.vertex_count
    angles = np.concatenate([2 * np.pi * np.arange(size) / size for size in cage.face_sizes])
    islands = 0.5 + 0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1) + 0.04 * rng.random((len(corners), 2))
    # Two values for each vertex, of which the first face takes the other.
    rows = corners + count * (np.arange(len(corners)) >= cage.face_sizes[0])
    attributes = {
        "colour": Attribute(rng.random((count, 3))),
        "weight": Attribute(rng.random((count, 1)), "varying"),
        "label": Attribute(rng.random((2 * count, 1)), "face_varying", rows),
    }
    given = {"texcoords": Attribute(islands, "face_varying"), "attributes": attributes}
    return tagged(cage, **{"creases": cage.tags.creases(cage.topology), **given, **tags})


def bitmap(image, **more):
    return {"type": "bitmap", "data": upload(mi.TensorXf, image), "raw": True, **more}
