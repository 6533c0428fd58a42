"""What fits minimise: likelihoods against scipy, consistency against generated truth, distances against others."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.stats import laplace, norm

from tests.shared.generated import DYNAMIC, STATIC, clips
from vggtjax.cameras import Cameras
from vggtjax.method.fusion.family import Fused
from vggtjax.research.evaluation.metrics.trajectory import rotation_error
from vggtjax.research.learning import objectives
from vggtjax.research.learning.distances import nearest_distance, point_cloud_distance, pose_error
from vggtjax.research.learning.objectives import geometric_loss, negative_log_likelihood, photometric_loss


def fused_of(depth, log_precision) -> Fused:
    depth = jnp.asarray(depth, jnp.float32)
    zero = jnp.zeros_like(depth)
    return Fused(depth, jnp.broadcast_to(jnp.asarray(log_precision, jnp.float32), depth.shape), zero, zero)


def example(seed: int = 0):
    generator = np.random.default_rng(seed)
    truth = generator.uniform(1, 4, (2, 5, 6))
    precision = np.exp(generator.normal(size=truth.shape))
    depth = 0.7 * truth + generator.normal(size=truth.shape) * 0.1
    truth[0, :2] = [[0], [np.nan]]
    return depth, precision, truth


@pytest.mark.parametrize(("kind", "density"), [("gaussian", norm), ("laplace", laplace)])
def test_likelihoods_are_scipys(kind, density):
    depth, precision, truth = example()
    known = np.isfinite(truth) & (truth > 0)
    fused = fused_of(depth, np.log(precision))

    def wanted(factor: float) -> float:
        spread = precision[known] ** -0.5 / (1 if kind == "gaussian" else np.sqrt(2))
        return -density.logpdf(depth[known], factor * truth[known], spread).mean()

    best: Any = minimize_scalar(wanted, bracket=(0.5, 1.0))
    found = negative_log_likelihood(fused, jnp.asarray(truth, jnp.float32), kind)
    assert float(found) == pytest.approx(best.fun, rel=1e-4)
    factor = objectives.unit_factor(fused, jnp.where(known, truth, 1).astype(jnp.float32), jnp.asarray(known), kind)
    assert wanted(float(factor)) == pytest.approx(best.fun, rel=1e-5)


def test_clips_have_no_unit_in_common():
    depth, precision, truth = (jnp.asarray(np.stack([x, x + x[:, ::-1]]), jnp.float32) for x in example())
    fused = fused_of(depth, jnp.log(precision))
    each = [negative_log_likelihood(jax.tree.map(lambda x: x[i], fused), truth[i]) for i in range(2)]  # noqa: B023
    assert np.isclose(negative_log_likelihood(fused, truth), np.mean(each))
    clip = clips(STATIC, 2)
    fused = fused_of(clip.depth * np.array([1, 3], np.float32).reshape(2, 1, 1, 1), 0.0)
    views = objectives.View(clip.images, Cameras(clip.camera_from_world, clip.intrinsics))
    for loss in (photometric_loss, geometric_loss):
        each = [loss(*jax.tree.map(lambda x: x[i], (fused, views))) for i in range(2)]  # noqa: B023
        assert np.isclose(loss(fused, views), np.mean(each))


@pytest.mark.parametrize("kind", ["gaussian", "laplace"])
def test_gradients_of_likelihoods_have_the_factor_inside(kind):
    """The factor's own gradient is left out; finite differences, which have it, agree."""
    depth, precision, truth = example(1)
    with jax.enable_x64(True):
        maps = [jnp.asarray(x) for x in (depth, np.log(precision))]
        zero = jnp.zeros_like(maps[0])

        def loss(maps):
            return negative_log_likelihood(Fused(maps[0], maps[1], zero, zero), jnp.asarray(truth), kind)

        gradient = jax.grad(loss)(maps)
        for part, place in ((0, (1, 2, 3)), (1, (1, 2, 3)), (0, (0, 4, 4)), (1, (1, 0, 0))):
            moved = [[m.at[place].add(s * 1e-6) if i == part else m for i, m in enumerate(maps)] for s in (1, -1)]
            slope = float(loss(moved[0]) - loss(moved[1])) / 2e-6
            assert float(gradient[part][place]) == pytest.approx(slope, rel=1e-4, abs=1e-8)
        assert float(gradient[0][0, 0, 0]) == 0  # no truth there


@pytest.mark.parametrize("kind", ["gaussian", "laplace"])
def test_likelihoods_of_extremes_have_no_nan(kind):
    depth = jnp.asarray([[[0.0, 1e6, 1.0, 1.0]]])
    truth = jnp.asarray([[[1.0, 1e-3, 0.0, 1.0]]])

    def loss(log_precision, truth):
        return negative_log_likelihood(fused_of(depth, log_precision), truth, kind)

    with jax.debug_nans(True):
        for log_precision in (0.0, 69.0, -69.0):
            value, gradient = jax.jit(jax.value_and_grad(loss))(jnp.full((1, 1, 4), log_precision), truth)
            assert np.isfinite(value)
            assert np.isfinite(gradient).all()
        zero = jnp.zeros((1, 1, 4))
        assert float(loss(zero, truth)) > 0
        value, gradient = jax.value_and_grad(loss)(zero, zero)  # nothing is known
        assert float(value) == 0
        assert not np.asarray(gradient).any()


def scene(index: int = 0, config=STATIC):
    clip = jax.tree.map(lambda x: jnp.asarray(x[index]), clips(config, 4))
    view = objectives.View(clip.images, Cameras(clip.camera_from_world, clip.intrinsics))
    moves = clip.dynamic_mask.astype(jnp.float32)
    return clip, view, Fused(clip.depth, jnp.full(clip.depth.shape, 4.0), moves, moves)


