"""Alternating frame and global attention as one scan over stacked pairs of blocks (VGGT)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtjax.config import Suppress, VGGTConfig
from vggtjax.network.block import Block
from vggtjax.network.layers import Params
from vggtjax.network.precision import full_precision, widened
from vggtjax.network.rope import rope_table
from vggtjax.network.suppression import Suppression

REGISTERS = 4
SPECIAL_TOKENS = 1 + REGISTERS  # camera token, registers

Capture = Callable[[Float[Array, "B S T E"]], Any]


class Accumulator(Protocol):
    """Sums over q and k (after norm and rotation) of the global blocks: motion cues, or a loss of the attention.

    The sums are any tree of arrays; they are carried through the scan, so that q and k of no pair are stored.
    """

    def layer_counts(self) -> Int[np.ndarray, "depth ..."]:
        """Return how often every pair is read; `add` receives the pair's own entry."""
        ...

    def zeros(self, B: int, S: int, P: int, /) -> Any:
        """Return empty sums for B clips of S frames with P patches each."""
        ...

    def add(
        self,
        sums: Any,
        counts: Int[Array, ...],
        q: Float[Array, "B S T N D"],
        k: Float[Array, "B S T N D"],
        frame_count: Int[Array, " B"] | None,
        /,
    ) -> Any:
        """Return the sums with one pair added; of clips with a `frame_count` only the first frames count."""
        ...


def identity(tokens: Float[Array, "B S T E"]) -> Float[Array, "B S T E"]:
    """Capture a tap whole: frame output next to global output, E = 2C."""
    return tokens


@full_precision
def aggregate(
    params: Params,
    patch_tokens: Float[Array, "B S P C"],
    config: VGGTConfig,
    grid: tuple[int, int],
    *,
    captures: Sequence[Capture],
    accumulator: Accumulator | None = None,
    frame_count: Int[Array, " B"] | None = None,
    dynamic_tokens: Bool[Array, "B S h w"] | Float[Array, "B S h w"] | None = None,
    suppress: Suppress = "zero",
    mask_pairs: int = 5,
    strength: Float[Array, " depth"] | None = None,
    compute_dtype: str = "float32",
    remat: bool = False,
) -> tuple[Float[Array, "B S E"], tuple[Any, ...], Any]:
    """Run the alternating blocks; return the last pair's camera tokens, the captured taps, and the accumulated sums.

    Args:
        params: the model's parameter tree (`aggregator` is read).
        patch_tokens: what `encode` returned.
        grid: rows and columns of patches, h and w.
        captures: one function per entry of `config.taps`, from tokens [B, S, T, 2C] to any tree of arrays. Nothing
            else of the tapped pairs is stored, and nothing at all of the others.
        accumulator: what to sum over q and k of the global blocks, such as motion cues, or None.
        frame_count: number of frames of each clip that are real, its first ones, one at least; the others change
            nothing in them.
        dynamic_tokens: patches whose keys are suppressed in the first `mask_pairs` pairs, in both blocks of a pair;
            bool, or how much of each key is, in [0, 1].
        suppress, mask_pairs, compute_dtype: as for `forward`.
        strength: share of the suppression in every pair, in place of `mask_pairs`.
        remat: keep one pair's input for the gradient, and compute what is inside again.
    """
    params = params["aggregator"]
    B, S, P, C = patch_tokens.shape
    T = SPECIAL_TOKENS + P
    block = _block(config, compute_dtype)
    head_dim = C // config.num_heads
    rope = rope_table(grid, SPECIAL_TOKENS, head_dim)

    there = None if frame_count is None else jnp.repeat(jnp.arange(S)[None] < frame_count[:, None], T, axis=1)

    if strength is not None and dynamic_tokens is not None:
        dynamic_tokens = dynamic_tokens.astype(jnp.promote_types(dynamic_tokens.dtype, strength.dtype))

    def suppression(active: Array, rows: int) -> Suppression | None:
        if dynamic_tokens is None:
            return None
        keys = jnp.pad(dynamic_tokens.reshape(B, S, P), ((0, 0), (0, 0), (SPECIAL_TOKENS, 0)))  # [B, S, T]
        return Suppression(keys.reshape(rows, -1), active, suppress)

    def pair(carry, layer):
        x, _, taps, sums = carry
        frame_params, global_params, masked, tapped, counts = layer
        x, _, _ = block(frame_params, x.reshape(B * S, T, C), rope, suppression(masked, B * S))
        frame = x
        x, q, k = block(global_params, x.reshape(B, S * T, C), rope, suppression(masked, B), there)
        if accumulator is not None:
            q, k = (a.reshape(B, S, T, *a.shape[2:]) for a in (q, k))
            sums = accumulator.add(sums, counts, q, k, frame_count)
        taps = tuple(
            jax.lax.cond(tapped[i], _captured(capture, (B, S, T, C)), lambda frame, x, tap: tap, frame, x, tap)
            for i, (capture, tap) in enumerate(zip(captures, taps, strict=True))
        )
        x = x.reshape(B, S, T, C)
        camera = jnp.concatenate([frame.reshape(B, S, T, C)[:, :, 0], x[:, :, 0]], axis=-1)  # [B, S, 2C]
        return (x, camera, taps, sums), None

    index = np.arange(config.depth)
    masked = jnp.asarray(index) < mask_pairs
    if dynamic_tokens is not None and dynamic_tokens.dtype != bool:
        masked = masked.astype(dynamic_tokens.dtype) if strength is None else strength
    layers = (
        params["frame_blocks"],
        params["global_blocks"],
        masked,
        jnp.asarray(index[:, None] == np.asarray(config.taps)[None]),
        None if accumulator is None else jnp.asarray(accumulator.layer_counts()),
    )
    sums = None if accumulator is None else accumulator.zeros(B, S, P)
    if there is not None:  # what is not a number would count even with weight 0
        patch_tokens = jnp.where(there.reshape(B, S, T)[:, :, :1, None], patch_tokens, 0)
    tokens = _tokens(params, widened(patch_tokens))
    camera = jnp.zeros((B, S, 2 * C), tokens.dtype)
    taps = tuple(_empty(capture, (B, S, T, 2 * C), tokens.dtype) for capture in captures)
    step = jax.checkpoint(pair, prevent_cse=False) if remat else pair
    (_, camera, taps, sums), _ = jax.lax.scan(step, (tokens, camera, taps, sums), layers)
    return camera, taps, sums


