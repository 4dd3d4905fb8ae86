"""Laws of evaluation on random closed cages."""

from __future__ import annotations

import numpy as np
import pytest
from evaluation.random_cages import cages
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.evaluation.element import element_stencils
from reference.bars import NORMAL, POINT
from reference.exact_samples import SCHEMES, angle, faces_of

# The same examples in every run, and few: each random cage has some ten new classes to prepare.
FEW = settings(derandomize=True, deadline=None, database=None, max_examples=8)
EVERY_SCHEME = pytest.mark.parametrize("scheme", SCHEMES)
SEED = st.integers(0, 99)
# Sums of products of some fifty weights.
WEIGHTS = 1e-13
SAMPLES = 12
# Derivatives relative to their own size, which near extraordinary points may be anything.
DERIVATIVE = 1e-11


def some_samples(surface, rng, count=SAMPLES):
    """Corners of elements (half-edges of the element mesh), and parameters, some of them near the corner."""
    half_edge = rng.integers(0, surface.patches.elements.half_edge_count, count)
    uv = rng.random((count, 2)) * 0.5 ** rng.integers(0, 10, (count, 1)) / (2 if surface.scheme.name == "loop" else 1)
    return half_edge, uv


def evaluate_from(surface, half_edge, uv):
    """Evaluate parameters from corners of the element mesh."""
    elements = surface.patches.elements
    element = elements.face[half_edge]
    return surface.evaluate(element, uv, half_edge - elements.face_offsets[element])


def assert_equal_derivatives(found, expected):
    length = np.linalg.norm(expected, axis=1, keepdims=True)
    assert (np.abs(found - expected) / length).max() <= DERIVATIVE


@EVERY_SCHEME
@given(data=st.data(), seed=SEED)
@FEW
def test_turning_moving_and_scaling_the_cage_do_so_to_the_surface(scheme, data, seed):
    cage, rng = data.draw(cages(scheme)), np.random.default_rng(seed)
    surface = LimitSurface(cage, scheme)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    turn *= np.linalg.det(turn)
    scale, shift = 10 ** rng.uniform(-3, 3), rng.standard_normal(3)
    samples = some_samples(surface, rng)
    before = evaluate_from(surface, *samples)
    moved = cage.with_positions(scale * (cage.positions @ turn.T) + shift)
    after = evaluate_from(LimitSurface(moved, scheme), *samples)
    size = np.abs(moved.positions).max()
    assert np.abs(scale * (before.p @ turn.T) + shift - after.p).max() <= POINT * size
    # The moved cage is rounded to its distance from the origin, which is the larger the smaller it is.
    rounding = 1 + 1 / scale
    for name in ("dp_du", "dp_dv"):
        expected = scale * (getattr(before, name) @ turn.T)
        length = np.linalg.norm(expected, axis=1, keepdims=True)
        assert (np.abs(getattr(after, name) - expected) / length).max() <= DERIVATIVE * rounding
    assert angle(before.n @ turn.T, after.n).max() <= NORMAL * rounding


@EVERY_SCHEME
@given(data=st.data(), seed=SEED)
@FEW
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
    found, expected = evaluate_from(two, other_half_edge, uv), evaluate_from(one, half_edge, uv)
    assert np.abs(found.p - expected.p).max() <= POINT
    assert_equal_derivatives(found.dp_du, expected.dp_du)
    assert_equal_derivatives(found.dp_dv, expected.dp_dv)
    assert angle(found.n, expected.n).max() <= NORMAL


def along_edge(surface, half_edge, t):
    """Corner and parameters at ``t`` along the element edge that begins at a corner."""
    elements = surface.patches.elements
    whole = surface.patches.is_whole[elements.face[half_edge]]
    first_half = whole | (t < 0.5)
    corner = np.where(first_half, half_edge, elements.next[half_edge])
    zero = np.zeros_like(t)
    uv = np.where(
        first_half[:, None], np.stack([np.where(whole, t, 2 * t), zero], axis=1), np.stack([zero, 2 - 2 * t], axis=1)
    )
    return corner, uv


