import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.fit import PointFit, Schedule, to_mesh
from patches.closed_cages import torus
from reference.refined_cages import tagged

# Distance relative to the size of the box around the points. With no noise, only the regularizer is in the way.
FOUND = 1e-4
# Control points move this much, so that the surface is clearly another one.
MOVED = 0.1


@pytest.fixture(scope="module")
def target():
    return LimitSurface(torus(6, 5))


def moved(cage):
    noise = np.random.default_rng(3).normal(scale=MOVED, size=cage.positions.shape)
    return cage.with_positions(cage.positions + noise)


def distance(surface, other):
    size = np.linalg.norm(np.ptp(other.cage.positions, axis=0))
    return other.closest_point(surface.sample(500, 9).p).distance.max() / size


@pytest.mark.parametrize("with_normals", [False, True])
def test_a_surface_is_found_from_its_points(target, with_normals):
    points, start = target.sample(600, 1), moved(target.cage)
    assert distance(LimitSurface(start), target) > 50 * FOUND

    def made(start, order=slice(None)):
        normals = points.n[order] if with_normals else None
        return PointFit(start, points.p[order], normals, sliding=1e-3, regularizers={"bending": 0})

    fit, order = made(start).run(12), np.random.default_rng(4).permutation(600)
    far = target.cage.with_positions(1.5 * target.cage.positions)
    assert made(far, order).step() == pytest.approx(made(far).step())
    assert distance(LimitSurface(fit.cage), target) < FOUND
    assert fit.losses[-1] < 1e-5 * fit.losses[0]


# Where Dr.Jit traces a render, it raises a RuntimeError from the interruption.
@pytest.mark.parametrize(("during_callback", "kind"), [(False, RuntimeError), (True, KeyboardInterrupt)])
def test_an_interrupted_run_leaves_its_last_complete_step(target, tmp_path, monkeypatch, during_callback, kind):
    points, path, step = target.sample(600, 1), tmp_path / "fit.npz", PointFit._step

    def interrupt(fit):
        if len(fit.losses) == 3:
            raise kind from KeyboardInterrupt()

    def interrupted(fit, number):
        loss = step(fit, number)
        interrupt(fit)
        return loss

    def made(**options):
        return PointFit(moved(target.cage), points.p, refine=[2], **options)

    whole = made().run(5)
    if not during_callback:
        monkeypatch.setattr(PointFit, "_step", interrupted)
    with pytest.raises(kind):
        made(callbacks=[interrupt] if during_callback else []).run(5, checkpoint=path)
    monkeypatch.undo()
    resumed = made().resume(path)
    assert resumed.losses == whole.losses[:3]
    assert resumed.run(2).losses == whole.losses
    np.testing.assert_array_equal(resumed.control_points, whole.control_points)


def test_a_refined_cage_fits_better():
    directions = LimitSurface(cube()).sample(400, 2).p
    points = directions * (1 + 0.3 * np.sin(5 * directions[:, :1]))
    fit = PointFit(cube(), points, refine=[3, 6]).run(8)
    assert fit.refinements == 2
    assert fit.cage.face_count == 16 * 6
    assert fit.losses[7] < fit.losses[5] / 4 < fit.losses[2] / 16


def test_unconstrained_control_points_stay(target):
    start, points = moved(target.cage), target.sample(4000, 1)
    few = points.p[points.element == 0]
    fit = PointFit(start, few, both_ways=False, regularizers={"bending": 0}).run(1)
    near = LimitSurface(start).closest_point(few)
    is_held = LimitSurface(start).matrix(near.element, near.uv, near.corner).p.sum(axis=0) > 0
    assert 0 < np.count_nonzero(is_held) < len(is_held)
    np.testing.assert_allclose(fit.control_points[~is_held], start.positions[~is_held], atol=1e-12)
    assert (fit.control_points[is_held] != start.positions[is_held]).all()


def test_refining_moves_nothing_and_tags_stay(target):
    creased = tagged(target.cage, creases=[(*target.cage.edges[0], 3.0)])
    points = LimitSurface(creased).sample(300, 1).p
    cage = PointFit(moved(creased), points, refine=[1]).run(2).cage
    assert cage.tags.creases(cage.topology)[:, 2].tolist() == [2.0, 2.0]
    fit = PointFit(moved(target.cage), points)
    before = LimitSurface(fit.cage).tessellate(4).positions
    fit.refine()
    after = LimitSurface(fit.cage).tessellate(2)
    assert LimitSurface(fit.cage).closest_point(before).distance.max() < 1e-12
    assert len(after.positions) == len(before)


