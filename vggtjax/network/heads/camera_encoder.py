"""Known cameras -> the camera tokens of their frames (Depth Anything 3)."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from vggtjax.config import VGGTConfig
from vggtjax.network.backbone import ClipBatch
from vggtjax.network.block import BlockLayer, PackedBlock
from vggtjax.network.heads.pose import inverted_pose, matrix_to_quaternion, quaternion_to_matrix
from vggtjax.network.kernels.attention import attention
from vggtjax.network.kernels.frames import Frames
from vggtjax.network.layers import MLP, LayerNorm, Params, over_layers

_LEAST_SCALE = 0.1  # of the scene, in units of the given cameras


class CameraEncoder(nn.Module):
    """A transformer over the frames' cameras, as camera-to-world."""

    config: VGGTConfig
    compute_dtype: str = "float32"

    @nn.compact
    def __call__(
        self, cameras: Float[Array, "B S 9"], visible: Bool[Array, "B S"] | None = None
    ) -> Float[Array, "B S C"]:
        """Return each frame's camera token; `visible` frames are real."""
        config = self.config
        C = config.embed_dim
        x = LayerNorm(name="token_norm")(MLP(C // 2, C, name="pose_branch")(cameras))
        block = PackedBlock(config.camera_num_heads, dtype=jnp.dtype(self.compute_dtype), name="trunk")
        x, _ = over_layers(BlockLayer, config.camera_depth)(block, partial(attention, visible=visible))(x)
        return LayerNorm(name="trunk_norm")(x)


def encode_cameras(
    params: Params, clips: ClipBatch, config: VGGTConfig, *, compute_dtype: str = "float32", frames: Frames = Frames()
) -> Float[Array, "B S C"]:
    """Return the camera tokens of clips with known cameras; every device computes those of all frames."""
    given = frames.gather(jnp.asarray(clips.cameras))
    B, S = clips.images.shape[:2]
    real = frames.are_real(clips.frame_count, B, S)
    real = None if real is None else frames.gather(real)
    tokens = CameraEncoder(config, compute_dtype).apply(
        {"params": params["camera_encoder"]}, as_read(given, real), real
    )
    return frames.share(tokens, S)  # type: ignore


def as_read(cameras: Float[Array, "B S 9"], real: Bool[Array, "B S"] | None = None) -> Float[Array, "B S 9"]:
    """Return cameras as the network reads them: camera-to-world, relative to the first, in units of the scene.

    The unit is the median distance of the camera centres from the first (the lower one of two middle ones), at least
    0.1. Quaternions have a real part of at least 0.
    """
    rotation, centres = quaternion_to_matrix(cameras[..., 3:7]), inverted_pose(cameras)[..., :3]
    relative = jnp.einsum("bij,bskj->bsik", rotation[:, 0], rotation)
    moved = jnp.einsum("bij,bsj->bsi", rotation[:, 0], centres - centres[:, :1])
    squares = jnp.sum(moved * moved, axis=-1)  # 0 in the first frame, where the root has no gradient
    distances = jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1)), 0)
    count = jnp.full(len(cameras), cameras.shape[1]) if real is None else real.sum(axis=1)
    ordered = jnp.sort(distances if real is None else jnp.where(real, distances, jnp.inf), axis=1)
    median = jnp.take_along_axis(ordered, ((count - 1) // 2)[:, None], axis=1)
    moved = moved / jnp.maximum(median, _LEAST_SCALE)[..., None]
    return jnp.concatenate([moved, matrix_to_quaternion(relative), cameras[..., 7:]], axis=-1)
