"""Sources of each frame, layers of other depths, and degenerate clips."""

import jax.numpy as jnp
import numpy as np
import pytest

from vggtjax import MotionConfig
from vggtjax.method.cues import GramCues, normalise, sources

OFFSETS = MotionConfig().offsets


def test_sources_are_the_offsets_that_exist():
    index, weights = sources(9, OFFSETS)
    assert np.allclose(weights.sum(1), 1)
    assert sorted(index[0][weights[0] > 0]) == [2, 4, 6]
    assert sorted(index[4][weights[4] > 0]) == [0, 2, 6, 8]


@pytest.mark.parametrize("frames", [2, 3])
def test_short_clips_use_every_other_frame(frames):
    index, weights = sources(frames, OFFSETS)
    assert np.allclose(weights.sum(1), 1)
    assert (index[1][weights[1] > 0] != 1).all()
    assert np.count_nonzero(weights[1]) == frames - 1


def test_a_single_frame_has_no_source_and_no_saliency():
    assert sources(1, OFFSETS)[1].tolist() == [[0]]
    cues = GramCues(MotionConfig(), 24)
    q = jnp.asarray(np.random.default_rng(0).normal(size=(1, 1, 4, 2, 8)).astype(np.float32))
    sums = cues.add(cues.zeros(1, 1, 4), jnp.ones(5, int), q, q)
    assert np.asarray(cues.saliency(sums)).tolist() == [[[0, 0, 0, 0]]]


def test_one_patch_per_frame_is_finite():
    cues = GramCues(MotionConfig(), 24)
    q = jnp.ones((1, 3, 1, 2, 8))
    sums = cues.add(cues.zeros(1, 3, 1), jnp.ones(5, int), q, q)
    assert np.isfinite(cues.saliency(sums)).all()


def test_only_a_std_over_several_layers_keeps_a_gram_matrix():
    shapes = [x.shape for x in GramCues(MotionConfig(), 24).zeros(1, 2, 5)]
    assert shapes == [(1, 2, 5), (1, 2, 5), (1, 2, 5), (1, 2, 5), (1, 2, 5, 5)]


def test_layers_of_another_depth():
    motion = MotionConfig()
    deep = motion.cues[3]
    assert motion.layers(deep, 24) == (17, 18, 19, 20, 21)
    assert motion.layers(deep, 12) == (8, 9, 9, 10, 10)  # 8.13, 8.61, 9.09, 9.57, 10.04
    assert motion.layers(motion.cues[0], 1) == (0,)


def test_normalise_by_hand():
    made = normalise(jnp.asarray([[[1.0, 2.0, 3.0], [4.0, 4.0, 4.0]]]))
    assert np.allclose(made, [[[0, 0.5, 1], [0, 0, 0]]], atol=1e-6)
