"""Laws of evaluation: what maps and numbers of the cage do to the surface."""

import numpy as np
import pytest
from evaluation.common import evaluate_from
from kernels.surfaces import SURFACES, random_locations, surface_named
from mitsuba_subdivision import ControlCage, LimitSurface
from patches.closed_cages import SURFACES as CLOSED
from patches.closed_cages import bumpy, cage_of, polygons
from reference.bars import NORMAL, POINT
from reference.exact_samples import angle

SAMPLES = 60
# Derivatives relative to their own size, which near extraordinary points may be anything.
DERIVATIVE = 1e-11


def assert_equal_derivatives(derivatives, expected, rounding=1):
    length = np.linalg.norm(expected, axis=1, keepdims=True)
    assert (np.abs(derivatives - expected) / length).max() <= DERIVATIVE * rounding


@pytest.mark.parametrize("name", SURFACES)
def test_affine_maps_of_the_cage_are_those_of_the_surface(name, np_rng):
    surface, scale = surface_named(name), 10 ** np_rng.uniform(-3, 3)
    matrix, shift = scale * np_rng.standard_normal((3, 3)), np_rng.standard_normal(3)
    samples = random_locations(surface, np_rng, SAMPLES, deepest=10)
    before = surface.evaluate(*samples)
    moved = surface.cage.with_positions(surface.cage.positions @ matrix.T + shift)
    after = LimitSurface(moved, surface.scheme).evaluate(*samples)
    assert np.abs(before.p @ matrix.T + shift - after.p).max() <= POINT * np.abs(moved.positions).max()
    # The moved cage is rounded to its distance from the origin, which is the larger the smaller it is.
    rounding = (1 + 1 / scale) * np.linalg.cond(matrix)
    assert_equal_derivatives(after.dp_du, before.dp_du @ matrix.T, rounding)
    assert_equal_derivatives(after.dp_dv, before.dp_dv @ matrix.T, rounding)
    normal = np.sign(np.linalg.det(matrix)) * before.n @ np.linalg.inv(matrix)
    assert angle(normal, after.n).max() <= NORMAL * rounding


@pytest.mark.parametrize(("scheme", "name"), CLOSED)
def test_the_order_of_vertices_faces_and_corners_does_not_matter(scheme, name, np_rng):
    cage = bumpy(cage_of(scheme, name))
    faces = polygons(cage.topology)
    new_vertex, face_order = np_rng.permutation(cage.vertex_count), np_rng.permutation(len(faces))
    turns = [int(np_rng.integers(len(face))) for face in faces]
    renamed = [[int(new_vertex[v]) for v in face[turn:] + face[:turn]] for face, turn in zip(faces, turns, strict=True)]
    positions = np.empty_like(cage.positions)
    positions[new_vertex] = cage.positions
    other = ControlCage(positions, [renamed[f] for f in face_order])

    one, two = LimitSurface(cage, scheme), LimitSurface(other, scheme)
    elements = one.patches.elements
    element, uv, corner = random_locations(one, np_rng, SAMPLES, deepest=10)
    half_edge = elements.face_offsets[element] + corner
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
