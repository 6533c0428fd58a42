"""Rays: the direction and the origin of each pixel's ray in the world, beside depth (Depth Anything 3)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from vggtjax.config import VGGTConfig
from vggtjax.network.heads.dpt_head import HIDDEN, DPTFeatures, add_positions, frames_at_once, fuse
from vggtjax.network.layers import Conv3x3, Dense, LayerNorm, Params
from vggtjax.network.precision import products

_RAY = 6  # numbers: direction, origin
_CONVOLUTIONS = 5  # without activation between them
_LEVELS = (4, 2, 1, 0.5)  # sizes of the levels, in patch grids


class RayHead(nn.Module):
    """A fusion of its own over the levels of the depth head, and linear outputs at eight times the patch grid."""

    config: VGGTConfig

    @nn.compact
    def __call__(self, levels: list[Float[Array, "F _ _ G"]], aspect: float) -> Float[Array, "F 8h 8w 7"]:
        """Return direction, origin and a confidence logit."""
        x = fuse(levels, in_place=self.config.row.relu_in_place)
        features = self.config.dpt_features
        for i in range(_CONVOLUTIONS):
            x = Conv3x3(features if i % 2 else features // 2, name=f"conv{i}")(x)
        x = Conv3x3(HIDDEN, name="hidden")(add_positions(x, aspect=aspect))
        x = nn.relu(LayerNorm(name="norm")(x))
        return Dense(_RAY + 1, name="output")(x)

    def declare(self, grid: tuple[int, int]) -> None:
        """Read every parameter once."""
        sizes = [[-(-int(2 * side * scale) // 2) for side in grid] for scale in _LEVELS]
        self([jnp.zeros((1, *size, self.config.dpt_features)) for size in sizes], 1.0)


def predict_rays(
    params: Params,
    taps: list[Float[Array, "B S P F"]],
    config: VGGTConfig,
    grid: tuple[int, int],
    precision: str = "highest",
) -> tuple[Float[Array, "B S 8h 8w 6"], Float[Array, "B S 8h 8w"]]:
    """Return each ray, direction [..., :3] and origin [..., 3:], and its confidence, at least 1.

    Args:
        params: the model's parameter tree (`depth_head` and `ray_head` are read).
        taps: projections of the depth head for the four taps.
        config: the model's configuration.
        grid: rows and columns of patches, h and w.
        precision: as in `Compute`.
    """
    (h, w), features = grid, config.dpt_features
    reassemble = DPTFeatures(features, features // 2, in_place=config.row.relu_in_place)

    def some_frames(taps: list[Float[Array, "n P F"]]) -> Float[Array, "n 8h 8w 7"]:
        maps = [tap.reshape(-1, h, w, tap.shape[-1]) for tap in taps]
        levels = reassemble.apply({"params": params["depth_head"]["features"]}, maps, only_levels=True)
        return RayHead(config).apply({"params": params["ray_head"]}, levels, w / h)  # type: ignore

    with products(precision):
        out: Any = frames_at_once(some_frames, taps, 64 * h * w)
    out = out.reshape(*taps[0].shape[:2], 8 * h, 8 * w, _RAY + 1)
    return out[..., :_RAY], 1 + jnp.exp(out[..., _RAY])
