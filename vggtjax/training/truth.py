"""What the network should have said: the truth of generated clips in the network's own terms."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.network.pose import encode_pose
from vggtjax.network.precision import full_precision
from vggtjax.scenes.render import SyntheticClip

OCCLUDED = 0.03  # relative depth by which a point may lie behind what its target pixel shows


class Targets(NamedTuple):
    """Truth in the first camera's frame, in units of the mean distance of the clip's points from that camera."""

    pose_encoding: Float[Array, "B S 9"]
    depth: Float[Array, "B S H W"]
    points: Float[Array, "B S H W 3"]


class Matches(NamedTuple):
    """Where the centre of every patch of frame r is seen in frame s."""

    position: Float[Array, "B R S P 2"]  # x, y in [-1, 1] over the image, up to 2 beyond its edge
    patch: Int[Array, "B R S P"]
    visible: Bool[Array, "B R S P"]


@full_precision
def targets(clip: SyntheticClip) -> Targets:
    """Return the truth that the heads regress, normalised as in VGGT: first camera, mean point distance 1."""
    H, W = clip.depth.shape[-2:]
    first_from_world = _square(clip.camera_from_world[:, :1])
    camera_from_first = _square(clip.camera_from_world) @ jnp.linalg.inv(first_from_world)
    points = _unproject(clip.depth, clip.intrinsics)
    first_from_camera = jnp.linalg.inv(camera_from_first)
    points = jnp.einsum("bsij,bshwj->bshwi", first_from_camera[..., :3, :3], points)
    points = points + first_from_camera[:, :, None, None, :3, 3]
    scale = jnp.linalg.norm(points, axis=-1).mean(axis=(1, 2, 3))  # [B]
    translation = camera_from_first[..., :3, 3:] / scale[:, None, None, None]
    camera = jnp.concatenate([camera_from_first[..., :3, :3], translation], axis=-1)
    return Targets(
        encode_pose(camera, clip.intrinsics, (H, W)),
        clip.depth / scale[:, None, None, None],
        points / scale[:, None, None, None, None],
    )


@full_precision
def matches(clip: SyntheticClip, patch_size: int) -> Matches:
    """Return, for every pair of frames, where patch centres of one are seen in the other; things that move included."""
    B, S, H, W = clip.depth.shape
    h, w = H // patch_size, W // patch_size
    centre = np.s_[..., patch_size // 2 :: patch_size, patch_size // 2 :: patch_size]
    points = _unproject(clip.depth, clip.intrinsics)[:, :, patch_size // 2 :: patch_size, patch_size // 2 :: patch_size]
    points = points.reshape(B, S, h * w, 3)
    parts = clip.part_ids[centre].reshape(B, S, h * w)
    world_from_camera = jnp.linalg.inv(_square(clip.camera_from_world))
    world = jnp.einsum("brij,brpj->brpi", world_from_camera[..., :3, :3], points) + world_from_camera[:, :, None, :3, 3]
    part_from_world = jnp.linalg.inv(_square(clip.world_from_part))  # [B, S, K, 4, 4]
    moved = _square(clip.world_from_part)[:, None] @ part_from_world[:, :, None]  # [B, R, S, K, 4, 4]
    one_hot = (parts[..., None] == jnp.arange(moved.shape[3])[None, None, None]).astype(jnp.float32)  # [B, R, P, K]
    to_camera = _square(clip.camera_from_world)[:, None, :, None] @ moved
    own = jnp.einsum("brpk,brskij->brspij", one_hot, to_camera)
    seen = jnp.einsum("brspij,brpj->brspi", own[..., :3, :3], world) + own[..., :3, 3]
    z = jnp.maximum(seen[..., 2], 1e-3)
    focal = clip.intrinsics[:, None, :, None, 0, 0], clip.intrinsics[:, None, :, None, 1, 1]
    x = seen[..., 0] / z * focal[0] + W / 2
    y = seen[..., 1] / z * focal[1] + H / 2
    column = jnp.clip(jnp.floor(x), 0, W - 1).astype(jnp.int32)
    row = jnp.clip(jnp.floor(y), 0, H - 1).astype(jnp.int32)
    flat = jnp.broadcast_to(clip.depth.reshape(B, 1, S, H * W), (B, S, S, H * W))
    shown = jnp.take_along_axis(flat, row * W + column, axis=-1)
    inside = (x >= 0) & (x < W) & (y >= 0) & (y < H) & (seen[..., 2] > 1e-3)
    visible = inside & (jnp.abs(shown - z) < OCCLUDED * z)
    position = jnp.stack([2 * x / W - 1, 2 * y / H - 1], axis=-1)
    return Matches(jnp.clip(position, -2, 2), (row // patch_size) * w + column // patch_size, visible)


def _unproject(depth: Float[Array, "B S H W"], intrinsics: Float[Array, "B S 3 3"]) -> Float[Array, "B S H W 3"]:
    H, W = depth.shape[-2:]
    x = jnp.asarray(np.arange(W) + 0.5 - W / 2, jnp.float32)
    y = jnp.asarray(np.arange(H) + 0.5 - H / 2, jnp.float32)
    focal_x, focal_y = (intrinsics[..., i, i][..., None, None] for i in (0, 1))
    return jnp.stack([depth * x[None, None, None] / focal_x, depth * y[None, None, :, None] / focal_y, depth], axis=-1)


def _square(pose: Float[Array, "*B 3 4"]) -> Float[Array, "*B 4 4"]:
    last = jnp.broadcast_to(jnp.asarray([[0.0, 0.0, 0.0, 1.0]]), (*pose.shape[:-2], 1, 4))
    return jnp.concatenate([pose, last], axis=-2)
