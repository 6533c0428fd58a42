"""Otsu against scikit-image, upsampling, token masks."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.sharding import Mesh
from skimage.filters import threshold_multiotsu, threshold_otsu

from tests.shared.eight_devices import printed_by
from tests.shared.reference import multi_otsu
from vggtjax.errors import InputError
from vggtjax.method import mask as eager
from vggtjax.method.mask import (
    _between_classes,
    _partition,
    cluster_means,
    dynamic_tokens,
    multi_otsu_threshold,
    otsu_threshold,
    smooth_over_time,
    upsample,
)
from vggtjax.method.matching.witnesses import Evidence
from vggtjax.method.passes import mine
from vggtjax.network.backbone import ClipBatch, Features
from vggtjax.network.kernels.frames import Frames

_otsu = jax.jit(otsu_threshold)
_multi_otsu = jax.jit(multi_otsu_threshold, static_argnames="bins")
dynamic_pixels = jax.jit(eager.dynamic_pixels, static_argnames=("size", "threshold"))
mine_mask = jax.jit(eager.mine_mask, static_argnames=("size", "clusters", "threshold", "smooth_frames"))


def cut_alike(values, threshold, other) -> bool:
    """Whether the thresholds are within a bin of each other, or cut the values alike but for those within a bin.

    Between two groups of values, bins without a value are equally good thresholds, and rounding decides.
    """
    margin = 1.01 * (values.max() - values.min()) / 256
    low, high = sorted([threshold, other])
    return not np.any((values > low + margin) & (values < high - margin))


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    share=st.floats(0.01, 0.99),
    gap=st.floats(0, 5),
    scale=st.sampled_from([1e-4, 1.0, 1e3]),
)
def test_otsu_agrees_with_scikit_image_within_a_bin(seed, share, gap, scale):
    generator = np.random.default_rng(seed)
    values = generator.normal(size=4000) + gap * (generator.random(4000) < share)
    values = (scale * values).astype(np.float32)
    assert cut_alike(values, float(_otsu(values)), threshold_otsu(values))


def test_otsu_by_hand():
    values = jnp.asarray([0.0] * 6 + [1.0] * 2)
    assert float(otsu_threshold(values)) == pytest.approx(0.5 / 256)  # the lowest of equally good bin centres
    assert float(otsu_threshold(jnp.full((4,), 0.3))) == pytest.approx(0.3)


@pytest.mark.parametrize("value", [0.0, 0.7])
@pytest.mark.parametrize("threshold", ["otsu", "multi-otsu"])
def test_constant_saliency_has_no_dynamic_pixels(value, threshold):
    assert not dynamic_pixels(jnp.full((1, 3, 2, 2), value), (28, 28), threshold=threshold).any()


@pytest.mark.parametrize("threshold", ["otsu", "multi-otsu"])
def test_a_frame_that_is_not_finite_leaves_the_masks_of_the_others(threshold):
    saliency = np.zeros((1, 3, 4, 4), np.float32)
    saliency[0, :2, 1:3, 1:3] = 1
    tokens = jnp.zeros((1, 3, 16, 2))
    whole = mine_mask(jnp.asarray(saliency), tokens, (28, 28), threshold=threshold)
    saliency[0, 2], saliency[0, 2, 0, 0] = np.nan, np.inf
    broken = mine_mask(jnp.asarray(saliency), tokens, (28, 28), threshold=threshold)
    assert whole[0, :2].any(axis=(1, 2)).all()
    assert (broken == whole).all()


def test_multi_otsu_of_nearly_constant_values_is_the_largest():
    values = jnp.asarray([0.5] * 3 + [0.5000005])
    assert float(_multi_otsu(values)) == float(values[-1])


@settings(max_examples=40, derandomize=True)  # a bin can decide whether three or four classes are better
@given(
    seed=st.integers(0, 2**32 - 1),
    centres=st.lists(st.floats(0, 1), min_size=1, max_size=5),
    spread=st.sampled_from([0.0, 1e-3, 0.03, 0.2]),
)
def test_multi_otsu_agrees_with_scikit_image_within_a_bin(seed, centres, spread):
    generator = np.random.default_rng(seed)
    values = generator.choice(centres, size=(5, 20, 40)) + spread * generator.normal(size=(5, 20, 40))
    values = values.astype(np.float32)
    assert cut_alike(values, float(_multi_otsu(values)), multi_otsu(values))


@pytest.mark.parametrize("classes", [2, 3, 4])
def test_partitions_of_small_histograms_are_those_of_scikit_image(classes):
    generator = np.random.default_rng(classes)
    partition = jax.jit(lambda shares: _partition(_between_classes(shares), classes))
    for counts in generator.integers(1, 1000, size=(100, 7)):
        expected = threshold_multiotsu(classes=classes, hist=(counts, np.arange(7)))
        assert np.asarray(partition(counts / counts.sum())).tolist() == expected.tolist()


def test_parts_of_classes_in_the_variance_by_hand():
    found = _between_classes(jnp.asarray([0.5, 0, 0.5]))  # bin 0 counts as bin 1, and is nothing alone; bin 1 is empty
    assert found.tolist() == [[0, 0.5, 2.25], [0, 0, 2], [0, 0, 2]]


def test_multi_otsu_with_a_class_of_one_value():
    values = jnp.asarray([0.0] * 4 + [0.5] * 4 + [1.0])
    assert float(_multi_otsu(values)) == pytest.approx(128.5 / 256)  # three classes: the bin of 0.5 is the last below
    assert float(_multi_otsu(values, bins=4)) == pytest.approx(2.5 / 4)
    assert float(_multi_otsu(values[:8])) == pytest.approx(0.5 * 1.5 / 256)  # two classes: bin 0 goes with bin 1


def test_multi_otsu_with_a_class_that_ends_empty():
    """The middle value lies above the centre of its bin, and so in the highest of three classes: two are taken."""
    values = np.array([0.0] * 4 + [0.503] * 4 + [1.0], np.float32)
    assert float(_multi_otsu(values)) == pytest.approx(multi_otsu(values))
    assert float(_multi_otsu(values)) < 0.4


def test_multi_otsu_cuts_every_clip_at_its_own_threshold():
    saliency = np.zeros((2, 2, 4, 4), np.float32)
    saliency[0, :, :2] = 1.0  # two values alone
    saliency[1] = np.random.default_rng(0).uniform(0, 0.1, size=(2, 4, 4))
    saliency[1, :, 0] += 0.5
    mask = np.asarray(dynamic_pixels(jnp.asarray(saliency), (16, 16), threshold="multi-otsu"))
    pixels = np.asarray(upsample(jnp.asarray(saliency), (16, 16)))
    for one, values in zip(mask, pixels, strict=True):
        assert np.array_equal(one, values > multi_otsu(values))
        assert 0 < one.mean() < 0.7


def test_saliency_that_is_no_number_moves_nothing():
    values = jnp.full((1, 2, 2, 2), jnp.nan)
    assert not dynamic_pixels(values, (8, 8), threshold="multi-otsu").any()


def test_dynamic_pixels_are_at_or_above_the_threshold_of_their_own_clip():
    saliency = np.zeros((2, 2, 3, 4), np.float32)
    saliency[0, 0, 1, 1] = 1.0
    saliency[1, 1, 2, 3] = 0.01  # another clip, another range
    mask = np.asarray(dynamic_pixels(jnp.asarray(saliency), (42, 56)))
    pixels = np.asarray(upsample(jnp.asarray(saliency), (42, 56)))
    for clip in range(2):
        threshold = threshold_otsu(pixels[clip])
        bin_width = pixels[clip].max() / 256
        sure = np.abs(pixels[clip] - threshold) > bin_width
        assert (mask[clip] == (pixels[clip] >= threshold))[sure].all()
        assert 0 < mask[clip].mean() < 0.5


@pytest.mark.parametrize(("threshold", "number", "is_dynamic"), [("otsu", 0, True), ("multi-otsu", 64, False)])
def test_a_pixel_at_the_threshold_is_dynamic_by_otsu_alone(threshold, number, is_dynamic):
    saliency = jnp.asarray([0, 0, 0, (number + 0.5) / 256, 1, 1]).reshape(1, 1, 2, 3)  # the centre of a bin
    mask = dynamic_pixels(saliency, (2, 3), threshold=threshold)
    assert mask.ravel().tolist() == [False] * 3 + [is_dynamic] + [True] * 2
    assert not dynamic_pixels(saliency.at[..., 1, 0].add(-1e-3), (2, 3), threshold=threshold)[0, 0, 1, 0]


def test_upsampling_has_half_pixel_centres():
    made = np.asarray(upsample(jnp.asarray([[[[0.0, 1.0]]]]), (1, 4)))
    assert np.allclose(made, [[[[0, 0.25, 0.75, 1]]]])


def test_a_token_is_dynamic_if_any_of_its_pixels_is():
    mask = np.zeros((1, 1, 28, 42), bool)
    mask[0, 0, 13, 14] = True
    assert np.asarray(dynamic_tokens(jnp.asarray(mask), 14)).tolist() == [[[[False, True, False], [False] * 3]]]


def test_smoothing_over_time_by_hand():
    saliency = jnp.array([0.0, 3, 0, 0, 9])[None, :, None, None]
    smoothed = smooth_over_time(saliency, 3)
    np.testing.assert_allclose(smoothed[0, :, 0, 0], [1.5, 1, 1, 3, 4.5], rtol=1e-6)
    np.testing.assert_allclose(smooth_over_time(saliency, 5)[0, :, 0, 0], [1, 0.75, 2.4, 3, 3], rtol=1e-6)
    assert smooth_over_time(saliency, 1) is saliency
    np.testing.assert_allclose(smooth_over_time(saliency[:, 4:], 3)[0, :, 0, 0], [9], rtol=1e-6)  # of one frame
    np.testing.assert_allclose(smooth_over_time(saliency, 99)[0, :, 0, 0], [2.4] * 5, rtol=1e-6)


@pytest.mark.parametrize("frames", [0, 2, -3, 1.5])
def test_smoothing_takes_odd_numbers(frames):
    with pytest.raises(InputError, match=r"smooth_frames is .*; expected (an odd|a whole) number"):
        smooth_over_time(jnp.zeros((1, 2, 3, 4)), frames)


def test_a_flicker_is_smoothed_away():
    saliency = np.zeros((1, 7, 2, 2), np.float32)
    saliency[0, :, 0, 0] = 1
    saliency[0, 3] = [[0.4, 1], [0, 0]]  # for one frame, the wrong patch
    tokens = jnp.zeros((1, 7, 4, 3))
    rough, smooth = (mine_mask(jnp.asarray(saliency), tokens, (28, 28), smooth_frames=n) for n in (1, 5))
    assert rough[0, 3, 4, 20]
    assert not smooth[0, 3, 4, 20]
    assert smooth[0, 3, 4, 4]


def test_cluster_means_by_hand():
    saliency = jnp.array([[[0.0, 2, 4, 9, 3]], [[1, 5, 9, 9, 1]]])
    labels = jnp.array([[[0, 0, 1, 2, 3]], [[0, 1, 2, 2, 0]]])  # means 1, 4.5, 9, 3; label 4 has no token
    made = np.asarray(cluster_means(saliency, labels, 5))[:, 0]
    assert np.allclose(made, [[0, 0, 3.5 / 8, 1, 2 / 8], [0, 3.5 / 8, 1, 1, 0]], atol=1e-6)


@pytest.mark.parametrize("options", [{}, {"clusters": 3, "smooth_frames": 3}, {"threshold": "multi-otsu"}])
def test_frames_that_make_shares_equal_change_no_mask(options):
    generator = np.random.default_rng(0)
    saliency = generator.random((1, 7, 4, 4), np.float32)
    saliency[:, :, :2, 1:3] += 1
    saliency[:, 5:] = 40 * saliency[:, 5:] - 20  # of the two frames that are added
    tokens = saliency.reshape(1, 7, 16, 1) + generator.normal(0, 0.01, (1, 7, 16, 3)).astype(np.float32)
    images = generator.random((1, 7, 16, 16, 3), np.float32)
    how = {"clusters": 0, "threshold": "otsu"} | options

    def mask(saliency, tokens, images, frames=Frames()):
        return mine(Evidence(saliency), None, ClipBatch(images, Features(tokens)), **how, frames=frames).dynamic_mask

    alone = jax.jit(mask)(saliency[:, :5], tokens[:, :5], images[:, :5])
    frames = Frames(Mesh(np.array(jax.devices()[:1]), ("frames",)), 5)
    shared = np.asarray(jax.jit(partial(mask, frames=frames))(saliency, tokens, images))
    assert np.array_equal(shared[:, :5], alone)
    assert not shared[:, 5:].any()
    assert 0.1 < shared[:, :5].mean() < 0.6


@pytest.mark.proof
def test_eight_devices_mine_the_masks_of_one():
    found = printed_by(Path(__file__).with_name("mask_on_devices.py"))
    rounded, is_narrow = found.pop("attention in bfloat16")
    assert is_narrow
    assert rounded <= 2**-8  # once: keys and values are gathered before any sum is rounded
    assert len(found) == 4
    for method, (share, is_equal) in found.items():
        assert 0.03 < share < 0.5, method
        assert is_equal, method
