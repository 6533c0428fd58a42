"""DINOv2 vision transformer: images -> patch tokens, independent of the dynamic mask."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.block import Block, storing_little
from vggtjax.network.layers import Conv, LayerNorm, Params, apply, declare
from vggtjax.network.precision import check_compute_dtype, full_precision, widened

IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)
REGISTERS = 4
_EPSILON = 1e-6


@full_precision
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
        InputError: an invalid shape of the images, or an unknown compute_dtype.
    """
    check_compute_dtype(compute_dtype)
    params = params["backbone"]
    grid = patch_grid(images, config)
    B, S, H, W, _ = images.shape
    C = config.embed_dim
    x = (images - jnp.asarray(IMAGE_MEAN)[(None,) * 4]) / jnp.asarray(IMAGE_STD)[(None,) * 4]
    x = apply(_patch_embedding(config, compute_dtype), params["patch_embedding"], x.reshape(B * S, H, W, 3))
    x = widened(x).reshape(B * S, grid[0] * grid[1], C)
    positions = params["position_embedding"].astype(x.dtype)
    x = x + patch_positions(positions[1:], config.grid_size, grid)[None]
    special = jnp.concatenate([params["class_token"] + positions[:1], params["register_tokens"]])  # [1 + R, C]
    special = jnp.broadcast_to(special.astype(x.dtype), (B * S, *special.shape))
    x = jnp.concatenate([special, x], axis=1)  # [B*S, 1 + R + P, C]
    block = _block(config, compute_dtype)

    def step(x, layer):
        return block(layer, x)[0], None

    x, _ = jax.lax.scan(storing_little(step, remat=remat), x, params["blocks"])
    x = apply(LayerNorm(_EPSILON), params["norm"], x)
    return x[:, 1 + REGISTERS :].reshape(B, S, grid[0] * grid[1], C)


def patch_grid(images: Float[Array, "B S H W 3"], config: VGGTConfig) -> tuple[int, int]:
    """Return the rows and columns of patches. Raises InputError unless these are whole numbers of at least 1."""
    size = config.patch_size
    if images.ndim != 5 or images.shape[-1] != 3 or 0 in images.shape:
        raise InputError(f"images have shape {tuple(images.shape)}; expected [B, S, H, W, 3] with at least one frame")
    H, W = images.shape[2:4]
    if H % size or W % size:
        raise InputError(f"images are {H} x {W} pixels; expected multiples of the patch size {size}")
    return H // size, W // size


def declare_backbone(config: VGGTConfig) -> Params:
    """Declare the parameters of the backbone."""
    C, size = config.embed_dim, config.patch_size
    x = jnp.zeros((1, 1, C))
    return {
        "patch_embedding": declare(_patch_embedding(config), jnp.zeros((1, size, size, 3))),
        "class_token": jnp.zeros((1, C)),
        "register_tokens": jnp.zeros((REGISTERS, C)),
        "position_embedding": jnp.zeros((1 + config.grid_size**2, C)),
        "blocks": _block(config).declare_stacked(config.dino_depth, C),
        "norm": declare(LayerNorm(), x),
    }


def _patch_embedding(config: VGGTConfig, dtype: str = "float32") -> Conv:
    size = (config.patch_size, config.patch_size)
    return Conv(config.embed_dim, size, strides=size, padding="VALID", dtype=jnp.dtype(dtype))


def _block(config: VGGTConfig, dtype: str = "float32") -> Block:
    return Block(config.dino_num_heads, epsilon=_EPSILON, dtype=jnp.dtype(dtype))


def patch_positions(table: Float[Array, "G C"], side: int, grid: tuple[int, int]) -> Float[Array, "P C"]:
    """Resize the learned square grid of positions to `grid`: bicubic with antialias, as DINOv2."""
    if grid == (side, side):
        return table
    C = table.shape[-1]
    table = jax.image.resize(table.reshape(side, side, C), (*grid, C), "cubic", antialias=True)
    return table.reshape(grid[0] * grid[1], C)
