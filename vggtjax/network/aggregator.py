"""Alternating frame and global attention as one scan over stacked pairs of blocks (VGGT)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Int

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.block import Block, apply_block, with_remat_policy
from vggtjax.network.kernels.frames import Frames
from vggtjax.network.kernels.in_place import replaced_if
from vggtjax.network.kernels.sampled import early_pairs, frames_alone, sampled_attention
from vggtjax.network.layers import Params, apply, stack
from vggtjax.network.precision import Compute, full_precision, upcast
from vggtjax.network.rope import rope_table
from vggtjax.network.suppression import Attend, SuppressedKeys, Suppression, suppressed_attention

REGISTERS = 4
_CAPTURED_ROWS = 2**16  # at once: they take 0.5 GB in float32
SPECIAL_TOKENS = 1 + REGISTERS  # camera token, registers

# (S, grid, special tokens) -> attention over the S frames of a clip
GLOBAL_ATTENTION: Mapping[str, Callable[[int, tuple[int, int], int], Attend]] = {
    "exact": lambda S, grid, special_tokens: suppressed_attention,
    "sampled": sampled_attention,
}

Capture = Callable[[Float[Array, "B S T E"]], Any]


class Accumulator(Protocol):
    """Sums over q and k (after norm and rotation) of the global blocks: motion cues, or a loss of the attention.

    The sums are any tree of arrays; they are carried through the scan, so no pair's q and k are stored.
    """

    def layer_counts(self) -> Int[np.ndarray, "depth ..."] | Int[Array, "depth ..."]:
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
        """Return the sums with one pair of blocks added; padded frames, from `frame_count` on, are ignored."""
        ...


def identity(tokens: Float[Array, "B S T E"]) -> Float[Array, "B S T E"]:
    """Return a tap unchanged: outputs of the frame and the global block, concatenated to E = 2C channels."""
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
    suppression: Suppression = Suppression(),
    compute: Compute = Compute(),
) -> tuple[Float[Array, "B S E"], tuple[Any, ...], Any]:
    """Run the alternating blocks; return the last pair's camera tokens, the captured taps, and the accumulated sums.

    Args:
        params: the model's parameter tree (`aggregator` is read).
        patch_tokens: what `encode` returned.
        config: the model's configuration.
        grid: rows and columns of patches, h and w.
        captures: one function per entry of `config.taps`, from tokens [B, S, T, 2C] to any tree of arrays. Only these
            trees are stored, and only of the tapped pairs.
        accumulator: what to sum over q and k of the global blocks, such as motion cues, or None.
        frame_count: number of real frames of each clip, at least one; padded frames follow and do not change them.
        suppression: the keys to suppress, in both blocks of a pair.
        compute: type of the products; how global attention is computed; with `remat`, only the input of every pair is
            stored for the gradient; where the frames are: global attention gathers keys and values, all else is local.
    """
    return apply(
        Aggregator(config),
        params["aggregator"],
        patch_tokens,
        grid,
        captures,
        accumulator=accumulator,
        frame_count=frame_count,
        suppression=suppression,
        compute=compute,
    )


class Aggregator(nn.Module):
    """Camera and register tokens, and pairs of blocks; arguments as those of `aggregate`."""

    config: VGGTConfig

    @nn.compact
    def __call__(
        self,
        patch_tokens: Float[Array, "B S P C"],
        grid: tuple[int, int],
        captures: Sequence[Capture],
        *,
        accumulator: Accumulator | None = None,
        frame_count: Int[Array, " B"] | None = None,
        suppression: Suppression = Suppression(),
        compute: Compute = Compute(),
    ) -> tuple[Float[Array, "B S E"], tuple[Any, ...], Any]:
        """Return the last pair's camera tokens, the captured taps, and the accumulated sums."""
        config = self.config
        B, S, P, C = patch_tokens.shape
        T = SPECIAL_TOKENS + P
        block = Block(config.num_heads, qk_norm=True, dtype=jnp.dtype(compute.compute_dtype))
        attend = _global_attention(compute, S, grid)
        global_block = block.clone(attend=attend)
        rope = rope_table(grid, SPECIAL_TOKENS, C // config.num_heads)
        frames = compute.frames
        real = frames.are_real(frame_count, B, S)
        real_tokens = None if real is None else jnp.repeat(real, T, axis=1)
        hidden = suppression.hidden_tokens(SPECIAL_TOKENS)

        def suppressed(active: Array, rows: int) -> SuppressedKeys | None:
            return None if hidden is None else SuppressedKeys(hidden.reshape(rows, -1), active, suppression.suppress)

        def pair(carry, layer):
            x, _, taps, sums = carry
            frame_params, global_params, active, tapped, counts, early = layer
            x, _, _ = apply_block(block, frame_params, x.reshape(B * S, T, C), rope, suppressed(active, B * S))
            frame = x
            here = global_block if early is None else global_block.clone(attend=frames_alone(S, attend, early))
            x, q, k = apply_block(here, global_params, x.reshape(B, S * T, C), rope, suppressed(active, B), real_tokens)
            if accumulator is not None:
                q, k = (a.reshape(B, S, T, *a.shape[2:]) for a in (q, k))
                x, (q, k) = frames.in_order(x, (q, k))  # in the gradient, cues communicate before attention does
                sums = accumulator.add(sums, frames.after(counts, x), q, k, frame_count)  # and here, after it
            taps = tuple(
                jax.named_scope(f"tap{i}")(replaced_if)(tapped[i], tap, _joined(capture, (B, S, T, C)), frame, x)
                for i, (capture, tap) in enumerate(zip(captures, taps, strict=True))
            )
            camera = [tokens.reshape(B, S, T, C)[:, :, 0] for tokens in (frame, x)]
            return (x.reshape(B * S * T, C), jnp.concatenate(camera, axis=-1), taps, sums), None

        if real is not None:  # 0 x NaN is NaN: padded frames are set to 0
            patch_tokens = jnp.where(real[:, :, None, None], patch_tokens, 0)
        tokens = self._tokens(upcast(patch_tokens), frames)
        layers = (
            stack(self, "frame_blocks", block, config.depth, tokens[0]),
            stack(self, "global_blocks", block, config.depth, tokens[0]),
            suppression.active(config.depth, config.motion.mask_pairs),
            jnp.asarray(np.arange(config.depth)[:, None] == np.asarray(config.taps)[None]),
            None if accumulator is None else jnp.asarray(accumulator.layer_counts()),
            jnp.asarray(early_pairs(config.depth)) if compute.attention == "sampled" else None,
        )
        sums = None if accumulator is None else frames.varying(accumulator.zeros(B, S, P))
        camera = frames.varying(jnp.zeros((B, S, 2 * C), tokens.dtype))
        taps = frames.varying(tuple(_empty(capture, (B, S, T, 2 * C), tokens.dtype) for capture in captures))
        step = with_remat_policy(pair, remat=compute.remat)
        start = (tokens.reshape(B * S * T, C), camera, taps, sums)
        (_, camera, taps, sums), _ = jax.lax.scan(step, start, layers)
        return camera, taps, sums

    def _tokens(self, patch_tokens: Float[Array, "B S P C"], frames: Frames) -> Float[Array, "B S T C"]:
        """Prepend camera and register tokens: variant 0 for the clip's first frame, variant 1 for all others."""
        B, S, _, C = patch_tokens.shape
        camera = self.param("camera_token", nn.initializers.zeros, (2, 1, C))
        registers = self.param("register_tokens", nn.initializers.zeros, (2, REGISTERS, C))
        special = jnp.concatenate([camera, registers], axis=1)  # [2, 5, C]
        special = special.astype(patch_tokens.dtype)[(frames.numbers(S) > 0).astype(int)]  # [S, 5, C]
        return jnp.concatenate([jnp.broadcast_to(special, (B, S, SPECIAL_TOKENS, C)), patch_tokens], axis=2)


def _global_attention(compute: Compute, S: int, grid: tuple[int, int]) -> Attend:
    """Return attention over S frames of a clip, or over those of all devices. Raises InputError for approximations."""
    if compute.frames.mesh is None:
        attend = compute.attention if callable(compute.attention) else GLOBAL_ATTENTION[compute.attention]
        return attend(S, grid, SPECIAL_TOKENS)
    if compute.attention != "exact":
        raise InputError(f"attention is {compute.attention!r} on several devices; expected 'exact', or one device")
    return partial(suppressed_attention, frames=compute.frames)


def _joined(capture: Capture, shape: tuple[int, int, int, int]) -> Callable[[Array, Array], Any]:
    """Return what captures a tapped pair: its frame and global outputs, joined; on an accelerator some frames at once.

    The rows of many frames, joined and normalised in float32, would be the most that a pass holds.
    """
    B, S, T = shape[:3]
    pieces = -(-S // max(_CAPTURED_ROWS // (B * T), 1))
    at_once = -(-S // pieces)
    starts = np.minimum(at_once * np.arange(pieces), S - at_once)  # the last piece overlaps the one before it
    owner = np.minimum(np.arange(S) // at_once, pieces - 1)
    taken = at_once * owner + np.arange(S) - starts[owner]  # of every frame, among those of all pieces

    def captured(frame: Array, x: Array) -> Any:
        return capture(jnp.concatenate([frame.reshape(shape), x.reshape(shape)], axis=-1))

    def in_pieces(frame: Array, x: Array) -> Any:
        def of_piece(start: Array) -> Any:
            some = [jax.lax.dynamic_slice_in_dim(a.reshape(shape), start, at_once, axis=1) for a in (frame, x)]
            return capture(jnp.concatenate(some, axis=-1))

        def of_frames(leaf: Array) -> Array:
            leaf = jnp.moveaxis(leaf, 0, 1).reshape(B, pieces * at_once, *leaf.shape[3:])
            return leaf if pieces * at_once == S else leaf[:, taken]

        return jax.tree.map(of_frames, jax.lax.map(of_piece, jnp.asarray(starts)))  # [pieces, B, at once, ...]

    if pieces == 1:
        return captured
    return lambda frame, x: jax.lax.platform_dependent(frame, x, cpu=captured, default=in_pieces)


def _empty(capture: Capture, shape: tuple[int, ...], dtype: Any) -> Any:
    shapes = jax.eval_shape(capture, jax.ShapeDtypeStruct(shape, dtype))
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