def test_a_mesh_becomes_a_cage(target):
    mesh = target.tessellate(8)
    cage = to_mesh(moved(target.cage), mesh.positions, mesh.triangles, steps=10)
    # The mesh's triangles lie inside the surface.
    triangles = target.closest_point(mesh.positions[mesh.triangles].mean(axis=1)).distance.max()
    size = np.linalg.norm(np.ptp(target.cage.positions, axis=0))
    assert distance(LimitSurface(cage), target) < 2 * triangles / size


def test_a_checkpoint_resumes_only_its_fit(target, tmp_path):
    points = target.sample(300, 1).p
    PointFit(torus(5, 4), points).run(1, checkpoint=tmp_path / "fit.npz")
    with pytest.raises(ValueError, match='has no "points" of this fit; expected that of a fit with the same arguments'):
        PointFit(target.cage, points).resume(tmp_path / "fit.npz")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(ValueError, match="is no checkpoint of a fit"):
        PointFit(target.cage, points).resume(tmp_path / "text.npz")


@pytest.mark.parametrize(
    ("points", "normals", "message"),
    [
        (np.zeros((4, 2)), None, r"points of the shape \(4, 2\); expected \(m, 3\)"),
        (np.zeros((0, 3)), None, "points of the shape"),
        (np.array([[0, 0, 0], [0, np.inf, 0]]), None, r"row 1 of points is \[0.0, inf, 0.0\]; expected finite"),
        (np.zeros((4, 3)), np.ones((3, 3)), "3 normals of 4 points"),
    ],
)
def test_malformed_points_are_refused(target, points, normals, message):
    with pytest.raises(ValueError, match=message):
        PointFit(target.cage, points, normals)


def test_malformed_meshes_and_normals_to_the_inside_are_refused(target):
    points, positions = target.sample(50, 1), target.cage.positions
    with pytest.raises(ValueError, match="expected outward normals"):
        PointFit(target.cage, points.p, -points.n, both_ways=False).step()
    with pytest.raises(ValueError, match=r"triangle 1 is \[0, 1, 30\]; expected vertices from 0 to 29"):
        to_mesh(target.cage, positions, [[0, 1, 2], [0, 1, 30]])
    with pytest.raises(ValueError, match="the mesh has no area"):
        to_mesh(target.cage, positions, [[0, 0, 0]])


def test_a_strong_anchor_holds_all_control_points(target):
    """Where a regulariser is least, it must not pull: its matrix and its right side have the same factor."""
    start = moved(target.cage)
    fit = PointFit(start, target.sample(300, 1).p, regularizers={"bending": 0, "anchor": 1e9}).run(1)
    np.testing.assert_allclose(fit.control_points, start.positions, atol=1e-6)


@pytest.mark.core
@pytest.mark.parametrize(
    ("given", "numbers"),
    [
        (0.5, {0: 0.5, 7: 0.5}),
        # A rate falls by the same factor at every step.
        ([(10, 1.0), (20, 1e-2)], {0: 1, 10: 1, 15: 0.1, 20: 1e-2, 30: 1e-2}),
        # With zero, on a line.
        ([(0, 1.0), (4, 0)], {0: 1, 1: 0.75, 2: 0.5, 3: 0.25, 4: 0}),
        (lambda step: step**2, {3: 9}),
    ],
)
def test_a_schedule_has_these_numbers(given, numbers):
    values = [Schedule.of(given, "rate")(step) for step in numbers]
    np.testing.assert_allclose(values, list(numbers.values()), rtol=1e-15)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("fast", "rate is 'fast'; expected a number"),
        ([], "expected a number, pairs"),
        ([(0, np.nan)], "expected a number, pairs"),
        ([(5, 1.0), (5, 2.0)], r"rate has the steps \[5.0, 5.0\]; expected increasing ones"),
    ],
)
def test_invalid_schedules_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Schedule.of(given, "rate")
