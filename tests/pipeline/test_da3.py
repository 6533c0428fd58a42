"""The whole method on networks of the second family, Depth Anything 3."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.da3 import TINY, seeded_params
from tests.shared.seeded import seeded_images
from vggtjax import forward, init_params, load_clip, reconstruct
from vggtjax.errors import InputError
from vggtjax.network.checkpoint import Model
from vggtjax.network.heads.camera_encoder import as_read
from vggtjax.network.heads.pose import encode_pose
from vggtjax.pipeline.inputs import read_inputs
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.pipeline.run import read_cameras
from vggtjax.pipeline.running import Running
from vggtjax.pipeline.several import reconstruct_methods

GIANT = dataclasses.replace(TINY, gated_mlp=40, leading_global=True, heads=("camera", "depth"))
FRAMES, SIZE = 5, (56, 70)


@pytest.fixture(scope="module")
def model() -> Model:
    """Return the tiny model of the golden numbers."""
    return Model(TINY, seeded_params("tiny", 8), name="tiny")


@pytest.fixture(scope="module")
def clip():
    """Return five frames at the model's size."""
    images = seeded_images(FRAMES, *SIZE, 3).transpose(0, 2, 3, 1)
    return load_clip(images, mode="fit", size=70)


@pytest.fixture(scope="module")
def result(model, clip):
    """Return what the default method makes of them."""
    return reconstruct(model, clip, size=70)


def test_the_world_is_the_first_camera(result):
    assert result.depth.shape == (FRAMES, *SIZE)
    np.testing.assert_allclose(result.camera_from_world[0], np.eye(4)[:3], atol=1e-5)
    assert np.abs(result.camera_from_world[1] - np.eye(4)[:3]).max() > 1e-2


def test_the_reference_frame_is_told(model, clip, result):
    chosen = clip.frame_names.index(result.settings["reference_frame"])
    assert chosen > 0  # so that it differs from the first
    for reference, number in (("first", 0), ("middle", 2)):
        other = reconstruct(model, clip, size=70, reference=reference)
        assert other.settings["reference_frame"] == clip.frame_names[number]
        assert np.abs(other.depth - result.depth).max() > 1e-3
    moved = reconstruct(model, clip, size=70, attention="sampled")
    assert moved.settings["reference_frame"] == clip.frame_names[0]


def test_padded_frames_change_nothing(model, clip, result):
    padded = reconstruct(model, clip, size=70, pad_frames=True)
    assert padded.settings["reference_frame"] == result.settings["reference_frame"]
    np.testing.assert_allclose(padded.camera_from_world, result.camera_from_world, atol=1e-4)
    np.testing.assert_allclose(padded.depth, result.depth, rtol=2e-3)


@pytest.mark.parametrize("config", [TINY, GIANT], ids=["tiny", "giant"])
@pytest.mark.parametrize("attention", ["exact", "sampled"])
def test_clips_of_different_lengths_in_a_batch(config, attention):
    params = init_params(0, config)
    images = np.stack([seeded_images(FRAMES, *SIZE, seed).transpose(0, 2, 3, 1) for seed in range(2)])
    run = jax.jit(forward, static_argnames=("config", "attention"))
    alone = run(params, images[:1, :4], config, attention=attention)
    made = run(params, images, config, frame_count=np.array([4, 5]), attention=attention)
    np.testing.assert_allclose(made.depth[:1, :4], alone.depth, rtol=1e-3)
    np.testing.assert_allclose(made.pose_encoding[:1, :4], alone.pose_encoding, atol=1e-4)


def test_known_cameras_go_into_the_network(model, clip, result, tmp_path):
    poses, intrinsics = result.camera_from_world.astype(np.float64), result.intrinsics.astype(np.float64)
    centres = -np.einsum("sji,sj->si", poses[:, :, :3], poses[:, :, 3])
    world = np.tile(np.eye(4), (FRAMES, 1, 1))
    world[:, :3, :3], world[:, :3, 3] = poses[:, :, :3].swapaxes(1, 2), centres
    np.savetxt(tmp_path / "poses.txt", world.reshape(FRAMES, 16))
    K = intrinsics[0] * np.append(clip.source_scale[0], 1)[:, None]
    known = KnownGeometry(
        poses=str(tmp_path / "poses.txt"), intrinsics=",".join(map(str, K[[0, 1, 0, 1], [0, 1, 2, 2]]))
    )
    inputs = read_inputs(model, clip, size=70, masks=None, tracks=None, known=known, on_stage=Running().stage)
    cameras: Any = read_cameras(model, inputs)
    expected = encode_pose(jnp.asarray(poses), jnp.tile(jnp.asarray(intrinsics[:1]), (FRAMES, 1, 1)), SIZE)
    np.testing.assert_allclose(cameras, expected, atol=1e-4)
    made = reconstruct(model, clip, size=70, known=known)
    assert made.settings["cameras"] == "known, read by the network"
    assert np.abs(made.depth / result.depth - 1).max() > 1e-3
    without = dataclasses.replace(model, config=dataclasses.replace(TINY, camera_depth=0))
    with pytest.raises(InputError, match="cameras are given, and this network reads none"):
        forward(model.params, jnp.asarray(clip.images)[None], without.config, cameras=cameras[None])


def test_gradients(model, clip):
    cameras = jnp.asarray(np.random.default_rng(0).normal(size=(1, FRAMES, 9)), jnp.float32)
    assert jnp.isfinite(jax.grad(lambda x: as_read(x).sum())(cameras)).all()
    images = jnp.asarray(clip.images)[None, :3]

    def loss(params):
        made: Any = forward(params, images, TINY)
        return made.depth.mean()

    gradient = jax.jit(jax.grad(loss))(model.params)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert float(jnp.abs(gradient["tap_norm"]["scale"]).max()) > 0


def test_a_reference_is_for_networks_that_choose_one(model, clip, params, config):
    middle = reconstruct(model, clip, size=70, reference="middle")
    assert middle.settings["reference"] == "middle"
    with pytest.raises(InputError, match="reference is 'middle'; leave it out, as this network takes the first frame"):
        reconstruct(Model(config, params), clip, reference="middle")


@pytest.mark.filterwarnings("ignore:the field of view")
def test_several_methods_have_the_cameras_of_one(model, clip):
    """The network predicts cameras in a world of its own, which becomes the first camera's."""
    made = reconstruct_methods(model, clip, ["4dvggt-d"], size=70)["4dvggt-d"]
    np.testing.assert_allclose(made.camera_from_world[0], np.eye(3, 4), atol=1e-5)
    alone = reconstruct(model, clip, method="4dvggt-d", size=70)
    np.testing.assert_allclose(made.camera_from_world, alone.camera_from_world, rtol=1e-5, atol=1e-6)
