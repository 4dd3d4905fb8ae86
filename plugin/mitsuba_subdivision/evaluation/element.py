"""Points, derivatives, normals and curvature at any parameters of elements, and their limit stencils."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import IntArray, Topology
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..schemes import SchemeError, scheme_named
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .eigenbasis import eigenbasis
from .equations import Evaluator, child_rows, times_powers
from .irregular_patch import IrregularPatch
from .located_samples import LocatedSamples, frame_magnitude, without_collapsed
from .normals import unit_normals
from .patch_tree import isolated_signature, patch_tree
from .refined_rings import refined_children

# Curvature near an extraordinary point goes with (|λ_4| / λ_2²)ⁿ. A ratio nearer to one than this counts as one.
CONSTANT = 1e-9


@dataclass(frozen=True, eq=False)
class ElementSamples:
    """Values and derivatives at samples."""

    values: FloatArray  # (3 or 6, s, x): the value; by u and v; by uu, uv and vv if requested
    # (s, 3) unit normals. Zero where the surface has none, but not in the published forms "power" and "stam". Not a
    # number where values are no points in space.
    normal: FloatArray
    level: NDArray[np.int64]  # (s,)
    curvature: FloatArray  # (2, s) Gaussian and mean; not a number unless requested

    @classmethod
    def empty(cls, count: int, width: int, dtype: DTypeLike, derivatives: int) -> ElementSamples:
        """Samples without values yet."""
        return cls(
            np.empty((3 if derivatives == 1 else 6, count, width), dtype=dtype),
            np.empty((count, 3), dtype=dtype),
            np.empty(count, dtype=np.int64),
            np.empty((2, count), dtype=dtype),
        )

    def put(self, at: IntArray, some: ElementSamples) -> None:
        """Put some samples in the rows ``at``."""
        self.values[:, at], self.normal[at] = some.values, some.normal
        self.level[at], self.curvature[:, at] = some.level, some.curvature


def evaluate_samples(
    located: LocatedSamples,
    # list of (m, K, x) float64: control points of the samples of each element, in arrays that may be changed.
    # They are rounded to the type of the evaluation.
    points: list[FloatArray],
    extent: FloatArray,  # (x,) float64: bound of the extent of an element's control points along each axis
    # The stabilised and the limit form take one control point of the element as the origin, so their precision
    # does not depend on where the model stands. The others are as published.
    evaluator: Evaluator,
    dtype: DTypeLike,  # Of all arithmetic
    derivatives: int,
) -> ElementSamples:
    """Evaluate samples of any elements."""
    count, has_origin = len(located.leaf_sample), evaluator not in ("power", "stam")
    # Samples are along the last axis, as operations along rows of three would be slow.
    origin: FloatArray = np.zeros((len(extent), count), dtype=dtype)
    points = [own.astype(dtype, copy=False) for own in points]
    if has_origin:
        origin = np.concatenate([own[:, 0] for own in points]).T
        for of_element in points:
            np.subtract(of_element, of_element[:, :1].copy(), out=of_element)
    rows = located.rows(evaluator, dtype, derivatives)
    values = _times_points(located.weights([each.rows for each in rows], power=evaluator == "power"), points)
    curvature = np.full((2, count), np.nan, dtype=dtype)
    if derivatives == 2 and len(extent) == 3:
        curvature = _curvature(located, values, points, evaluator)
    values[0] += origin
    jacobian, scale = located.jacobian.astype(dtype, copy=False), located.per_sample([r.derivative_scale for r in rows])
    tangents = _by_uv(values[1:3], jacobian)
    # At levels far beyond any that float32 can hold, the scale overflows.
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        values[1:3] = tangents * scale[0]
        if derivatives == 2:
            values[3:] = _second_by_uv(values[3:], jacobian) * scale[1]
    normal: FloatArray = np.full((3, count), np.nan, dtype=dtype)
    # Only points in space have normals; texture coordinates, for example, have none.
    if len(extent) == 3:
        framed = np.flatnonzero(located.per_sample([np.full(len(r.level), r.frame is not None) for r in rows]))
        if len(framed):
            some, some_points = located.chosen(framed), _chosen(points, located, framed)
            frames = some.weights([each.tangents for each in some.rows(evaluator, dtype, 1)])
            tangents[..., framed] = _by_uv(_times_points(frames, some_points), jacobian[..., framed])
        if has_origin:
            magnitude = located.per_sample([frame_magnitude(*each) for each in zip(located.leaves, rows, strict=True)])
            magnitude = _by_uv(magnitude, np.abs(jacobian))
            normal = unit_normals(tangents, magnitude, extent.astype(dtype)[:, None])
            suspect = np.flatnonzero(~normal.any(axis=0))
            if len(suspect):
                own_extent = np.concatenate([np.abs(each).max(axis=1) for each in _chosen(points, located, suspect)])
                normal[:, suspect] = unit_normals(tangents[..., suspect], magnitude[:, suspect], own_extent.T)
                curvature[:, ~normal.any(axis=0)] = np.nan
        else:
            normal = unit_normals(tangents)
    level = located.per_sample([each.level for each in rows])
    return ElementSamples(values.swapaxes(1, 2), normal.T, level, curvature)


def element_stencils(
    scheme: Scheme,
    signature: Signature,
    uv: FloatArray,  # (s, 2) float64: with (0, 0) at the sample's corner
    corner: IntArray | None = None,  # (s,) int64: by default the first corner
) -> FloatArray:
    """Limit stencils of samples over an element's one-ring.

    Returns
    -------
    (3, s, K) float64, read-only
        Weights of the point, which sum to one, and of two tangents, which sum to zero. The cross product of the
        tangents is along the normal, at extraordinary points too. Away from these, and from borders and sharp features,
        they are the derivatives, times a positive factor for each sample. They are zero where the surface is folded
        whatever the control points are.
    """
    uv = np.asarray(uv, dtype=np.float64)
    corner = np.zeros(len(uv), dtype=np.int64) if corner is None else corner
    located = LocatedSamples(scheme, [patch_tree(scheme, signature)], np.zeros(len(uv), dtype=np.int64), uv, corner)
    rows = located.rows("stabilized", np.float64, 1)
    magnitude = located.per_sample([frame_magnitude(*each) for each in zip(located.leaves, rows, strict=True)])
    (weights,) = located.weights([np.concatenate([each.rows[:1], each.tangents]) for each in rows])
    stencils = np.ascontiguousarray(weights.swapaxes(0, 1))
    stencils[1:] = _by_uv(stencils[1:].swapaxes(1, 2), located.jacobian).swapaxes(1, 2)
    without_collapsed(stencils[1:], _by_uv(magnitude, np.abs(located.jacobian)))
    stencils.flags.writeable = False
    return stencils


def derivative_stencils(
    scheme: Scheme, signature: Signature, uv: FloatArray, corner: IntArray, derivatives: int
) -> FloatArray:
    """Weights of points and derivatives over an element's one-ring.

    Returns (3 or 6, s, K) float64: the point; derivatives by u and v; those by uu, uv and vv, as `evaluate_samples`
    computes them.
    """
    located = LocatedSamples(scheme, [patch_tree(scheme, signature)], np.zeros(len(uv), dtype=np.int64), uv, corner)
    rows = located.rows("stabilized", np.float64, derivatives)
    (weights,) = located.weights([each.rows for each in rows])
    found, scale = weights.transpose(1, 2, 0), located.per_sample([each.derivative_scale for each in rows])
    found[1:3] = _by_uv(found[1:3], located.jacobian) * scale[0]
    if derivatives == 2:
        found[3:] = _second_by_uv(found[3:], located.jacobian) * scale[1]
    return found.swapaxes(1, 2)


def _times_points(weights: list[FloatArray], points: list[FloatArray]) -> FloatArray:
    """``(d, x, s)`` weights ``(m, d, K)`` of each element's samples times their control points ``(m, K, x)``."""
    return np.concatenate(
        [(own.astype(of.dtype, copy=False) @ of).transpose(1, 2, 0) for own, of in zip(weights, points, strict=True)],
        axis=2,
    )


