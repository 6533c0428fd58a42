"""The network against numbers of the public PyTorch code: plain, drop and zero passes; tokens, poses, depth, points."""

import dataclasses
import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.seeded import seeded_images
from vggtjax import decode_pose, encode, encode_pose, forward
from vggtjax.network.aggregator import aggregate, identity

TOLERANCE = 1e-4  # of each array's standard deviation; measured: 1e-6 (poses) to 3e-5 (points)

_forward = jax.jit(forward, static_argnames=("config", "suppress", "outputs"))


def assert_close(made, golden: np.ndarray) -> None:
    error = np.abs(np.asarray(made).reshape(golden.shape) - golden).max() / golden.std()
    assert error <= TOLERANCE


class Case:
    def __init__(self, path, seeded_params, config):
        self.arrays = np.load(path)
        meta = json.loads(str(self.arrays["meta"]))
        self.params, self.config = seeded_params(meta["seed"]), config
        self.size = (meta["height"], meta["width"])
        images = [seeded_images(meta["frames"], *self.size, meta["seed"] + b) for b in range(meta["batch"])]
        self.images = np.stack(images).transpose(0, 1, 3, 4, 2)
        p = config.patch_size
        h, w = self.size[0] // p, self.size[1] // p
        self.tokens = self.arrays["masks"].reshape(meta["batch"], meta["frames"], h, p, w, p).any(axis=(3, 5))


@pytest.fixture(scope="module", params=["single", "frames4", "batch2"])
def case(request, golden, seeded_params, config):
    return Case(golden / f"forward_{request.param}.npz", seeded_params, config)


def test_plain_pass(case):
    made = _forward(case.params, case.images, case.config, outputs=("camera", "depth", "points"))
    for name, golden in {
        "pose_encoding": "pose_enc",
        "depth": "depth",
        "depth_confidence": "depth_conf",
        "world_points": "world_points",
        "world_points_confidence": "world_points_conf",
    }.items():
        assert_close(getattr(made, name), case.arrays[f"plain/{golden}"])
    extrinsic, intrinsic = decode_pose(made.pose_encoding, case.size)
    assert_close(extrinsic, case.arrays["plain/extrinsic"])
    assert np.allclose(intrinsic, case.arrays["plain/intrinsic"], rtol=1e-4)


@pytest.mark.parametrize("name", ["frames4", "batch2"])
def test_tracks(golden, seeded_params, config, name):
    case = Case(golden / f"forward_{name}.npz", seeded_params, config)
    queries = case.arrays["queries"]
    made = _forward(case.params, case.images, case.config, outputs=("tracks",), query_points=queries)
    for value, key, tolerance in (
        (made.tracks, "track", 2e-3),  # pixels
        (made.track_visibility, "vis", 2e-4),
        (made.track_confidence, "conf", 2e-4),
    ):
        assert np.abs(np.asarray(value) - case.arrays[f"plain/{key}"]).max() <= tolerance


@pytest.mark.parametrize("suppress", ["drop", "zero"])
def test_mask_aware_pass(case, suppress):
    made = _forward(case.params, case.images, case.config, dynamic_tokens=case.tokens, suppress=suppress)
    assert_close(made.pose_encoding, case.arrays[f"{suppress}/pose_enc"])
    assert_close(made.depth, case.arrays[f"{suppress}/depth"])
    assert_close(made.depth_confidence, case.arrays[f"{suppress}/depth_conf"])


def test_pose_codec(case):
    extrinsic, intrinsic = case.arrays["plain/extrinsic"], case.arrays["plain/intrinsic"]
    made = np.asarray(encode_pose(extrinsic, intrinsic, case.size))
    assert_close(decode_pose(jnp.asarray(made), case.size)[0], extrinsic)
    golden = case.arrays["plain/pose_enc_roundtrip"]
    valid = case.arrays["plain/pose_enc"][..., 7:] > 0  # arctan of an infinite focal length, fields beyond pi
    assert_close(made[..., :7], golden[..., :7])
    fov = np.where(made[..., 7:] > np.pi, made[..., 7:] - 2 * np.pi, made[..., 7:])  # the golden uses atan, not atan2
    assert np.allclose(fov[valid], golden[..., 7:][valid], atol=1e-5)


def test_tokens(golden, seeded_params, config):
    case = Case(golden / "forward_frames4.npz", seeded_params, config)
    patch_tokens = jax.jit(partial(encode, config=config))(case.params, case.images)
    assert_close(patch_tokens, case.arrays["plain/patch_tokens"])
    layers = (4, 11, 17, 23)
    for taps in (layers, (0, *layers[1:])):  # layer 0 is not a tap of the model, but a tap can be anywhere
        run = partial(
            aggregate,
            config=dataclasses.replace(config, taps=taps),
            grid=case.tokens.shape[2:],
            captures=[identity] * 4,
        )
        camera, tokens, _ = jax.jit(run)(case.params, patch_tokens)
        for layer, made in zip(taps, tokens, strict=True):
            assert_close(made, case.arrays[f"plain/tokens_{layer}"])
        assert_close(camera, case.arrays["plain/tokens_23"][:, :, 0])
