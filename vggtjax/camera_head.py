"""Camera head: camera tokens -> pose encoding, by iterative refinement (VGGT)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from vggtjax.config import VGGTConfig
from vggtjax.layers import MLP, Block, LayerNorm, Params, init_stacked
from vggtjax.pose import POSE_SIZE
from vggtjax.precision import full_precision

ITERATIONS = 4


@full_precision
def predict_pose(
    params: Params, camera_tokens: Float[Array, "B S E"], config: VGGTConfig, *, stop_gradient: bool = True
) -> Float[Array, "B S 9"]:
    """Return the pose encoding [t(3), quaternion xyzw(4), fov_h, fov_w] of every frame.

    Args:
        params: the model's parameter tree (`camera_head` is read).
        camera_tokens: token 0 of every frame after the last pair, E = 2C.
        config: the model's configuration.
        stop_gradient: whether each iteration sees the previous estimate as a constant, as in VGGT's training.
    """
    params = params["camera_head"]
    E = config.camera_dim
    block = Block(config.camera_num_heads)
    tokens = LayerNorm().apply({"params": params["token_norm"]}, camera_tokens)
    normed = LayerNorm(1e-6, use_bias=False, use_scale=False).apply({}, tokens)
    pose = None
    for _ in range(ITERATIONS):
        if pose is None:
            seen = jnp.broadcast_to(params["empty_pose"], (*tokens.shape[:2], POSE_SIZE))
        else:
            seen = jax.lax.stop_gradient(pose) if stop_gradient else pose
        embedded = nn.Dense(E).apply({"params": params["pose_embedding"]}, seen)
        modulation = nn.Dense(3 * E).apply({"params": params["modulation"]}, nn.silu(embedded))
        shift, scale, gate = jnp.split(jnp.asarray(modulation), 3, axis=-1)
        x = tokens + gate * (normed * (1 + scale) + shift)
        x, _ = jax.lax.scan(lambda x, layer: (block.apply({"params": layer}, x)[0], None), x, params["trunk"])
        x = LayerNorm().apply({"params": params["trunk_norm"]}, x)
        delta = _branch(config).apply({"params": params["pose_branch"]}, x)
        pose = delta if pose is None else pose + delta
    pose = jnp.asarray(pose)
    return jnp.concatenate([pose[..., :7], nn.relu(pose[..., 7:])], axis=-1)


def init_camera_head(key: Array, config: VGGTConfig) -> Params:
    """Return random parameters of the camera head."""
    keys = iter(jax.random.split(key, 6))
    E = config.camera_dim
    x, pose = jnp.zeros((1, 1, E)), jnp.zeros((1, 1, POSE_SIZE))
    return {
        "token_norm": LayerNorm().init(next(keys), x)["params"],
        "empty_pose": jnp.zeros((1, 1, POSE_SIZE)),
        "pose_embedding": nn.Dense(E).init(next(keys), pose)["params"],
        "modulation": nn.Dense(3 * E).init(next(keys), x)["params"],
        "trunk": init_stacked(Block(config.camera_num_heads), next(keys), config.camera_depth, x),
        "trunk_norm": LayerNorm().init(next(keys), x)["params"],
        "pose_branch": _branch(config).init(next(keys), x)["params"],
    }


def _branch(config: VGGTConfig) -> MLP:
    return MLP(config.camera_dim // 2, POSE_SIZE)