def _chosen(points: list[FloatArray], located: LocatedSamples, which: IntArray) -> list[FloatArray]:
    """Control points ``(m, K, x)`` of some samples, in increasing order, for each element."""
    slices = [*located.slices()]
    ends = np.searchsorted(which, [at.stop for at in slices])
    own = np.split(which, ends[:-1])
    return [of[samples - at.start] for of, samples, at in zip(points, own, slices, strict=True)]


def _curvature(
    located: LocatedSamples, values: FloatArray, points: list[FloatArray], evaluator: Evaluator
) -> FloatArray:
    """``(2, s)`` Gaussian and mean curvature; ``values`` ``(6, 3, s)`` have derivatives by parameters of leaves."""
    derivatives = values[1:].swapaxes(1, 2)
    found = curvature(derivatives[:2], derivatives[2:])
    for leaves in located.leaves if evaluator == "stabilized" else ():
        if leaves.patch is None:
            continue
        which = np.flatnonzero(located.is_in(leaves))
        some, size = located.chosen(which), len(leaves.patch.basis.eigenvalues)
        each_one = np.repeat(np.eye(size)[:, None], len(which), axis=1)
        weights, of = some.weights([each_one]), _chosen(points, located, which)
        coordinates = np.concatenate([own.astype(x.dtype, copy=False) @ x for own, x in zip(weights, of, strict=True)])
        found[:, which] = irregular_curvature(leaves.patch, some.leaf_uv, coordinates, np.arange(len(which)))
    return found


