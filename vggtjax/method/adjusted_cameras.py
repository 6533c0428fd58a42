"""Cameras adjusted to the matches of what does not move (not in the papers)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.cameras import Cameras
from vggtjax.method.adjustment import Adjustment, adjust, at_patches
from vggtjax.method.matches import Matches, come_back, frame_pairs
from vggtjax.network.frames import Frames

# Matches are biased, and those of neighbours alike: however many there are, they count as those of _PATCHES a frame.
# Narrow priors keep the cameras of static clips where they are.
_PATCHES = 144
_HOW = Adjustment(sigma=0.75, depth_prior=0.3, rotation_prior=float(np.radians(0.25)), translation_prior=0.03)


def adjusted_cameras(
    cameras: Cameras,
    depth: Float[Array, "B S H W"],
    matches: Matches,
    dynamic_mask: Bool[Array, "B S H W"],
    grid: tuple[int, int],
    *,
    frames: Frames = Frames(),
) -> Cameras:
    """Return the cameras for which patches that do not move are seen where they are matched.

    The first camera and all intrinsics stay, and so do the cameras of a clip whose matches do not come back.

    Args:
        cameras: of the clips; intrinsics in pixels.
        depth: in the unit of the cameras, nearly.
        matches: of the first pass.
        dynamic_mask: pixels that move; the static share of a patch is the weight of its matches.
        grid: rows and columns of patches.
        frames: where the frames are.
    """
    S, side = depth.shape[1], depth.shape[2] // grid[0]
    counted = frames.counted(S)
    in_patches = cameras.intrinsics * np.array([[[[1 / side], [1 / side], [1]]]], np.float32)
    h, w = grid
    static = 1 - dynamic_mask.reshape(-1, S, h, side, w, side).mean(axis=(3, 5)).reshape(-1, S, h * w)
    inputs = (cameras.camera_from_world, in_patches, at_patches(depth, grid), matches, static)
    whole = jax.tree.map(lambda x: frames.gather(x)[:, :counted], inputs)

    trust = _PATCHES / (grid[0] * grid[1])

    def of_clip(clip: tuple) -> Float[Array, "S 3 4"]:
        poses, intrinsics, depth, matches, static = clip
        weight = trust * matches.weight * static[:, None]
        world = adjust(depth, Cameras(poses, intrinsics), matches.position, weight, grid, _HOW)
        is_usable = come_back(matches, frame_pairs(counted)) & jnp.isfinite(world.camera_from_world).all()
        return jnp.where(is_usable, world.camera_from_world, poses)

    poses = jnp.pad(jax.lax.map(of_clip, whole), ((0, 0), (0, frames.total(S) - counted), (0, 0), (0, 0)))
    return Cameras(frames.share(poses, S), cameras.intrinsics)
