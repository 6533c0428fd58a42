"""Camera head: camera tokens -> pose encoding, by iterative refinement (VGGT)."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float, Int

from vggtjax.config import VGGTConfig
from vggtjax.network.block import BlockLayer, PackedBlock
from vggtjax.network.heads.pose import POSE_SIZE, inverted_pose
from vggtjax.network.kernels.attention import attention
from vggtjax.network.kernels.frames import Frames
from vggtjax.network.layers import MLP, ZEROS, Dense, LayerNorm, Params, over_layers, repeated
from vggtjax.network.precision import full_precision

ITERATIONS = 4


@full_precision()
def predict_pose(
    params: Params,
    camera_tokens: Float[Array, "B S E"],
    config: VGGTConfig,
    *,
    frame_count: Int[Array, " B"] | None = None,
    stop_gradient: bool = True,
    compute_dtype: str | None = None,
    frames: Frames = Frames(),
) -> Float[Array, "B S 9"]:
    """Return the pose encoding [t(3), quaternion xyzw(4), fov_h, fov_w] of every frame.

    Args:
        params: the model's parameter tree (`camera_head` is read).
        camera_tokens: token 0 of every frame after the last pair, E = 2C.
        config: the model's configuration.
        frame_count: number of real frames of each clip, its first ones; None for all.
        stop_gradient: treat the previous estimate as a constant in each iteration, as in VGGT's training.
        compute_dtype: type of the products of the trunk's blocks; by default that of the tokens, as all else.
        frames: where the frames are; every device computes the poses of all frames, which takes little.
    """
    head = camera_head(config, stop_gradient, compute_dtype)
    return head.apply({"params": params["camera_head"]}, camera_tokens, frame_count, frames)  # type: ignore


def camera_head(config: VGGTConfig, stop_gradient: bool = True, compute_dtype: str | None = None) -> nn.Module:
    """Return the module of the family's camera head."""
    if config.row.direct_cameras:
        return CameraDecoder(config)
    return CameraHead(config, stop_gradient, compute_dtype)


class CameraDecoder(nn.Module):
    """Each frame's camera from its own token, as camera-to-world, inverted (Depth Anything 3)."""

    config: VGGTConfig

    @nn.compact
    def __call__(self, camera_tokens: Float[Array, "B S E"], *_: Any) -> Float[Array, "B S 9"]:
        """Return the pose encoding of every frame."""
        x = camera_tokens
        for name in ("fc1", "fc2"):
            x = nn.relu(Dense(self.config.tap_dim, name=name)(x))
        start = {"translation": (0.0,) * 3, "quaternion": (0.0, 0.0, 0.0, 1.0), "field_of_view": (1.0,) * 2}
        t, q, fov = (Dense(len(bias), gain=0.1, bias_start=bias, name=name)(x) for name, bias in start.items())
        return inverted_pose(jnp.concatenate([t, q, nn.relu(fov)], axis=-1))


class CameraHead(nn.Module):
    """Iterations of a transformer over frames, modulated by the previous estimate; arguments as `predict_pose`."""

    config: VGGTConfig
    stop_gradient: bool = True
    compute_dtype: str | None = None

    @nn.compact
    def __call__(
        self,
        camera_tokens: Float[Array, "B S E"],
        frame_count: Int[Array, " B"] | None = None,
        frames: Frames = Frames(),
    ) -> Float[Array, "B S 9"]:
        """Return the pose encoding of every frame."""
        config = self.config
        S = camera_tokens.shape[1]
        is_real = frames.are_real(frame_count, *camera_tokens.shape[:2])
        is_real = None if is_real is None else frames.gather(is_real)
        camera_tokens = frames.gather(camera_tokens)
        E = config.tap_dim
        tokens = LayerNorm(name="token_norm")(camera_tokens)
        normed = LayerNorm(1e-6, use_bias=False, use_scale=False)(tokens)
        empty = self.param("empty_pose", ZEROS, (1, 1, POSE_SIZE))
        empty = jnp.broadcast_to(empty, (*tokens.shape[:2], POSE_SIZE)).astype(tokens.dtype)
        embed, modulate = Dense(E, name="pose_embedding"), Dense(3 * E, name="modulation")
        dtype = jnp.dtype(self.compute_dtype or camera_tokens.dtype)
        block = PackedBlock(config.camera_num_heads, dtype=dtype, name="trunk")
        trunk = over_layers(BlockLayer, config.camera_depth)(block, partial(attention, visible=is_real))
        norm = LayerNorm(name="trunk_norm")
        start = tuple(number / ITERATIONS for number in (0, 0, 0, 0, 0, 0, 1, 1, 1))  # every iteration adds it
        update = MLP(E // 2, POSE_SIZE, gain=0.1, bias_start=start, name="pose_branch")

        def iteration(estimates):
            pose, previous = estimates  # sum of all updates so far; input of this iteration
            shift, scale, gate = jnp.split(modulate(nn.silu(embed(previous))), 3, axis=-1)
            x = tokens + gate * (normed * (1 + scale) + shift)
            x, _ = trunk(x)
            pose = pose + update(norm(x))
            return (pose, jax.lax.stop_gradient(pose) if self.stop_gradient else pose)

        pose, _ = repeated(self, iteration, (jnp.zeros_like(empty), empty), ITERATIONS)
        pose = frames.share(pose, S)
        return jnp.concatenate([pose[..., :7], nn.relu(pose[..., 7:])], axis=-1)