def _by_uv(tangents: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Derivatives ``(2, .., s)`` by parameters of leaves, turned into those by the samples' own (u, v)."""
    (a, b), (c, d) = jacobian
    u, v = tangents
    return np.stack([a * u + c * v, b * u + d * v])


def _second_by_uv(second: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Second derivatives ``(3, x, s)`` by a leaf's parameters, turned into those by the samples' own (u, v)."""
    (ss, st, tt), ((a, b), (c, d)) = second, jacobian
    return np.stack(
        [
            ss * (i * k) + st * (i * m + k * j) + tt * (j * m)
            for (i, j), (k, m) in (((a, c), (a, c)), ((a, c), (b, d)), ((b, d), (b, d)))
        ]
    )


def curvature(
    first: FloatArray,  # (2, s, 3): derivatives by u, by v
    second: FloatArray,  # (3, s, 3): by uu, uv, vv
) -> FloatArray:
    """Curvatures from the fundamental forms.

    Returns (2, s): Gaussian and mean, the latter positive where the surface bends towards ``du x dv``.
    """
    du, dv = first
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        a, b, c = _dot(du, du), _dot(du, dv), _dot(dv, dv)
        normal = unit_normals(first.swapaxes(1, 2)).T
        e, f, g = (_dot(row, normal) for row in second)
        area = a * c - b * b
        return np.stack([(e * g - f * f) / area, (e * c - 2 * f * b + g * a) / (2 * area)])


def irregular_curvature(
    patch: IrregularPatch,
    uv: FloatArray,  # (s, 2) float64: parameters in the patch
    coordinates: FloatArray,  # (e, K, 3): eigen-coordinates of every element
    which: IntArray,  # (s,) int64: element of each sample
) -> FloatArray:
    """Curvatures in an irregular patch, relative to the frame of its limit normal.

    Near the extraordinary point second derivatives are almost tangential, and rounding drowns their small part along
    the normal. So coordinates in the limit tangent plane and heights over it are summed apart. The coordinates go with
    powers of λ_2 and the heights with powers of λ_4, as the eigenvectors of λ_2 and λ_3 have no height at all. Every
    term of the second fundamental form has one height as a factor, so its power comes out in front.

    Returns (2, s): Gaussian and mean. At the extraordinary point itself 0 where the curvature vanishes there, else not
    a number.
    """
    level, rows = child_rows(patch.scheme, uv, patch.eigen_children.astype(coordinates.dtype), 2)
    largest, second_largest = patch.basis.subdominant, float(patch.basis.moduli[3])
    frame = _orthonormal_frames(coordinates)
    local = np.einsum("ekx,exf->ekf", coordinates, frame)
    local[:, :3, 2] = 0

    in_plane = times_powers(rows, level, patch.basis, largest)
    heights = times_powers(rows, level, patch.basis, second_largest)
    x, y = (np.einsum("dsk,sk->ds", in_plane, local[which, :, axis]) for axis in (0, 1))
    z = np.einsum("dsk,sk->ds", heights, local[which, :, 2])

    growth = second_largest / largest**2
    real = coordinates.dtype.type
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        # In units of λ_2ⁿ in the tangent plane and of λ_4ⁿ across it. The relief is the ratio of the two.
        relief = real(second_largest / largest) ** level.astype(real)
        normal = np.stack([y[1] * z[2] - z[1] * y[2], z[1] * x[2] - x[1] * z[2], x[1] * y[2] - y[1] * x[2]])
        e, f, g = normal[0] * x[3:] + normal[1] * y[3:] + normal[2] * z[3:]
        a, b, c = (x[i] * x[j] + y[i] * y[j] + relief**2 * z[i] * z[j] for i, j in ((1, 1), (1, 2), (2, 2)))
        area = relief**2 * (normal[0] ** 2 + normal[1] ** 2) + normal[2] ** 2
        power = real(growth) ** level.astype(real)
        gaussian = power**2 * (e * g - f * f) / area**2
        mean = power * (e * c - 2 * f * b + g * a) / (2 * area**1.5)
    found = np.stack([gaussian, mean])
    found[:, patch.scheme.domain.extent(uv) == 0] = 0 if growth < 1 - CONSTANT else np.nan
    return found


def _orthonormal_frames(coordinates: FloatArray) -> FloatArray:
    """Orthonormal frames ``(e, 3, 3)``: in columns, two tangents at the extraordinary point and the normal."""
    first = coordinates[:, 1]
    normal = unit_normals(coordinates[:, 1:3].transpose(1, 2, 0)).T
    with np.errstate(invalid="ignore", divide="ignore"):
        along = first / np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([along, np.cross(normal, along), normal], axis=2)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.einsum("sx,sx->s", a, b)


class LimitStencil(NamedTuple):
    """Weights over the one-ring of an extraordinary point amid regular faces and vertices.

    For a vertex, over the centre, the edge ring and the face ring, counter-clockwise; the face ring's vertex i lies
    between the edge ring's i and i + 1, and it is empty where faces are triangles. For a face of a vertex-based scheme,
    over its vertices, counter-clockwise.

    Attributes
    ----------
    position : (m,) float64
        Sums to one.
    tangents : (2, m) float64
        Sum to zero. Weights on the edge ring, or the face's vertices, are ``cos(2 pi i / n)`` and ``sin(2 pi i / n)``;
        the cross product of the two tangents points outward.
    """

    position: FloatArray
    tangents: FloatArray


def limit_stencil(scheme: str, valence: int) -> LimitStencil:
    """Weights over a one-ring that make its limit point and two tangents: left eigenvectors of its subdivision matrix.

    Parameters
    ----------
    scheme : str
    valence : int
        Of a vertex amid regular faces (true after one refinement of any cage); for Doo-Sabin, corners of a face amid
        regular vertices. At least 3.

    Returns
    -------
    LimitStencil

    Raises
    ------
    SchemeError
        If the scheme is unknown, or the valence no integer or below 3.
    """
    rules = scheme_named(scheme)
    if not isinstance(valence, (int, np.integer)):
        raise SchemeError(f"limit stencil of valence {valence!r}: expected an integer")
    if valence < 3:
        raise SchemeError(f"limit stencil of valence {valence}: expected 3 or more")
    signature = isolated_signature(rules, valence)
    topology = one_ring(signature).topology
    if rules.element == "face":
        slots, ring = _vertex_ring(topology, valence)
    else:
        slots = ring = topology.face_vertices[:valence].tolist()
    basis = eigenbasis(refined_children(rules, signature)[0][2])

    angles = 2 * np.pi * np.arange(valence) / valence
    target = np.stack([np.cos(angles), np.sin(angles)])
    plane = basis.inverse[1:3]
    # The eigenvectors span the plane of the first Fourier mode; take the pair that is cosine and sine on the ring.
    combination = target @ plane[:, ring].T @ np.linalg.inv(plane[:, ring] @ plane[:, ring].T)
    return LimitStencil(basis.inverse[0, slots], (combination @ plane)[:, slots])


def _vertex_ring(topology: Topology, valence: int) -> tuple[list[int], list[int]]:
    """Vertices of the stencil at vertex 0 of a one-ring, and those of them that are its edge ring."""
    half_edge, edge_ring, face_ring = 0, [], []
    for _ in range(valence):
        ahead = topology.next[half_edge]
        edge_ring.append(int(topology.face_vertices[ahead]))
        if topology.face_sizes[0] > 3:
            face_ring.append(int(topology.face_vertices[topology.next[ahead]]))
        half_edge = int(topology.turn(half_edge))
    return [0, *edge_ring, *face_ring], edge_ring
