"""Gram maps, saliency and mask upsampling against numbers of the public VGGT4D code."""

import json

import jax
import numpy as np
import pytest

from tests.shared.seeded import seeded_images
from vggtjax import forward
from vggtjax.method.cues import GramCues
from vggtjax.method.mask import cluster_means, upsample
from vggtjax.method.mask import multi_otsu_threshold as eager_threshold

multi_otsu_threshold = jax.jit(eager_threshold)
TOLERANCE = 1e-4  # absolute, of maps in [0, 1]; measured: 4e-6


@pytest.fixture(scope="module")
def arrays(golden):
    return np.load(golden / "motion.npz")


@pytest.mark.parametrize("gram", ["dot", "cosine"])
def test_maps_and_saliency(arrays, seeded_params, config, gram):
    meta = json.loads(str(arrays["meta"]))
    images = seeded_images(meta["frames"], meta["height"], meta["width"], meta["seed"]).transpose(0, 2, 3, 1)[None]
    cues = GramCues(config.motion, config.depth, gram)
    run = jax.jit(lambda params, images: forward(params, images, config, cues=cues, outputs=()).cue_sums)
    sums = run(seeded_params(meta["seed"]), images)
    assert sums is not None
    for name, made in (cues.maps(sums) | {"saliency": cues.saliency(sums)}).items():
        golden = arrays[f"{gram}/{name}"]
        assert np.abs(np.asarray(made).reshape(golden.shape) - golden).max() <= TOLERANCE, name


def test_upsampling(arrays):
    golden = arrays["upsampled_saliency"]
    made = upsample(arrays["clustered_saliency"][None], golden.shape[1:])
    assert np.abs(np.asarray(made)[0] - golden).max() <= 1e-6


def test_clustered_saliency(arrays):
    made = cluster_means(arrays["dot/saliency"], arrays["cluster_labels"], int(arrays["n_clusters"]))
    assert np.abs(np.asarray(made) - arrays["clustered_saliency"]).max() <= 1e-5


def test_multi_otsu(arrays):
    threshold = multi_otsu_threshold(arrays["upsampled_saliency"])
    assert threshold == pytest.approx(float(arrays["multiotsu_threshold"]), abs=1e-5)
    wrong = (arrays["upsampled_saliency"] > threshold) != arrays["coarse_masks"]
    assert wrong.mean() <= 1e-4


@pytest.mark.parametrize("classes", [2, 3, 4])
def test_multi_otsu_where_so_many_classes_win(arrays, classes):
    made = multi_otsu_threshold(arrays[f"multiotsu/{classes}_input"])
    assert made == pytest.approx(float(arrays[f"multiotsu/{classes}_threshold"]), abs=1e-5)