def declare_aggregator(config: VGGTConfig) -> Params:
    """Declare the parameters of the aggregator."""
    C = config.embed_dim
    blocks = _block(config).declare_stacked(config.depth, C)
    return {
        "camera_token": jnp.zeros((2, 1, C)),
        "register_tokens": jnp.zeros((2, REGISTERS, C)),
        "frame_blocks": blocks,
        "global_blocks": blocks,
    }


def _block(config: VGGTConfig, dtype: str = "float32") -> Block:
    return Block(config.num_heads, qk_norm=True, dtype=jnp.dtype(dtype))


def _tokens(params: Params, patch_tokens: Float[Array, "B S P C"]) -> Float[Array, "B S T C"]:
    """Prepend camera and register tokens: variant 0 for the clip's first frame, variant 1 for all others."""
    B, S, _, C = patch_tokens.shape
    special = jnp.concatenate([params["camera_token"], params["register_tokens"]], axis=1)  # [2, 5, C]
    special = special.astype(patch_tokens.dtype)[(np.arange(S) > 0).astype(int)]  # [S, 5, C]
    return jnp.concatenate([jnp.broadcast_to(special, (B, S, SPECIAL_TOKENS, C)), patch_tokens], axis=2)


def _captured(capture: Capture, shape: tuple[int, int, int, int]) -> Callable:
    """The branch of a tapped pair: join frame and global output, keep what `capture` makes of them."""

    def branch(frame, x, tap):
        del tap
        return capture(jnp.concatenate([frame.reshape(shape), x.reshape(shape)], axis=-1))

    return branch


def _empty(capture: Capture, shape: tuple[int, ...], dtype: Any) -> Any:
    kept = jax.eval_shape(capture, jax.ShapeDtypeStruct(shape, dtype))
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), kept)
