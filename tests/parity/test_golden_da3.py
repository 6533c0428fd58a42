"""Depth Anything 3 against numbers of its public PyTorch code: passes, tokens, the reference frame, known cameras."""

import functools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.aggregation import aggregate
from tests.shared.da3 import GoldenPass
from tests.shared.golden import spread_error
from vggtjax import decode_pose, encode, forward
from vggtjax.errors import InputError
from vggtjax.network.aggregator import identity, reference_frame
from vggtjax.network.backbone import ClipBatch
from vggtjax.network.heads.camera_encoder import as_read, encode_cameras
from vggtjax.network.heads.pose import encode_pose, inverted_pose
from vggtjax.network.model import tap_patches
from vggtjax.network.precision import Compute

golden_pass = functools.cache(GoldenPass)
OUTPUTS = ("camera", "depth", "rays")
TOLERANCES = {  # in standard deviations: what the public code's own rounding moves
    "pose_enc": 1e-5,
    "extrinsics": 3e-5,
    "intrinsics": 1e-5,
    "depth": 1e-4,
    "depth_conf": 1e-4,
    "ray": 1e-4,
    "ray_conf": 1e-4,
}
_forward = jax.jit(forward, static_argnames=("config", "suppress", "outputs", "reference", "compute_dtype"))


def assert_equal(case: GoldenPass, kind: str, **changes) -> None:
    made = _forward(case.params, case.images, case.config, outputs=OUTPUTS, **changes)
    extrinsics, intrinsics = decode_pose(made.pose_encoding, case.size)
    found = {
        "pose_enc": inverted_pose(made.pose_encoding),
        "extrinsics": extrinsics,
        "intrinsics": intrinsics,
        "depth": made.depth,
        "depth_conf": made.depth_confidence,
        "ray": made.rays,
        "ray_conf": made.rays_confidence,
    }
    names = [name for name in found if f"{kind}/{name}" in case.arrays]
    assert "pose_enc" in names
    for name in names:
        assert spread_error(found[name], case.arrays[f"{kind}/{name}"]) <= TOLERANCES[name], name


@pytest.mark.parametrize("name", ["frames5", "batch2", "two", "single"])
@pytest.mark.parametrize("kind", ["plain", "zero", "drop"])
def test_passes(name, kind):
    case = golden_pass(f"forward_{name}")
    changes = {} if kind == "plain" else {"dynamic_tokens": case.tokens, "suppress": kind}
    assert_equal(case, kind, **changes)


@pytest.mark.parametrize("reference", ["first", "middle"])
def test_other_references(reference):
    assert_equal(golden_pass("forward_frames5"), reference, reference=reference)


def test_small_at_full_size():
    assert_equal(golden_pass("small_frames3"), "plain")


@pytest.mark.parametrize("name", ["forward_frames5", "forward_batch2", "small_frames3"])
def test_the_reference_is_chosen_by_class_tokens(name):
    case = golden_pass(name)
    tokens = jax.jit(partial(encode, config=case.config))(case.params, case.images).class_tokens
    assert spread_error(tokens, case.arrays["reference/cls"]) <= 1e-5
    assert reference_frame(tokens).tolist() == case.arrays["reference/index"].tolist()
    real = jnp.ones(tokens.shape[:2], bool)
    padded = jnp.concatenate([tokens, jnp.full_like(tokens, 7.0)], axis=1)
    is_real = jnp.concatenate([real, ~real], axis=1)
    assert reference_frame(padded, is_real).tolist() == case.arrays["reference/index"].tolist()
    assert reference_frame(padded, is_real, Compute(reference="middle")).tolist() == [tokens.shape[1] // 2] * len(
        tokens
    )
    assert reference_frame(tokens[:, :2]).tolist() == [0] * len(tokens)


@pytest.mark.parametrize("kind", ["plain", "zero", "drop"])
def test_tokens(kind):
    """In the clip's own order; the public code has the reference first."""
    case, arrays = golden_pass("forward_frames5"), golden_pass("forward_frames5").arrays
    B, S = case.images.shape[:2]
    grid, order = case.tokens.shape[2:], arrays["reference/order"][0]
    features = jax.jit(partial(encode, config=case.config))(case.params, case.images)
    assert spread_error(features.patch_tokens[:, order], arrays["plain/tokens_base"][:, :, 1:]) <= 1e-5

    class Kept:
        """An accumulator that keeps q and k of every pair."""

        def layer_counts(self):
            return np.eye(case.config.depth, dtype=int)

        def zeros(self, B, S, P):
            return jnp.zeros((2, case.config.depth, B, S, 1 + P, 2, 16))

        def add(self, sums, counts, q, k, frame_count):
            return sums + counts[None, :, None, None, None, None, None] * jnp.stack([q, k])[:, None]

    from vggtjax.network.suppression import Suppression

    suppression = Suppression() if kind == "plain" else Suppression(jnp.asarray(case.tokens), kind)
    run = partial(
        aggregate,
        config=case.config,
        grid=grid,
        captures=[identity] * 4,
        accumulator=Kept() if kind == "plain" else None,
        suppression=suppression,
    )
    camera, taps, sums = jax.jit(run)(case.params, features)
    for pair, tap in enumerate(taps):
        for half, block in zip(jnp.split(tap, 2, axis=-1), (4 + 2 * pair, 5 + 2 * pair), strict=True):
            if f"{kind}/tokens_block{block}" in arrays:
                assert spread_error(half[:, order], arrays[f"{kind}/tokens_block{block}"]) <= 1e-5
        if kind == "plain":
            dense = tap_patches(case.params, tap, case.config)
            assert spread_error(dense, arrays[f"plain/tap{5 + 2 * pair}"]) <= 1e-5
            for name, kept in zip("qk", sums, strict=True):
                made = kept[pair][:, order].reshape(B, -1, 2, 16).swapaxes(1, 2)
                assert spread_error(made, arrays[f"plain/{name}_block{5 + 2 * pair}"]) <= 1e-5
    if kind == "plain":
        assert spread_error(camera, arrays["plain/camera_feat"]) <= 1e-5
    assert S == 5


def test_known_cameras():
    case, arrays = golden_pass("forward_posed"), golden_pass("forward_posed").arrays
    cameras = encode_pose(arrays["input/extrinsics"][..., :3, :], arrays["input/intrinsics"], case.size)
    assert spread_error(as_read(cameras), arrays["input/pose_enc"]) <= 1e-5
    clips = ClipBatch(jnp.asarray(case.images), cameras=cameras)
    assert spread_error(encode_cameras(case.params, clips, case.config), arrays["plain/camera_token"]) <= 1e-5
    assert_equal(case, "plain", cameras=cameras)
    with pytest.raises(InputError, match=r"cameras have shape \(1, 3, 9\); expected \(1, 4, 9\)"):
        forward(case.params, clips.images, case.config, cameras=cameras[:, :3])


def test_bfloat16():
    """The blocks' products have three digits; reference frame and masks are as in float32."""
    case = golden_pass("forward_frames5")
    made = _forward(case.params, case.images, case.config, compute_dtype="bfloat16", reference="first")
    assert spread_error(inverted_pose(made.pose_encoding), case.arrays["first/pose_enc"]) <= 0.02
    assert spread_error(made.depth, case.arrays["first/depth"]) <= 0.1