@pytest.mark.parametrize("loss", [photometric_loss, geometric_loss])
def test_true_depth_is_the_most_consistent(loss):
    """Depth in another unit than the cameras' is worse; its precision is said in the same unit."""

    @jax.jit
    def errors(fused, view):
        def scaled(factor):
            log_precision = fused.log_precision - 2 * jnp.log(factor)
            return loss(fused._replace(depth=factor * fused.depth, log_precision=log_precision), view, 2)

        return jax.lax.map(scaled, jnp.asarray([0.8, 1.0, 1.25]))

    for index in range(4):
        _, view, fused = scene(index)
        low, right, high = np.asarray(errors(fused, view))
        assert right < low
        assert right < high


def test_geometric_consistency_knows_the_variance():
    """Depth with noise of a known precision, of a still camera: the objective is lowest at that precision."""
    generator = np.random.default_rng(0)
    depth = 2 + 0.1 * generator.laplace(size=(4, 24, 32)) / np.sqrt(2)
    K = jnp.asarray([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]])
    cameras = Cameras(jnp.tile(jnp.eye(3, 4), (4, 1, 1)), jnp.tile(K, (4, 1, 1)))
    view = objectives.View(jnp.zeros((4, 24, 32, 3)), cameras)
    loss_at = jax.jit(lambda guess: geometric_loss(fused_of(depth, guess), view))
    guesses = np.arange(2, 8, 0.25)
    losses = [float(loss_at(guess)) for guess in guesses]
    assert guesses[np.argmin(losses)] == pytest.approx(np.log(100), abs=0.4)


def test_what_moves_is_not_compared():
    clip, view, fused = scene(0, DYNAMIC)
    assert np.asarray(clip.dynamic_mask).any()
    changed = fused._replace(depth=jnp.where(clip.dynamic_mask, 3 * fused.depth, fused.depth))
    losses = [float(jax.jit(photometric_loss)(one, view)) for one in (changed, fused)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


def test_gradients_of_consistency_by_finite_differences():
    _, view, fused = scene(1)
    with jax.enable_x64(True):
        view, fused = jax.tree.map(lambda x: jnp.asarray(np.asarray(x, np.float64)), (view, fused))
        direction = jnp.asarray(np.random.default_rng(0).normal(size=fused.depth.shape))
        for loss in (photometric_loss, geometric_loss):

            def along(t, loss=loss):
                return loss(fused._replace(depth=fused.depth * (1.01 + t * direction)), view)

            along = jax.jit(jax.value_and_grad(along))
            slope = float(along(1e-7)[0] - along(-1e-7)[0]) / 2e-7
            assert float(along(0.0)[1]) == pytest.approx(slope, rel=1e-3)


def poses(seed: int, count: int = 5) -> np.ndarray:
    generator = np.random.default_rng(seed)
    turns, places = Rotation.random(count, generator).as_matrix(), generator.normal(size=(count, 3, 1))
    return np.concatenate([turns, places], axis=2).astype(np.float32)


def test_pose_error_by_other_means():
    true = poses(0)
    turn = Rotation.from_rotvec([[0, 0, 0.0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, -0.1], [0.05, 0, 0]]).as_matrix()
    found = true.copy()
    found[:, :, :3] = turn @ true[:, :, :3]
    error = pose_error(jnp.asarray(found), jnp.asarray(true))
    assert float(error.rotation) == pytest.approx(np.sqrt(np.mean([0, 0.01, 0.04, 0.01, 0.0025])), rel=1e-4)
    assert rotation_error(found, true) == pytest.approx(np.degrees(np.mean([0.1, 0.2, 0.1, 0.05])), rel=1e-3)
    # A similarity of the world changes nothing.
    world = Rotation.random(rng=np.random.default_rng(3)).as_matrix()
    moved = true.copy()
    moved[:, :, :3] = true[:, :, :3] @ world
    moved[:, :, 3] = 2.5 * (true[:, :, 3] + (true[:, :, :3] @ np.array([1, 2, 3.0])))
    error = pose_error(jnp.asarray(moved), jnp.asarray(true))
    assert max(float(error.rotation), float(error.translation)) < 2e-3
    moved[:, :, 3] *= -1  # a mirrored path is wrong
    assert float(pose_error(jnp.asarray(moved), jnp.asarray(true)).translation) == pytest.approx(1)


def test_pose_error_has_gradients_even_at_no_error():
    true = jnp.asarray(poses(1))
    with jax.debug_nans(True):
        gradient = jax.jit(jax.grad(lambda found: sum(pose_error(found, true))))(true)
    assert np.isfinite(gradient).all()
    with jax.enable_x64(True):
        true, direction = (jnp.asarray(np.asarray(x, np.float64)) for x in (true, poses(2)))

        def along(t):
            return sum(pose_error(true + (0.1 + t) * direction, true))

        along = jax.jit(jax.value_and_grad(along))
        assert float(along(0.0)[1]) == pytest.approx(float(along(1e-6)[0] - along(-1e-6)[0]) / 2e-6, rel=1e-5)


def test_nearest_points_are_the_trees():
    generator = np.random.default_rng(0)
    points, others = generator.normal(size=(1300, 3)), generator.normal(size=(700, 3))
    found = nearest_distance(jnp.asarray(points, jnp.float32), jnp.asarray(others, jnp.float32))
    assert np.allclose(found, KDTree(others).query(points)[0], atol=1e-5)
    both = (KDTree(others).query(points)[0].mean() + KDTree(points).query(others)[0].mean()) / 2
    distance = point_cloud_distance(*(jnp.asarray(x, jnp.float32) for x in (points, others)))
    assert float(distance) == pytest.approx(both, rel=1e-5)
