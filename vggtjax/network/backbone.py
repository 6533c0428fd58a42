"""DINOv2 vision transformer: images -> patch tokens, independent of the dynamic mask."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float, Int

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.block import BlockLayer, PackedBlock, activations
from vggtjax.network.given import as_images, check_floats
from vggtjax.network.layers import TABLE, Conv, LayerNorm, Params, over_layers
from vggtjax.network.precision import check_compute_dtype, full_precision, upcast

IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)
REGISTERS = 4
_EPSILON = 1e-6


class ClipBatch(NamedTuple):
    """Images of a batch of clips, and what travels with them through every pass."""

    images: Float[Array, "B S H W 3"]  # RGB in [0, 1]
    patch_tokens: Float[Array, "B S P C"] | None = None  # what `encode` returned; a pass without them computes them
    frame_count: Int[Array, " B"] | None = None  # real frames of each clip, its first ones, at least one; None: all


@full_precision()
def encode(
    params: Params,
    images: Float[Array, "B S H W 3"],
    config: VGGTConfig,
    *,
    compute_dtype: str = "float32",
    remat: bool = False,
) -> Float[Array, "B S P C"]:
    """Return the backbone's normalised patch tokens.

    Args:
        params: the model's parameter tree (`backbone` is read).
        images: RGB in [0, 1]; H and W are multiples of the patch size.
        config: the model's configuration.
        compute_dtype: dtype of matrix products; the residual stream and norms stay float32.
        remat: store only the input of every block for the gradient, and compute its activations again.

    Returns:
        Tokens in row-major patch order, in float32 (float64 for compute_dtype "float64"). Both passes share them.

    Raises:
        InputError: an invalid shape or type of the images, or an unknown compute_dtype.
    """
    check_compute_dtype(compute_dtype)
    images = as_images(images)
    patch_grid(images, config)
    check_floats(images)
    return Backbone(config, compute_dtype, remat).apply({"params": params["backbone"]}, images)  # type: ignore


class Backbone(nn.Module):
    """The patch embedding, the blocks and the last norm; arguments as those of `encode`."""

    config: VGGTConfig
    compute_dtype: str = "float32"
    remat: bool = False

    @nn.compact
    def __call__(self, images: Float[Array, "B S H W 3"]) -> Float[Array, "B S P C"]:
        """Return the patch tokens after the last norm."""
        config, dtype = self.config, jnp.dtype(self.compute_dtype)
        C, size, side = config.embed_dim, config.patch_size, config.grid_size
        B, S, H, W, _ = images.shape
        grid = (H // size, W // size)
        x = (images - jnp.asarray(IMAGE_MEAN)[(None,) * 4]) / jnp.asarray(IMAGE_STD)[(None,) * 4]
        embed = Conv(C, (size, size), strides=size, padding="VALID", dtype=dtype, name="patch_embedding")
        x = upcast(embed(x.reshape(B * S, H, W, 3))).reshape(B * S, grid[0] * grid[1], C)
        positions = self.param("position_embedding", TABLE, (1 + side**2, C)).astype(x.dtype)
        x = x + patch_positions(positions[1:], side, grid)[None]
        class_token = self.param("class_token", TABLE, (1, C))
        registers = self.param("register_tokens", TABLE, (REGISTERS, C))
        special = jnp.concatenate([class_token + positions[:1], registers]).astype(x.dtype)  # [1 + R, C]
        x = jnp.concatenate([jnp.broadcast_to(special, (B * S, *special.shape)), x], axis=1)  # [B*S, 1 + R + P, C]
        block = PackedBlock(config.dino_num_heads, epsilon=_EPSILON, dtype=dtype, layer_scale=1.0, name="blocks")
        x, _ = over_layers(BlockLayer, config.dino_depth, store=activations(remat=self.remat))(block)(x)
        x = LayerNorm(_EPSILON, name="norm")(x)
        return x[:, 1 + REGISTERS :].reshape(B, S, grid[0] * grid[1], C)


def patch_grid(images: Float[Array, "B S H W 3"], config: VGGTConfig) -> tuple[int, int]:
    """Return the rows and columns of patches. Raises InputError unless these are whole numbers of at least 1."""
    size = config.patch_size
    if images.ndim != 5 or images.shape[-1] != 3 or 0 in images.shape:
        is_torch_like = images.ndim == 5 and images.shape[2] == 3 and 0 not in images.shape
        remedy = ": np.moveaxis(images, 2, -1)" if is_torch_like else " with at least one frame"
        raise InputError(f"images have shape {tuple(images.shape)}; expected [B, S, H, W, 3]{remedy}")
    H, W = images.shape[2:4]
    if H % size or W % size:
        raise InputError(f"images are {H} x {W} pixels; expected multiples of the patch size {size}")
    return H // size, W // size


def patch_positions(table: Float[Array, "G C"], side: int, grid: tuple[int, int]) -> Float[Array, "P C"]:
    """Resize the learned square grid of positions to `grid`: bicubic with antialias, as DINOv2."""
    if grid == (side, side):
        return table
    C = table.shape[-1]
    table = jax.image.resize(table.reshape(side, side, C), (*grid, C), "cubic", antialias=True)
    return table.reshape(grid[0] * grid[1], C)
