"""Mask refinement against numbers of the public VGGT4D code: losses of given clusters, refined masks."""

import jax
import numpy as np
import pytest

from vggtjax.cameras import unproject
from vggtjax.method import mask_refinement
from vggtjax.method.mask_refinement import cluster_losses, refine_masks, statistical_outliers


@pytest.fixture(scope="module")
def arrays(golden):
    with np.load(golden / "refine.npz") as file:
        arrays = dict(file)
    arrays["images"] = arrays["images"].transpose(0, 2, 3, 1)
    arrays["camera_from_world"] = np.linalg.inv(arrays.pop("cam2world"))[:, :3].astype(np.float32)
    return arrays


def scene(arrays):
    names = ("images", "depth", "coarse_masks", "camera_from_world", "intrinsic")
    return [arrays[name] for name in names]


def test_outliers(arrays):
    points = unproject(arrays["depth"], arrays["intrinsic"], arrays["camera_from_world"], pixel_offset=0.5)
    for frame, labels in zip(points, arrays["labels"], strict=True):
        assert np.array_equal(statistical_outliers(frame), labels == -2)


def test_losses_of_given_clusters(arrays):
    inside = arrays["labels"] >= 0
    index, weight = mask_refinement._packed(inside, int(inside.sum(axis=(1, 2)).max()) + 5)
    labels = np.take_along_axis(arrays["labels"].reshape(len(inside), -1), index, axis=1)
    made = cluster_losses(*scene(arrays), index, weight, np.where(weight, labels, 0), 30)
    golden = arrays["cluster_losses"]
    few = golden[..., 1] == mask_refinement.TOO_FEW
    assert np.array_equal(np.asarray(made.total) == mask_refinement.TOO_FEW, few)
    for column, value in ((1, made.depth), (2, made.rgb), (3, made.total)):
        assert np.abs(np.asarray(value) - golden[..., column])[~few].max() <= 1e-4


def test_masks_of_given_clusters(arrays, monkeypatch):
    def given(key, points, weight, clusters):
        index, _ = mask_refinement._packed(arrays["labels"] >= 0, points.shape[1])
        labels = np.take_along_axis(arrays["labels"].reshape(len(index), -1), index, axis=1)
        return jax.numpy.asarray(np.where(weight, labels, 0))

    monkeypatch.setattr(mask_refinement, "cluster_points", given)
    assert (refine_masks(*scene(arrays)) != arrays["refined_masks"]).mean() <= 1e-3


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.proof) for seed in (1, 2))])
def test_masks_of_our_own_clusters(arrays, seed):
    made, golden = refine_masks(*scene(arrays), seed=seed), arrays["refined_masks"]
    union = (made | golden).sum(axis=(1, 2))
    assert ((made & golden).sum(axis=(1, 2)) / union).min() >= 0.95
