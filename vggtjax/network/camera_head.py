"""Camera head: camera tokens -> pose encoding, by iterative refinement (VGGT)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float, Int

from vggtjax.config import VGGTConfig
from vggtjax.network.block import Block
from vggtjax.network.frames import Frames
from vggtjax.network.layers import MLP, Dense, LayerNorm, Params, apply, declare
from vggtjax.network.pose import POSE_SIZE
from vggtjax.network.precision import full_precision

ITERATIONS = 4


@full_precision
def predict_pose(
    params: Params,
    camera_tokens: Float[Array, "B S E"],
    config: VGGTConfig,
    *,
    frame_count: Int[Array, " B"] | None = None,
    stop_gradient: bool = True,
    frames: Frames = Frames(),
) -> Float[Array, "B S 9"]:
    """Return the pose encoding [t(3), quaternion xyzw(4), fov_h, fov_w] of every frame.

    Args:
        params: the model's parameter tree (`camera_head` is read).
        camera_tokens: token 0 of every frame after the last pair, E = 2C.
        config: the model's configuration.
        frame_count: number of real frames of each clip, its first ones; None for all.
        stop_gradient: treat the previous estimate as a constant in each iteration, as in VGGT's training.
        frames: where the frames are; every device computes the poses of all frames, which takes little.
    """
    params = params["camera_head"]
    S = camera_tokens.shape[1]
    is_real = frames.are_real(frame_count, *camera_tokens.shape[:2])
    is_real = None if is_real is None else frames.gather(is_real)
    camera_tokens = frames.gather(camera_tokens)
    E = config.tap_dim
    block = Block(config.camera_num_heads, dtype=camera_tokens.dtype)
    tokens = apply(LayerNorm(), params["token_norm"], camera_tokens)
    normed = apply(LayerNorm(1e-6, use_bias=False, use_scale=False), {}, tokens)
    empty = jnp.broadcast_to(params["empty_pose"], (*tokens.shape[:2], POSE_SIZE)).astype(tokens.dtype)

    def iteration(estimates, _):
        pose, previous = estimates  # sum of all updates so far; input of this iteration
        embedded = apply(Dense(E), params["pose_embedding"], previous)
        modulation = apply(Dense(3 * E), params["modulation"], nn.silu(embedded))
        shift, scale, gate = jnp.split(modulation, 3, axis=-1)
        x = tokens + gate * (normed * (1 + scale) + shift)
        x, _ = jax.lax.scan(lambda x, layer: (block(layer, x, is_real=is_real)[0], None), x, params["trunk"])
        x = apply(LayerNorm(), params["trunk_norm"], x)
        pose = pose + apply(_branch(config), params["pose_branch"], x)
        return (pose, jax.lax.stop_gradient(pose) if stop_gradient else pose), None

    (pose, _), _ = jax.lax.scan(iteration, (jnp.zeros_like(empty), empty), length=ITERATIONS)
    pose = frames.share(pose, S)
    return jnp.concatenate([pose[..., :7], nn.relu(pose[..., 7:])], axis=-1)


def declare_camera_head(config: VGGTConfig) -> Params:
    """Declare the parameters of the camera head."""
    E = config.tap_dim
    x, pose = jnp.zeros((1, 1, E)), jnp.zeros((1, 1, POSE_SIZE))
    return {
        "token_norm": declare(LayerNorm(), x),
        "empty_pose": pose,
        "pose_embedding": declare(Dense(E), pose),
        "modulation": declare(Dense(3 * E), x),
        "trunk": Block(config.camera_num_heads).declare_stacked(config.camera_depth, E),
        "trunk_norm": declare(LayerNorm(), x),
        "pose_branch": declare(_branch(config), x),
    }


def _branch(config: VGGTConfig) -> MLP:
    return MLP(config.tap_dim // 2, POSE_SIZE)
