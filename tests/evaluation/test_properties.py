"""Laws of evaluation on random closed cages."""

import numpy as np
from evaluation.common import EVERY_SCHEME, evaluate_from
from evaluation.random_cages import cages
from hypothesis import given, settings
from hypothesis import strategies as st
from mitsuba_subdivision import ControlCage, LimitSurface
from reference.bars import NORMAL, POINT
from reference.exact_samples import angle, faces_of

# The same examples in every run, and few: each random cage has some ten new classes to prepare.
FEW = settings(derandomize=True, deadline=None, database=None, max_examples=8)
SAMPLES = 12
# Derivatives relative to their own size, which near extraordinary points may be anything.
DERIVATIVE = 1e-11


def of_random_cages(law):
    """Parametrise a law by scheme, and give it data to draw cages from and a seed for what else is random."""
    return EVERY_SCHEME(given(data=st.data(), seed=st.integers(0, 99))(FEW(law)))


def some_samples(surface, rng, count=SAMPLES):
    """Corners of elements (half-edges of the element mesh), and parameters, some of them near the corner."""
    half_edge = rng.integers(0, surface.patches.elements.half_edge_count, count)
    uv = rng.random((count, 2)) * 0.5 ** rng.integers(0, 10, (count, 1)) / (2 if surface.scheme.name == "loop" else 1)
    return half_edge, uv


def assert_equal_derivatives(derivatives, expected, rounding=1):
    length = np.linalg.norm(expected, axis=1, keepdims=True)
    assert (np.abs(derivatives - expected) / length).max() <= DERIVATIVE * rounding


@of_random_cages
def test_affine_maps_of_the_cage_are_those_of_the_surface(scheme, data, seed):
    cage, rng = data.draw(cages(scheme)), np.random.default_rng(seed)
    scale = 10 ** rng.uniform(-3, 3)
    matrix, shift = scale * rng.standard_normal((3, 3)), rng.standard_normal(3)
    samples = some_samples(surface := LimitSurface(cage, scheme), rng)
    before = evaluate_from(surface, *samples)
    moved = cage.with_positions(cage.positions @ matrix.T + shift)
    after = evaluate_from(LimitSurface(moved, scheme), *samples)
    assert np.abs(before.p @ matrix.T + shift - after.p).max() <= POINT * np.abs(moved.positions).max()
    # The moved cage is rounded to its distance from the origin, which is the larger the smaller it is.
    rounding = (1 + 1 / scale) * np.linalg.cond(matrix)
    assert_equal_derivatives(after.dp_du, before.dp_du @ matrix.T, rounding)
    assert_equal_derivatives(after.dp_dv, before.dp_dv @ matrix.T, rounding)
    normal = np.sign(np.linalg.det(matrix)) * before.n @ np.linalg.inv(matrix)
    assert angle(normal, after.n).max() <= NORMAL * rounding


@of_random_cages
def test_the_order_of_vertices_faces_and_corners_does_not_matter(scheme, data, seed):
    cage, rng = data.draw(cages(scheme)), np.random.default_rng(seed)
    faces = [face.tolist() for face in faces_of(cage)]
    new_vertex, face_order = rng.permutation(cage.vertex_count), rng.permutation(len(faces))
    turns = [int(rng.integers(len(face))) for face in faces]
    renamed = [[int(new_vertex[v]) for v in face[turn:] + face[:turn]] for face, turn in zip(faces, turns, strict=True)]
    positions = np.empty_like(cage.positions)
    positions[new_vertex] = cage.positions
    other = ControlCage(positions, [renamed[f] for f in face_order])

    one, two = LimitSurface(cage, scheme), LimitSurface(other, scheme)
    half_edge, uv = some_samples(one, rng)
    # The half-edge of either cage is the same corner of the same face.
    corner_of = one.patches.half_edge_of_corner[half_edge]
    face = cage.topology.face[corner_of]
    turned = (corner_of - cage.topology.face_offsets[face] - np.array(turns)[face]) % cage.face_sizes[face]
    place = other.topology.face_offsets[np.argsort(face_order)[face]] + turned
    other_half_edge = np.argsort(two.patches.half_edge_of_corner)[place]
    renumbered, expected = evaluate_from(two, other_half_edge, uv), evaluate_from(one, half_edge, uv)
    assert np.abs(renumbered.p - expected.p).max() <= POINT
    assert_equal_derivatives(renumbered.dp_du, expected.dp_du)
    assert_equal_derivatives(renumbered.dp_dv, expected.dp_dv)
    assert angle(renumbered.n, expected.n).max() <= NORMAL
