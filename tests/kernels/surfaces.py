"""Surfaces with all kinds of pieces, and locations on them."""

from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import numpy as np
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.device_arrays import upload
from patches.closed_cages import bumpy, cage_of, extraordinary_face, extraordinary_triangles, trapezohedron
from peers.fidelity_cages import book
from reference.refined_cages import half_disc, sheet, spokes, tagged, upper_half

CAGES = Path(__file__).parents[2] / "scenes/cages"
INFINITE = 10.0
RING = ((4, 5), (5, 7), (7, 6), (6, 4))
UNEQUAL = [(a, b, s) for (a, b), s in zip(RING, (0.4, 1.3, 2.2, 4), strict=True)]
SURFACES = {
    "torus": ("catmull_clark", lambda: cage_of("catmull_clark", "torus")),
    "cube": ("catmull_clark", cube),
    "mixed torus": ("catmull_clark", lambda: cage_of("catmull_clark", "mixed torus")),
    "hexagon": ("catmull_clark", lambda: cage_of("catmull_clark", "hexagon")),
    "valence 2": ("catmull_clark", lambda: cage_of("catmull_clark", "valence 2 beside triangle")),
    "valence 3": ("catmull_clark", lambda: extraordinary(3)),
    "valence 50": ("catmull_clark", lambda: extraordinary(50, closed=False)),
    "face of 20": ("catmull_clark", lambda: extraordinary_face(20)),
    "smooth triangles": ("catmull_clark", lambda: tagged(cage_of("catmull_clark", "prism"), triangle_rule="smooth")),
    "sheet": ("catmull_clark", lambda: sheet(4, 3)),
    "sheet without corners": ("catmull_clark", lambda: sheet(3, 2, boundary="edge_only")),
    "boundary none": ("catmull_clark", lambda: sheet(4, 4, boundary="none")),
    "half disc of 6": ("catmull_clark", lambda: half_disc(6)),
    "holes": ("catmull_clark", lambda: tagged(cage_of("catmull_clark", "mixed torus"), holes=[0, 3])),
    "non-manifold": ("catmull_clark", lambda: book(3)),
    "dart": ("catmull_clark", lambda: spokes(extraordinary(5, closed=False), 5, (INFINITE,))),
    "crease": ("catmull_clark", lambda: spokes(trapezohedron(6), 6, (INFINITE, 0, INFINITE))),
    "corner": ("catmull_clark", lambda: spokes(extraordinary(8, closed=False), 8, (INFINITE,) * 3)),
    "into a dart": ("catmull_clark", lambda: spokes(extraordinary(5, closed=False), 5, (INFINITE, 1.5))),
    "semi-sharp ring": ("catmull_clark", lambda: tagged(cube(), creases=[(a, b, 4) for a, b in RING])),
    # Divided along the edge, and no vertex is extraordinary.
    "semi-sharp torus": ("catmull_clark", lambda: tagged(cage_of("catmull_clark", "torus"), creases=[(0, 1, 1.5)])),
    "chaikin": ("catmull_clark", lambda: tagged(cube(), creases=UNEQUAL, corners=[(0, 2.4)], crease_method="chaikin")),
    "rook": ("catmull_clark", lambda: ControlCage.from_file(CAGES / "rook.obj")),
    "propeller": ("catmull_clark", lambda: ControlCage.from_file(CAGES / "propeller.obj")),
    "loop mixed torus": ("loop", lambda: cage_of("loop", "mixed torus")),
    "loop valence 3": ("loop", lambda: extraordinary_triangles(3)),
    "loop valence 50": ("loop", lambda: upper_half(extraordinary_triangles(50))),
    "loop sheet": ("loop", lambda: sheet(3, 3, triangles=True, boundary="edge_only")),
    "loop half disc of 6": ("loop", lambda: half_disc(6)),
    "loop corner": ("loop", lambda: spokes(upper_half(extraordinary_triangles(5)), 5, (0.5, 1.5, INFINITE))),
    "doo_sabin mixed torus": ("doo_sabin", lambda: cage_of("doo_sabin", "mixed torus")),
    "doo_sabin face of 50": ("doo_sabin", lambda: extraordinary_face(50)),
    "doo_sabin sheet": ("doo_sabin", lambda: sheet(4, 4)),
}
# One for each kind of piece and of border, for what takes long on all of them.
KINDS = (
    *("torus", "valence 50", "smooth triangles", "half disc of 6", "non-manifold", "corner", "semi-sharp ring"),
    *("chaikin", "propeller", "loop mixed torus", "loop sheet", "loop corner", "doo_sabin mixed torus"),
    "doo_sabin sheet",
)
# No element beside these holes has corners of its own.
HOLES = {
    "hole in a cube": ("catmull_clark", lambda: tagged(cube(), holes=[1])),
    "loop hole": ("loop", lambda: tagged(extraordinary_triangles(5), holes=[1])),
}


