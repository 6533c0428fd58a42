"""Maps against every Gram matrix, sources of each frame, layers of other depths, and degenerate clips."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

from tests.shared import reference
from vggtjax.config import Cue, MotionConfig
from vggtjax.errors import InputError
from vggtjax.method.cues import GramCues, _sample_std, _unit, normalise, sources
from vggtjax.network.kernels.frames import BY_FRAME, Frames

OFFSETS = MotionConfig().offsets
DEPTH, SPECIAL, PATCHES = 6, 3, 5


def added(cues, q, k, frame_count=None):
    """Return the sums over all pairs of q and k [pairs, S, tokens, heads, channels]."""

    def all_pairs(q, k):  # [1, S, pairs, ...]: the frames are where devices share them
        def add(sums, layer):
            return cues.add(sums, *layer, frame_count), None

        layers = (jnp.asarray(cues.layer_counts()), *(jnp.moveaxis(x, 2, 0) for x in (q, k)))
        return jax.lax.scan(add, cues.frames.varying(cues.zeros(1, q.shape[1], PATCHES)), layers)[0]

    return jax.jit(cues.frames.on_devices(all_pairs, BY_FRAME, BY_FRAME))(*(x.swapaxes(0, 1)[None] for x in (q, k)))


@pytest.mark.parametrize(
    ("gram", "padding"), [("cosine", "none"), ("dot", "by count"), ("cosine", "on a device"), ("dot", "on a device")]
)
def test_maps_and_saliency_are_those_of_every_gram_matrix(gram, padding):
    S, layers = 9, ((0,), (1,), (2, 3), (3, 4, 5), (4, 5))
    rows = zip(MotionConfig().cues, layers, strict=True)
    motion = MotionConfig(tuple(dataclasses.replace(cue, layers=of_cue) for cue, of_cue in rows), reference_depth=DEPTH)
    q, k = np.random.default_rng(0).normal(size=(2, DEPTH, S + 2, SPECIAL + PATCHES, 2, 4)).astype(np.float32)
    mesh = Mesh(np.array(jax.devices()[:1]), ("frames",))
    cues = GramCues(motion, DEPTH, gram, Frames(mesh, S) if padding == "on a device" else Frames())
    assert hash(cues) == hash(dataclasses.replace(cues))  # it can be a static argument
    given = S if padding == "none" else S + 2
    count = jnp.array([S]) if padding == "by count" else None
    sums = tuple(x[:, :S] for x in added(cues, q[:, :given], k[:, :given], count))
    maps, product = cues.maps(sums), np.ones((S, PATCHES))
    patches = {"q": q[:, :S, SPECIAL:], "k": k[:, :S, SPECIAL:]}
    for cue in motion.cues:
        pair = patches[cue.rows], patches[cue.columns]
        expected = reference.gram_map(*pair, motion.layers(cue, DEPTH), cue.statistic, OFFSETS, gram)
        assert np.allclose(maps[cue.name][0], expected, atol=1e-4), cue.name
        product *= 1 - expected if cue.inverted else expected
    low, high = product.min(1, keepdims=True), product.max(1, keepdims=True)
    assert np.allclose(cues.saliency(sums)[0], (product - low) / (high - low + 1e-6), atol=1e-3)
    squared = cues.saliency(sums, jnp.full(5, 2.0))[0]
    assert np.allclose(squared, np.asarray(normalise(jnp.asarray(product[None] ** 2)))[0], atol=1e-3)


@pytest.mark.parametrize(
    ("floor", "exponents", "expected"),
    [
        (0.0, None, (0, 0, 1)),
        (0.25, None, (1 / 6, 0, 1)),  # of 5/16, 3/16 and 15/16
        (0.25, (2.0, 2.0), (16 / 216, 0, 1)),  # of their squares
    ],
)
def test_a_floor_keeps_a_patch_that_one_map_rules_out(floor, exponents, expected):
    """By hand: maps (0, 1/2, 1) and 1 - (0, 1, 1/2)."""
    cues = Cue("a", "q", "q", (0,), "mean"), Cue("b", "q", "q", (0,), "mean", inverted=True)
    sums = tuple(jnp.array([[values]], jnp.float32) for values in ((0, 1, 2), (0, 8, 4)))
    made = GramCues(MotionConfig(cues, reference_depth=1, floor=floor), 1)
    saliency = made.saliency(sums, None if exponents is None else jnp.array(exponents))
    assert np.allclose(saliency[0, 0], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("statistic", "expected"), [("mean", [[3, 9], [4, 8]]), ("std", [[2**0.5, 18**0.5], [8**0.5, 32**0.5]])]
)
def test_similarities_with_the_other_frame_by_hand(statistic, expected):
    """Patches 1 and 3 of one frame and 2 and 4 of the other, in two heads: a head's similarities are products."""
    cues = GramCues(MotionConfig((Cue("a", "q", "q", (0,), statistic),), reference_depth=1), 1, "dot")
    q = jnp.array([[[1.0, 3.0], [2.0, 4.0]]])[..., None, None].repeat(2, axis=3)
    (sums,) = cues.add(cues.zeros(1, 2, 2), jnp.ones(1, int), q, q)
    assert np.allclose(sums[0], expected)


def test_clips_of_different_lengths_in_one_batch_have_the_sums_of_each_alone():
    """Frames of one clip lack sources that frames of the other have: weights are shared out among those of each."""
    cues, counts, frames = GramCues(MotionConfig(), 24), (9, 4), 9
    add = jax.jit(cues.add)
    q, k = np.random.default_rng(1).normal(size=(2, 2, frames, PATCHES, 2, 4)).astype(np.float32)
    ones = jnp.ones(5, int)
    both = add(cues.zeros(2, frames, PATCHES), ones, jnp.asarray(q), jnp.asarray(k), jnp.array(counts))
    for clip, count in enumerate(counts):
        one = [jnp.asarray(x[clip : clip + 1, :count]) for x in (q, k)]
        alone = add(cues.zeros(1, count, PATCHES), ones, *one)
        for expected, found in zip(alone, both, strict=True):
            assert np.allclose(found[clip, :count], expected[0], atol=1e-5)


def test_deviations_and_directions_by_hand():
    values = jnp.asarray([[[2.0, 3, 4, 7], [1, 1, 1, 1]]] * 3)
    assert np.allclose(_sample_std(values), np.std(values, axis=-1, ddof=1))
    assert np.isfinite(jax.grad(lambda x: _sample_std(x).sum())(jnp.ones((2, 3)))).all()
    assert np.allclose(_unit(jnp.asarray([[3.0, 4.0], [0.0, 0.0]])), [[0.6, 0.8], [0, 0]])


def test_an_unknown_similarity_is_refused():
    with pytest.raises(InputError, match="gram"):
        GramCues(MotionConfig(), DEPTH, "sine")  # pyright: ignore[reportArgumentType]


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
    made = normalise(jnp.asarray([[[1.0, 2.0, 3.0], [4.0, 4.0, 4.0], [0, 1e-6, 1e-6]]]))
    assert np.allclose(made, [[[0, 0.5, 1], [0, 0, 0], [0, 0.5, 0.5]]], atol=1e-5)