@pytest.mark.core
@EVERY_SCHEME
@given(data=st.data(), seed=SEED)
@FEW
def test_neighbours_agree_along_the_edge_they_share(scheme, data, seed):
    cage, rng = data.draw(cages(scheme)), np.random.default_rng(seed)
    surface = LimitSurface(cage, scheme)
    elements = surface.patches.elements
    half_edge = rng.integers(0, elements.half_edge_count, SAMPLES)
    # The other side is counted from the other end: few bits, so that both have the same point.
    t = rng.integers(1, 2**20, SAMPLES) / 2**20
    one = evaluate_from(surface, *along_edge(surface, half_edge, t))
    two = evaluate_from(surface, *along_edge(surface, elements.twin[half_edge], 1 - t))
    assert np.abs(one.p - two.p).max() <= POINT
    assert angle(one.n, two.n).max() <= NORMAL


@pytest.mark.parametrize("scheme", ["catmull_clark", "doo_sabin"])
@given(data=st.data(), seed=SEED)
@FEW
def test_sub_patches_of_an_element_agree_along_the_edge_they_share(scheme, data, seed):
    cage, rng = data.draw(cages(scheme)), np.random.default_rng(seed)
    surface = LimitSurface(cage, scheme)
    elements = surface.patches.elements
    partial = np.flatnonzero(~surface.patches.is_whole[elements.face])
    assume(len(partial) > 0)
    half_edge = rng.choice(partial, SAMPLES)
    t, one = rng.random(SAMPLES), np.ones(SAMPLES)
    first = evaluate_from(surface, half_edge, np.stack([one, t], axis=1))
    second = evaluate_from(surface, elements.next[half_edge], np.stack([t, one], axis=1))
    assert np.abs(first.p - second.p).max() <= POINT
    assert angle(first.n, second.n).max() <= NORMAL


@EVERY_SCHEME
@given(data=st.data())
@FEW
def test_elements_agree_in_the_limit_at_the_corner_they_share(scheme, data):
    surface = LimitSurface(data.draw(cages(scheme)), scheme)
    elements = surface.patches.elements
    found = evaluate_from(surface, np.arange(elements.half_edge_count), np.zeros((elements.half_edge_count, 2)))
    order = np.argsort(elements.face_vertices)
    first = order[np.searchsorted(elements.face_vertices[order], elements.face_vertices)]
    assert np.abs(found.p - found.p[first]).max() <= POINT
    assert angle(found.n, found.n[first]).max() <= NORMAL


@pytest.mark.core
@EVERY_SCHEME
@given(data=st.data(), seed=SEED)
@FEW
def test_weights_sum_to_one_and_those_of_tangents_to_zero(scheme, data, seed):
    surface, rng = LimitSurface(data.draw(cages(scheme)), scheme), np.random.default_rng(seed)
    for group in surface.patches.classes[:4]:
        _, uv = some_samples(surface, rng)
        weights = element_stencils(surface.scheme, group.signature, np.concatenate([uv, [[0.0, 0.0]]]))
        np.testing.assert_allclose(weights[0].sum(axis=1), 1, rtol=0, atol=WEIGHTS)
        np.testing.assert_allclose(weights[1:].sum(axis=2), 0, rtol=0, atol=WEIGHTS)


@EVERY_SCHEME
@given(data=st.data(), rate=st.integers(1, 4))
@FEW
def test_tessellation_is_watertight_and_faces_outward(scheme, data, rate):
    found = LimitSurface(data.draw(cages(scheme)), scheme).tessellate(rate)
    edges = np.concatenate([found.triangles[:, [i, (i + 1) % 3]] for i in range(3)]).tolist()
    directed = {tuple(edge) for edge in edges}
    assert len(directed) == len(edges)
    assert all((b, a) in directed for a, b in directed)
    assert len(np.unique(found.triangles)) == len(found.positions)
    # One sphere: vertices, edges and triangles.
    assert len(found.positions) - len(edges) // 2 + len(found.triangles) == 2
    a, b, c = found.positions[found.triangles].swapaxes(0, 1)
    assert np.linalg.det(np.stack([a, b, c], axis=1)).sum() > 0
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1, rtol=0, atol=1e-12)
