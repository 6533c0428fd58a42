"""Targets of training: the truth of generated clips in the network's own terms."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.cameras import unproject
from vggtjax.network.heads.pose import encode_pose
from vggtjax.network.precision import full_precision
from vggtjax.training.scenes.render import SyntheticClip
from vggtjax.training.scenes.scene import compose, invert

OCCLUDED = 0.03  # largest relative depth of a visible point behind the depth of its target pixel


class Clips(NamedTuple):
    """Generated clips and what training reads of their truth. Metres; depth is 0 where nothing is: in the sky."""

    images: Float[Array, "B S H W 3"]  # RGB in [0, 1]
    depth: Float[Array, "B S H W"]
    camera_from_world: Float[Array, "B S 3 4"]
    intrinsics: Float[Array, "B S 3 3"]
    tracks: Float[Array, "B R P S 3"]  # where the points at the patch centres of frame r are at frame s


class Targets(NamedTuple):
    """Truth in the first camera's frame, in units of the mean distance of the clip's points from that camera."""

    pose_encoding: Float[Array, "B S 9"]
    depth: Float[Array, "B S H W"]
    points: Float[Array, "B S H W 3"]
    known: Bool[Array, "B S H W"]  # pixels that show something; in the sky depth and points are 0


class Matches(NamedTuple):
    """Positions in frame s of the patch centres of frame r."""

    position: Float[Array, "B R S P 2"]  # x, y in [-1, 1] over the image, up to 2 beyond its edge
    patch: Int[Array, "B R S P"]
    visible: Bool[Array, "B R S P"]

    @property
    def from_others(self) -> Bool[Array, "B R P"]:
        """The patches of all frames but the first that are visible in the first."""
        return self.visible[:, :, 0].at[:, 0].set(False)

    @property
    def between(self) -> Bool[Array, "B R S P"]:
        """The patches that are visible in another frame than their own."""
        return self.visible & ~jnp.eye(self.visible.shape[1], dtype=bool)[None, :, :, None]


class MatchCounts(NamedTuple):
    """Numbers of visible matches, over which terms of the objective are means."""

    first: Float[Array, ...]  # in the first frame, of all frames' patches
    from_others: Float[Array, ...]  # in the first frame, of the other frames' patches
    between: Float[Array, ...]  # in each other frame


@full_precision()
def clips_of(scenes: SyntheticClip, patch_size: int) -> Clips:
    """Return what training reads of scenes [B, S, ...] of rigid parts."""
    centres = _centres(patch_size)
    world = unproject(scenes.depth, scenes.intrinsics, scenes.camera_from_world, pixel_offset=0.5)[centres]
    B, S = world.shape[:2]
    world = world.reshape(B, S, -1, 3)
    parts = scenes.part_ids[centres].reshape(B, S, -1)
    motion = compose(scenes.world_from_part[:, None], invert(scenes.world_from_part)[:, :, None])  # [B, R, S, K, 3, 4]
    one_hot = (parts[..., None] == jnp.arange(motion.shape[3])[None, None, None]).astype(jnp.float32)  # [B, R, P, K]
    own = jnp.einsum("brpk,brskij->brpsij", one_hot, motion)
    tracks = jnp.einsum("brpsij,brpj->brpsi", own[..., :3], world) + own[..., 3]
    return Clips(scenes.images, scenes.depth, scenes.camera_from_world, scenes.intrinsics, tracks)


def mirrored(clips: Clips) -> Clips:
    """Return clips as a mirror shows them: left and right exchanged, in the pictures and in the world."""
    (H, W), shape = clips.depth.shape[2:], clips.tracks.shape
    patch_size = math.isqrt(H * W // shape[2])
    sign = np.array([-1, 1, 1, 1], np.float32)
    tracks = clips.tracks.reshape(*shape[:2], H // patch_size, W // patch_size, *shape[3:])[:, :, :, ::-1]
    return Clips(
        clips.images[:, :, :, ::-1],
        clips.depth[:, :, :, ::-1],
        clips.camera_from_world * np.outer(sign[:3], sign)[None, None],
        clips.intrinsics.at[..., 0, 2].set(W - clips.intrinsics[..., 0, 2]),
        tracks.reshape(shape) * sign[(None,) * 4][..., :3],
    )


@full_precision()
def targets(clips: Clips) -> Targets:
    """Return the truth that the heads regress, normalised as in VGGT: first camera, mean point distance 1."""
    H, W = clips.depth.shape[-2:]
    known = clips.depth > 0
    camera_from_first = compose(clips.camera_from_world, invert(clips.camera_from_world[:, :1]))
    points = unproject(clips.depth, clips.intrinsics, camera_from_first, pixel_offset=0.5)
    distance = jnp.linalg.norm(points, axis=-1)
    scale = distance.sum(axis=(1, 2, 3), where=known) / jnp.maximum(known.sum(axis=(1, 2, 3)), 1)  # [B]
    scale = jnp.where(scale > 0, scale, 1)  # a clip of the sky alone
    translation = camera_from_first[..., 3:] / scale[:, None, None, None]
    camera = jnp.concatenate([camera_from_first[..., :3], translation], axis=-1)
    return Targets(
        encode_pose(camera, clips.intrinsics, (H, W)),
        clips.depth / scale[:, None, None, None],
        jnp.where(known[..., None], points / scale[:, None, None, None, None], 0),
        known,
    )


@full_precision()
def matches(clips: Clips, patch_size: int) -> Matches:
    """Return the positions of each frame's patch centres in every other frame; what moves is followed."""
    B, S, H, W = clips.depth.shape
    w = W // patch_size
    camera = clips.camera_from_world[:, None, None, :, :, 3]  # [B, 1, 1, S, 3]
    point = (jnp.einsum("bsij,brpsj->brpsi", clips.camera_from_world[..., :3], clips.tracks) + camera).swapaxes(2, 3)
    z = jnp.maximum(point[..., 2], 1e-3)
    focal = clips.intrinsics[:, None, :, None, 0, 0], clips.intrinsics[:, None, :, None, 1, 1]
    x = point[..., 0] / z * focal[0] + W / 2
    y = point[..., 1] / z * focal[1] + H / 2
    column = jnp.clip(jnp.floor(x), 0, W - 1).astype(jnp.int32)
    row = jnp.clip(jnp.floor(y), 0, H - 1).astype(jnp.int32)
    flat = jnp.broadcast_to(clips.depth.reshape(B, 1, S, H * W), (B, S, S, H * W))
    depth = jnp.take_along_axis(flat, row * W + column, axis=-1)
    inside = (x >= 0) & (x < W) & (y >= 0) & (y < H) & (point[..., 2] > 1e-3)
    known = (clips.depth[_centres(patch_size)] > 0).reshape(B, S, 1, -1)
    visible = inside & known & (jnp.abs(depth - z) < OCCLUDED * z)
    position = jnp.stack([2 * x / W - 1, 2 * y / H - 1], axis=-1)
    return Matches(jnp.clip(position, -2, 2), (row // patch_size) * w + column // patch_size, visible)


def _centres(patch_size: int) -> tuple[slice, ...]:
    return np.s_[:, :, patch_size // 2 :: patch_size, patch_size // 2 :: patch_size]


def match_counts(matches: Matches) -> MatchCounts:
    """Return the counts of all clips together."""
    each = matches.visible[:, :, 0], matches.from_others, matches.between
    return MatchCounts(*(x.sum(dtype=jnp.float32) for x in each))