@lru_cache
def surface_named(name):
    """One of `SURFACES` and `HOLES`, the same object whenever it is asked for."""
    scheme, cage = (SURFACES | HOLES)[name]
    # What is flat needs bumps to have normals that can be wrong. Faces around a vertex of valence 50 are narrow.
    return LimitSurface(bumpy(cage(), size=0.2 if "sheet" in name or "disc" in name else 0.01), scheme)


@lru_cache
def kernel_named(name, variant):
    return surface_named(name).on_device(variant)


def grid_locations(surface, segments):
    """A grid of parameters on every patch, and the corner of an element that each is seen from."""
    elements, domain = surface.patches.elements, surface.scheme.domain
    j, i = np.indices((segments + 1, segments + 1)).reshape(2, -1)
    inside = i + j <= segments if domain.corner_count == 3 else np.full(len(i), True)
    uv = np.stack([i, j], axis=1)[inside] / segments
    corner = np.arange(elements.half_edge_count)
    is_first = corner == elements.face_offsets[elements.face[corner]]
    starts = corner[is_first | ~surface.patches.is_whole[elements.face[corner]]]
    return np.repeat(starts, len(uv)), np.tile(uv, (len(starts), 1))


def random_locations(surface, rng, count, deepest=23):
    """Element, parameters and corner: all over the elements, and down to 2^-deepest at every corner."""
    elements, domain = surface.patches.elements, surface.scheme.domain
    element = rng.choice(np.flatnonzero(elements.face_sizes), count)
    corner = rng.integers(0, elements.face_sizes[element])
    uv = rng.dirichlet(np.ones(domain.corner_count), count) @ domain.corners
    uv *= 2.0 ** -np.where(rng.random(count) < 0.5, 0, rng.integers(0, deepest, count))[:, None]
    # As single precision has them.
    return element, uv.astype(np.float32).astype(np.float64), corner


def on_device(types, element, uv, corner):
    """The arguments of `SurfaceKernel.evaluate`."""
    return types.indices(element), upload(types.vector2, uv), types.indices(corner)


def vectors(array):
    return np.array(dr.detach(array)).T.astype(np.float64)


def computed(results):
    dr.eval(results)
    return results


def hit(kernel, o, d, *start):
    ray = SimpleNamespace(o=upload(kernel.types.vector3, o), d=upload(kernel.types.vector3, d))
    return computed(kernel.intersect(ray, *on_device(kernel.types, *start)))


def aimed(surface, rng, count, *, steep=0.3, near=0.05, deepest=4):
    """Rays at points of the surface, which are not too flat there, and places near these points to begin at."""
    element, uv, corner = random_locations(surface, rng, count, deepest)
    target = surface.evaluate(element, uv, corner)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    kept = np.abs((d * target.n).sum(axis=1)) > steep
    domain, start = surface.scheme.domain, uv + rng.uniform(-near, near, uv.shape)
    start += np.maximum(-start, 0)
    beyond = np.maximum(domain.extent(start) - 1, 0)[:, None]
    start = np.clip(start - beyond, 0, 1)
    o, d = target.p - rng.uniform(0.5, 3, (count, 1)) * d, rng.uniform(0.5, 2, (count, 1)) * d
    return target.p[kept], o[kept], d[kept], [values[kept] for values in (element, start, corner)]


def derivatives_both_ways(outputs_of, inputs, changes, rng, rounding):
    """Changes of outputs by those of inputs, as ``(n, k)`` numbers; reverse mode has to be of the same linear map."""
    dr.enable_grad(inputs)
    outputs = outputs_of(*inputs)
    dr.set_grad(inputs, changes)
    dr.enqueue(dr.ADMode.Forward, *inputs)
    dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearNone)
    forward = [np.array(gradient).T for gradient in computed([dr.grad(output) for output in outputs])]
    dr.clear_grad(inputs)
    outputs, seeds = outputs_of(*inputs), [rng.normal(size=derivative.shape) for derivative in forward]
    for output, seed in zip(outputs, seeds, strict=True):
        dr.set_grad(output, upload(type(output), seed))
    dr.enqueue(dr.ADMode.Backward, *outputs)
    dr.traverse(dr.ADMode.Backward)
    gradients = computed([dr.grad(value) for value in inputs])
    products = np.concatenate([(f * s).ravel() for f, s in zip(forward, seeds, strict=True)])
    product = sum((np.array(c) * np.array(g)).sum() for c, g in zip(changes, gradients, strict=True))
    assert abs(product - products.sum()) <= rounding * np.abs(products).sum()
    return forward
