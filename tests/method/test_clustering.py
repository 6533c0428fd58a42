"""k-means: inertia against scikit-learn's, weights, points that coincide, fewer points than clusters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sklearn.cluster import KMeans

from vggtjax.method.clustering import kmeans

SEEDS = range(8)  # one run's inertia varies by 1.2 %
_kmeans = jax.jit(kmeans, static_argnames=("clusters", "restarts"))


def features(kind: str) -> np.ndarray:
    """Points as they come up here: patch features on a low-dimensional sheet, a cloud of 3-D points far away, blobs."""
    generator = np.random.default_rng(5)
    if kind == "features":
        hidden = generator.normal(size=(800, 6)) @ generator.normal(size=(6, 32))
        return np.tanh(hidden).astype(np.float32)
    if kind == "cloud":
        return (generator.uniform(size=(1000, 3)) * [1, 2, 0.2] + [40, -30, 100]).astype(np.float32)
    return (generator.integers(0, 12, size=(1000, 1)) + 0.05 * generator.normal(size=(1000, 4))).astype(np.float32)


@pytest.mark.parametrize(("kind", "clusters"), [("features", 32), ("cloud", 30), ("blobs", 12)])
def test_inertia_is_scikit_learns(kind, clusters):
    points = features(kind)
    fitted = [KMeans(clusters, random_state=seed).fit(points) for seed in SEEDS]
    theirs = np.mean([-model.score(points) for model in fitted])  # the score is minus the inertia
    ours = np.mean([float(_kmeans(jax.random.key(seed), points, clusters=clusters).inertia) for seed in SEEDS])
    assert ours <= 1.01 * theirs


def test_labels_centres_and_inertia_belong_together():
    points = features("cloud")
    found = _kmeans(jax.random.key(0), points, clusters=8)
    distance = ((points[:, None] - np.asarray(found.centres)[None]) ** 2).sum(axis=-1)
    assert np.array_equal(distance.argmin(axis=1), found.labels)
    assert float(found.inertia) == pytest.approx(distance.min(axis=1).sum(), rel=1e-4)
    for label in range(8):
        mean = points[np.asarray(found.labels) == label].mean(axis=0)
        assert np.abs(mean - found.centres[label]).max() < 0.05


def test_points_of_weight_zero_move_nothing():
    points = features("cloud")
    junk = np.concatenate([points, np.full((500, 3), 1e3, np.float32)])
    weights = np.arange(1500) < 1000
    found = _kmeans(jax.random.key(1), junk, clusters=8, weights=weights)
    alone = _kmeans(jax.random.key(1), points, clusters=8)
    assert float(found.inertia) == pytest.approx(float(alone.inertia), rel=0.05)
    assert float(jnp.abs(found.centres).max()) < 110
    nothing = _kmeans(jax.random.key(1), junk, clusters=8, weights=np.zeros(1500, bool))
    assert np.isfinite(nothing.centres).all()
    assert float(nothing.inertia) == 0


def test_restarts_can_only_help():
    points = features("features")
    one = [float(_kmeans(jax.random.key(seed), points, clusters=16).inertia) for seed in range(4)]
    many = [float(_kmeans(jax.random.key(seed), points, clusters=16, restarts=6).inertia) for seed in range(4)]
    assert np.mean(many) < np.mean(one)


@pytest.mark.parametrize("points", [np.ones((7, 3), np.float32), np.eye(3, dtype=np.float32), np.zeros((1, 2))])
def test_fewer_distinct_points_than_clusters(points):
    found = _kmeans(jax.random.key(0), jnp.asarray(points, jnp.float32), clusters=5)
    assert float(found.inertia) == pytest.approx(0, abs=1e-6)
    assert np.isfinite(found.centres).all()
    assert np.all((np.asarray(found.labels) >= 0) & (np.asarray(found.labels) < 5))
