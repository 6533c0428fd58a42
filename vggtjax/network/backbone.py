"""DINOv2 vision transformer: images -> features of each frame, independent of the dynamic mask."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float, Int

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.block import BlockLayer, PackedBlock, activations
from vggtjax.network.given import as_images, check_floats
from vggtjax.network.layers import TABLE, Conv, LayerNorm, Params, over_layers
from vggtjax.network.positions import patch_positions
from vggtjax.network.precision import check_compute_dtype, full_precision, upcast

IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)
_EPSILON = 1e-6


class Features(NamedTuple):
    """What the backbone makes of each frame; both passes share it."""

    patch_tokens: Float[Array, "B S P C"]  # in row-major patch order
    class_tokens: Float[Array, "B S C"] | None = None  # before the last block, where they choose the reference frame


class ClipBatch(NamedTuple):
    """Images of a batch of clips, and what travels with them through every pass."""

    images: Float[Array, "B S H W 3"]  # RGB in [0, 1]
    features: Features | None = None  # what `encode` returned; a pass without them computes them
    frame_count: Int[Array, " B"] | None = None  # real frames of each clip, its first ones, at least one; None: all
    cameras: Float[Array, "B S 9"] | None = None  # known ones, as pose encodings; the network reads them


@full_precision()
def encode(
    params: Params,
    images: Float[Array, "B S H W 3"],
    config: VGGTConfig,
    *,
    compute_dtype: str = "float32",
    remat: bool = False,
) -> Features:
    """Return the backbone's features of each frame.

    Args:
        params: the model's parameter tree (`backbone` is read).
        images: RGB in [0, 1]; H and W are multiples of the patch size.
        config: the model's configuration.
        compute_dtype: dtype of matrix products; the residual stream and norms stay float32.
        remat: store only the input of every block for the gradient, and compute its activations again.

    Returns:
        Patch tokens, and class tokens where they choose the reference frame, in float32 (float64 for compute_dtype
        "float64"). Both passes share them.

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
    def __call__(self, images: Float[Array, "B S H W 3"]) -> Features:
        """Return the features of each frame."""
        config, row, dtype = self.config, self.config.row, jnp.dtype(self.compute_dtype)
        C, size, side = config.embed_dim, config.patch_size, config.grid_size
        B, S, H, W, _ = images.shape
        grid = (H // size, W // size)
        x = (images - jnp.asarray(IMAGE_MEAN)[(None,) * 4]) / jnp.asarray(IMAGE_STD)[(None,) * 4]
        embed = Conv(C, (size, size), strides=size, padding="VALID", dtype=dtype, name="patch_embedding")
        x = upcast(embed(x.reshape(B * S, H, W, 3))).reshape(B * S, grid[0] * grid[1], C)
        positions = self.param("position_embedding", TABLE, (1 + side**2, C)).astype(x.dtype)
        x = x + patch_positions(positions[1:], side, grid, by_scale=row.places_by_scale)[None]
        special = self.param("class_token", TABLE, (1, C)) + positions[:1]
        if row.registers:
            registers = self.param("register_tokens", TABLE, (row.registers, C))
            special = jnp.concatenate([special, registers])
        special = special.astype(x.dtype)  # [1 + R, C]
        x = jnp.concatenate([jnp.broadcast_to(special, (B * S, *special.shape)), x], axis=1)  # [B*S, 1 + R + P, C]
        block = PackedBlock(
            config.dino_num_heads,
            epsilon=_EPSILON,
            dtype=dtype,
            layer_scale=1.0,
            gated_mlp=config.gated_mlp,
            name="blocks",
        )
        layers = over_layers(BlockLayer, config.dino_depth, store=activations(remat=self.remat))
        x, class_tokens = layers(block, returns_first=row.chooses_reference)(x)
        if row.norms_features:
            x = LayerNorm(_EPSILON, name="norm")(x)
        patches = x[:, 1 + row.registers :].reshape(B, S, grid[0] * grid[1], C)
        return Features(patches, class_tokens[-1].reshape(B, S, C) if row.chooses_reference else None)


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


def resized(backbone: Params, config: VGGTConfig, side: int) -> Params:
    """Return a backbone's parameters with the table of positions for squares of `side` x `side` patches.

    It is resized as `encode` resizes it for images of that size.
    """
    table = jnp.asarray(backbone["position_embedding"], jnp.float32)
    patches = patch_positions(table[1:], config.grid_size, (side, side), by_scale=config.row.places_by_scale)
    return {**backbone, "position_embedding": jnp.concatenate([table[:1], patches])}
