"""Batches and what is minimised: regions of suppressed keys and their effect; terms that can be computed by hand."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy import ndimage
from skimage.measure import label

from tests.shared.aggregation import aggregate
from tests.shared.da3 import TINY as DA3
from tests.shared.generated import QUICK, textures
from tests.shared.training_runs import CONFIG
from vggtjax.network.aggregator import identity
from vggtjax.network.backbone import encode, patch_grid
from vggtjax.network.heads.camera_head import predict_pose
from vggtjax.network.model import init_params
from vggtjax.network.suppression import Suppression
from vggtjax.training.data import make_batch, random_regions
from vggtjax.training.objective import LossWeights, _flow_moments, init_probes, objective
from vggtjax.training.recipe import Phase
from vggtjax.training.truth import targets

PHASE = Phase(1, 4, (2,), 28, 28, motion=(0.5, 1.0))
WEIGHTS = LossWeights(depth=0, points=0, match=1, match_layers=(1,), probe=1, moments=1)

render = jax.jit(make_batch, static_argnums=(2, 3, 4), compiler_options=QUICK)


def drawn(phase, key=0, frames=2):
    return render(jax.random.key(key), textures(), phase, frames, CONFIG.patch_size)


@pytest.fixture(scope="module")
def batch():
    return drawn(dataclasses.replace(PHASE, suppressed=0.5, suppressed_pairs=(0.5, 0.75)))


@pytest.fixture(scope="module")
def trained():
    probes = jax.tree.map(lambda leaf: leaf + 0.01, init_probes(0, CONFIG))
    return {"model": init_params(0, CONFIG), "probes": probes}


@partial(jax.jit, compiler_options=QUICK)
def terms(trained, batch):
    return objective(trained, batch, CONFIG, WEIGHTS)[1]


def test_regions_are_compact_and_move():
    """At most two pieces, up to the area of two ellipses of the largest axes; the centres move at constant speed."""
    draw = jax.jit(jax.vmap(lambda key: random_regions(key, 5, 48, 64)))
    regions = np.asarray(draw(jax.random.split(jax.random.key(0), 64)))
    assert regions.shape == (64, 5, 48, 64)
    assert max(np.asarray(label(frame)).max() for clip in regions for frame in clip) == 2
    shares = regions.mean(axis=(2, 3))
    assert 0.05 < shares.mean() < 0.35
    assert shares.max() < 2 * 0.7**2
    assert np.mean(np.any(regions[:, 0] != regions[:, -1], axis=(1, 2))) > 0.95
    rims = regions[:, :, [0, -1]].any((1, 2, 3)) | regions[..., [0, -1]].any((1, 2, 3))
    alone = regions[regions.any((2, 3)).all(-1) & ~rims]
    centres = np.array([[ndimage.center_of_mass(frame) for frame in clip] for clip in alone])
    assert len(alone) > 2
    assert np.abs(np.diff(centres, 2, axis=1)).max() < 1.5


def test_a_share_of_clips_has_regions_and_the_clips_stay_the_same(batch):
    plain = drawn(PHASE)
    assert plain.regions is None
    for one, other in zip(plain.clips, batch.clips, strict=True):  # two programs: a ray may pass an edge
        assert np.mean(np.isclose(one, other, atol=1e-4)) > 0.99
    assert 1 <= int(batch.regions.any((1, 2, 3)).sum()) <= 3
    assert 0.5 <= float(batch.pairs.min()) == float(batch.pairs.max()) <= 0.75


@pytest.mark.parametrize("suppress", ["zero", pytest.param("drop", marks=pytest.mark.proof)])
def test_the_objective_suppresses_keys_as_a_second_pass_does(batch, trained, suppress):
    """The camera loss is that of the network's own suppressed pass."""
    batch = dataclasses.replace(batch, suppress=suppress)
    model, clips = trained["model"], batch.clips
    pairs = int(np.ceil(float(batch.pairs[0]) * CONFIG.depth))
    middle = slice(CONFIG.patch_size // 2, None, CONFIG.patch_size)
    tokens = jnp.asarray(np.asarray(batch.regions)[:, :, middle, middle])
    assert tokens.any()

    @partial(jax.jit, compiler_options=QUICK)
    def translation_loss(tokens):
        patches = encode(model, clips.images, CONFIG)
        grid = patch_grid(clips.images, CONFIG)
        suppression = Suppression(tokens, suppress, pairs)
        captures = [identity] * len(CONFIG.taps)
        camera, _, _ = aggregate(model, patches, CONFIG, grid, captures=captures, suppression=suppression)
        error = jnp.abs(predict_pose(model, camera, CONFIG) - targets(clips).pose_encoding)
        return error[..., :3].sum(axis=-1).mean()

    found = float(terms(trained, batch)["loss_translation"])
    assert found == pytest.approx(float(translation_loss(tokens)), rel=1e-5)
    assert abs(float(translation_loss(jnp.zeros_like(tokens))) - found) > 1e-5


def test_moments_of_the_flow_by_hand():
    place = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]], np.float32)[None, None]
    flow = np.zeros((1, 2, 4, 2), np.float32)
    flow[0, 1] = [[0.2, 0.0], [0.4, 0.0], [0.2, -0.1], [9.0, 9.0]]
    depth_inverse = np.array([1.0, 2.0, 10.0, 1.0], np.float32)  # 10 counts as 4
    seen = np.array([True, True, True, False])  # the flow of what is not seen does not count
    made, known = _flow_moments(
        jnp.asarray(flow),
        jnp.asarray(place),
        jnp.broadcast_to(jnp.asarray(depth_inverse), (1, 2, 4)),
        jnp.broadcast_to(jnp.asarray(seen)[None, None, :, None], (1, 2, 4, 1)),
    )
    expected = [
        [0.8 / 3, -0.1 / 3],  # flow
        [(0.2 + 0.8 + 0.8) / 3, -0.4 / 3],  # times inverse depth
        [(-0.1 + 0.2 - 0.1) / 3, 0.05 / 3],  # times x
        [(-0.1 - 0.2 + 0.1) / 3, -0.05 / 3],  # times y
        [7 / 3, 21 / 3],  # inverse depth and its square
    ]
    assert np.allclose(made[0, 1], np.ravel(expected), atol=1e-6)
    assert np.allclose(made[0, 0, :8], 0)
    assert known.all()


