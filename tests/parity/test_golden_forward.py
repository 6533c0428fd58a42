"""The network against numbers of the public PyTorch code: plain, drop and zero passes; tokens, poses, depth, points."""

import dataclasses
import functools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.aggregation import aggregate
from tests.shared.golden import FORWARD, OUTPUTS, TOLERANCE, GoldenPass, spread_error
from vggtjax import decode_pose, encode, forward
from vggtjax.network.aggregator import identity
from vggtjax.network.heads.pose import encode_pose

golden_pass = functools.cache(GoldenPass)
_forward = jax.jit(forward, static_argnames=("config", "suppress", "outputs"))


def assert_close(made, golden: np.ndarray) -> None:
    assert spread_error(made, golden) <= TOLERANCE


PROOFS = [pytest.param(name, marks=pytest.mark.proof) for name in FORWARD if name != "batch2"]


@pytest.fixture(scope="module", params=["batch2", *PROOFS])
def case(request):
    return golden_pass(request.param)


def test_plain_pass(case):
    made = _forward(case.params, case.images, case.config, outputs=("camera", "depth", "points"))
    for name, golden in OUTPUTS.items():
        assert_close(getattr(made, name), case.arrays[f"plain/{golden}"])
    extrinsic, intrinsic = decode_pose(made.pose_encoding, case.size)
    assert_close(extrinsic, case.arrays["plain/extrinsic"])
    assert np.allclose(intrinsic, case.arrays["plain/intrinsic"], rtol=1e-4)


def test_tracks():
    case = golden_pass("batch2")
    queries = case.arrays["queries"]
    made = _forward(case.params, case.images, case.config, outputs=("tracks",), query_points=queries)
    for value, key, tolerance in (
        (made.tracks, "track", 2e-3),  # pixels
        (made.track_visibility, "vis", 2e-4),
        (made.track_confidence, "conf", 2e-4),
    ):
        assert np.abs(np.asarray(value) - case.arrays[f"plain/{key}"]).max() <= tolerance


@pytest.mark.parametrize(
    ("name", "suppress"),
    [("frames4", "drop"), ("batch2", "zero"), pytest.param("frames4", "zero", marks=pytest.mark.proof)],
)
def test_mask_aware_pass(name, suppress):
    case = golden_pass(name)
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


@pytest.mark.proof
def test_tokens():
    case = golden_pass("frames4")
    features = jax.jit(partial(encode, config=case.config))(case.params, case.images)
    assert features.class_tokens is None
    assert_close(features.patch_tokens, case.arrays["plain/patch_tokens"])
    layers = (0, 4, 11, 23)  # layer 0 is not a tap of the model, but a tap can be anywhere
    run = partial(
        aggregate,
        config=dataclasses.replace(case.config, taps=layers),
        grid=case.tokens.shape[2:],
        captures=[identity] * len(layers),
    )
    camera, tokens, _ = jax.jit(run)(case.params, features)
    for layer, made in zip(layers, tokens, strict=True):
        assert_close(made, case.arrays[f"plain/tokens_{layer}"])
    assert_close(camera, case.arrays["plain/tokens_23"][:, :, 0])