def test_moments_of_too_few_patches_are_not_known():
    seen = np.zeros((1, 1, 4, 1), bool)
    seen[0, 0, :2] = True
    zeros = jnp.zeros((1, 1, 4, 2))
    made, known = _flow_moments(zeros, zeros, jnp.ones((1, 1, 4)), jnp.asarray(seen))
    assert not known.any()
    assert np.isfinite(made).all()


def test_known_cameras_are_read_and_their_encoder_learns():
    """The loss depends on the encoder where it is read, and on no unit of length; else the encoder has no gradient."""
    config = dataclasses.replace(DA3, image_size=28)
    trained = {"model": init_params(0, config), "probes": init_probes(0, config)}
    batch = dataclasses.replace(drawn(PHASE, frames=3), known_cameras=True)  # two frames have no unit of length

    @partial(jax.jit, compiler_options=QUICK)
    def gradient(model, batch):
        def loss(model):
            return objective(trained | {"model": model}, batch, config, LossWeights(depth=0, points=0))[0]

        value, slope = jax.value_and_grad(loss)(model)
        return value, optax.tree.norm(slope["camera_encoder"])

    loss, slope = gradient(trained["model"], batch)
    assert slope > 0
    unit = jnp.array([[[[1, 1, 1, 100.0]]]])
    larger = batch.clips._replace(camera_from_world=batch.clips.camera_from_world * unit, depth=100 * batch.clips.depth)
    again, _ = gradient(trained["model"], dataclasses.replace(batch, clips=larger))
    assert float(again) == pytest.approx(float(loss), rel=1e-4)
    plain, slope = gradient(trained["model"], dataclasses.replace(batch, known_cameras=False))
    assert plain != loss
    assert slope == 0
