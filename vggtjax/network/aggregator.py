"""Alternating frame and global attention as one scan over stacked pairs of blocks (VGGT, Depth Anything 3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from vggtjax.config import Suppress, VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.backbone import Features
from vggtjax.network.block import Block, PackedBlock, activations
from vggtjax.network.kernels.captured import Capture, joined, nothing_captured
from vggtjax.network.kernels.frames import Frames
from vggtjax.network.kernels.in_place import replaced_if
from vggtjax.network.kernels.sampled import early_pairs, frames_alone, sampled_attention
from vggtjax.network.layers import TABLE, over_layers
from vggtjax.network.positions import Rope, rope_table
from vggtjax.network.precision import Compute, upcast
from vggtjax.network.suppression import Attend, SuppressedKeys, Suppression, suppressed_attention

# (S, grid, special tokens) -> attention over the S frames of a clip
GLOBAL_ATTENTION: Mapping[str, Callable[[int, tuple[int, int], int], Attend]] = {
    "exact": lambda S, grid, special_tokens: suppressed_attention,
    "sampled": sampled_attention,
}


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


class Carry(NamedTuple):
    """What a pair of blocks hands to the next."""

    tokens: Float[Array, "BST C"]
    camera: Float[Array, "B S E"]  # camera tokens of its frame and its global block, E = 2C
    taps: tuple[Any, ...]  # captured so far
    sums: Any  # of the accumulator so far


class PairInputs(NamedTuple):
    """What differs from pair to pair."""

    suppression: Bool[Array, ""] | Float[Array, ""]  # whether it suppresses keys, or how far
    is_tapped: Bool[Array, " taps"]
    counts: Int[Array, ...] | None  # how often the accumulator reads it
    is_early: Bool[Array, ""] | None  # whether global attention is within the frame, too; None: never


class Pair(nn.Module):
    """A frame block, in which tokens attend to those of their frame, and a global block, in which they attend to all.

    Attributes:
        frame_block, global_block: the two blocks.
        shape: B clips of S frames of T tokens with C channels.
        rope, global_rope: the angles of a frame's tokens, in each of the two blocks.
        attend: global attention.
        captures, accumulator, frame_count: as of `Aggregator`.
        hidden: tokens whose keys are suppressed, or their shares; None: none.
        suppress: how keys are suppressed.
        is_real: tokens of frames that are not padding; None: all.
        frames: where the frames are.
    """

    frame_block: Block
    global_block: Block
    shape: tuple[int, int, int, int]
    rope: Rope
    global_rope: Rope
    attend: Attend
    captures: Sequence[Capture]
    accumulator: Accumulator | None
    frame_count: Int[Array, " B"] | None
    hidden: Bool[Array, "B S T"] | Float[Array, "B S T"] | None
    suppress: Suppress
    is_real: Bool[Array, "B ST"] | None
    frames: Frames

    @nn.compact  # captures may make modules of their own
    def __call__(self, carry: Carry, inputs: PairInputs) -> tuple[Carry, None]:
        """Return what the next pair receives."""
        (B, S, T, C), frames, sums = self.shape, self.frames, carry.sums
        within = partial(suppressed_attention, suppressed=self._suppressed(inputs, B * S))
        among: Any = self.attend if inputs.is_early is None else frames_alone(S, self.attend, inputs.is_early)
        among = partial(among, suppressed=self._suppressed(inputs, B), is_real=self.is_real)

        frame, _, _ = self.frame_block(carry.tokens.reshape(B * S, T, C), self.rope, within)
        x, q, k = self.global_block(frame.reshape(B, S * T, C), self.global_rope, among)

        if self.accumulator is not None:
            q, k = (a.reshape(B, S, T, *a.shape[2:]) for a in (q, k))
            # Devices that share the frames communicate for attention first, then for cues; in the gradient, cues first.
            x, (q, k) = frames.in_order(x, (q, k))
            counts = frames.after(jnp.asarray(inputs.counts), x)
            sums = self.accumulator.add(sums, counts, q, k, self.frame_count)
        taps = tuple(  # each is changed in its pair alone
            jax.named_scope(f"tap{i}")(replaced_if)(inputs.is_tapped[i], tap, joined(capture, self.shape), frame, x)
            for i, (capture, tap) in enumerate(zip(self.captures, carry.taps, strict=True))
        )
        camera = [tokens.reshape(B, S, T, C)[:, :, 0] for tokens in (frame, x)]
        return Carry(x.reshape(B * S * T, C), jnp.concatenate(camera, axis=-1), taps, sums), None

    def _suppressed(self, inputs: PairInputs, sequences: int) -> SuppressedKeys | None:
        if self.hidden is None:
            return None
        return SuppressedKeys(self.hidden.reshape(sequences, -1), inputs.suppression, self.suppress)


class Aggregator(nn.Module):
    """Camera and register tokens before the patches of each frame, and pairs of blocks."""

    config: VGGTConfig

    @nn.compact
    def __call__(
        self,
        features: Features,
        grid: tuple[int, int],
        captures: Sequence[Capture],
        *,
        camera_tokens: Float[Array, "B S C"] | None = None,
        accumulator: Accumulator | None = None,
        frame_count: Int[Array, " B"] | None = None,
        suppression: Suppression = Suppression(),
        compute: Compute = Compute(),
    ) -> tuple[Float[Array, "B S E"], tuple[Any, ...], Any]:
        """Return the last pair's camera tokens, the captured taps, and the accumulated sums.

        Args:
            features: what `encode` returned.
            grid: rows and columns of patches, h and w.
            captures: one function per entry of `config.taps`, from tokens [B, s, T, 2C] of some frames to any tree of
                arrays [B, s, ...], each frame by itself. Only these trees are stored, and only of the tapped pairs.
            camera_tokens: of known cameras, in place of the learned ones.
            accumulator: what to sum over q and k of the global blocks, such as motion cues, or None.
            frame_count: number of real frames of each clip, at least one; padded frames follow and do not change them.
            suppression: the keys to suppress, in both blocks of a pair.
            compute: type of the products; how global attention is computed; with `remat`, only the input of every pair
                is stored for the gradient; where the frames are: global attention gathers keys and values, and cues
                what they need of other frames; all else is local.
        """
        config, frames = self.config, compute.frames
        B, S, P, C = features.patch_tokens.shape
        T = config.special_tokens + P
        real = frames.are_real(frame_count, B, S)
        if real is not None:  # attention weighs padded values by 0, and 0 x NaN is NaN
            features = jax.tree.map(lambda x: jnp.where(real.reshape(B, S, *(1,) * (x.ndim - 2)), x, 0), features)
        tokens = self._tokens(features, camera_tokens, real, compute)
        ropes = partial(rope_table, grid, config.special_tokens, C // config.num_heads)
        rope, global_rope = ropes(), ropes(flat=config.row.flat_positions)

        block = partial(
            PackedBlock,
            config.num_heads,
            qk_norm=True,
            epsilon=config.row.block_epsilon,
            gated_mlp=config.gated_mlp,
            dtype=jnp.dtype(compute.compute_dtype),
        )
        attend: Any = _global_attention(compute, S, grid, config.special_tokens)
        is_real = None if real is None else jnp.repeat(real, T, axis=1)
        if config.leading_global:
            lead = partial(attend, suppressed=None, is_real=is_real)
            tokens, _, _ = block(name="leading_block")(tokens.reshape(B, S * T, C), global_rope, lead)
        pairs = over_layers(Pair, config.depth, store=activations(remat=compute.remat))(
            block(name="frame_blocks"),
            block(name="global_blocks"),
            shape=(B, S, T, C),
            rope=rope,
            global_rope=global_rope,
            attend=attend,
            captures=captures,
            accumulator=accumulator,
            frame_count=frame_count,
            hidden=suppression.hidden_tokens(config.special_tokens),
            suppress=suppression.suppress,
            is_real=is_real,
            frames=frames,
        )
        empty = Carry(
            tokens.reshape(B * S * T, C),
            camera=frames.varying(jnp.zeros((B, S, 2 * C), tokens.dtype)),
            taps=frames.varying(nothing_captured(captures, (B, S, T, 2 * C), tokens.dtype)),
            sums=None if accumulator is None else frames.varying(accumulator.zeros(B, S, P)),
        )
        inputs = PairInputs(
            suppression.active(config.depth, config.motion.mask_pairs),
            is_tapped=jnp.asarray(np.arange(config.depth)[:, None] == np.asarray(config.taps)[None]),
            counts=None if accumulator is None else jnp.asarray(accumulator.layer_counts()),
            is_early=jnp.asarray(early_pairs(config.depth)) if compute.attention == "sampled" else None,
        )
        last, _ = pairs(empty, inputs)
        return last.camera, last.taps, last.sums

    def _tokens(
        self,
        features: Features,
        camera_tokens: Float[Array, "B S C"] | None,
        real: Bool[Array, "B S"] | None,
        compute: Compute,
    ) -> Float[Array, "B S T C"]:
        """Prepend camera and register tokens: variant 0 for the reference frame, variant 1 for all others."""
        patches, row, frames = upcast(features.patch_tokens), self.config.row, compute.frames
        B, S, _, C = patches.shape
        special = self.param("camera_token", TABLE, (2, 1, C))
        if row.registers:
            registers = self.param("register_tokens", TABLE, (2, row.registers, C))
            special = jnp.concatenate([special, registers], axis=1)  # [2, 1 + R, C]
        is_other = jnp.asarray(frames.numbers(S) > 0)
        if features.class_tokens is not None:
            reference = reference_frame(features.class_tokens, real, compute)
            is_other = frames.numbers(S)[None] != reference[:, None]  # [B, S]
        special = special.astype(patches.dtype)[is_other.astype(int)]  # [(B,) S, 1 + R, C]
        if camera_tokens is not None:
            special = camera_tokens[:, :, None].astype(patches.dtype)
        special = jnp.broadcast_to(special, (B, S, self.config.special_tokens, C))
        return jnp.concatenate([special, patches], axis=2)


def reference_frame(
    class_tokens: Float[Array, "B S C"], real: Bool[Array, "B S"] | None = None, compute: Compute = Compute()
) -> Int[Array, " B"]:
    """Return the number of each clip's reference frame by `compute.reference`.

    It is 0 in clips of one or two frames, and with sampled attention, which sees the whole first frame.
    "chosen" is the most ordinary frame (Depth Anything 3, "saddle_balanced"). Three facts of a class token count, each
    scaled to [0, 1] over the clip: its mean similarity to the others, its norm, and the variance of its unit vector.
    The frame whose facts are closest to 0.5 is chosen.
    """
    tokens = compute.frames.gather(upcast(class_tokens))
    real = jnp.ones(tokens.shape[:2], bool) if real is None else compute.frames.gather(real)
    count = real.sum(axis=1)
    norm = jnp.linalg.norm(tokens, axis=-1)
    unit = tokens / jnp.where(norm > 0, norm, 1)[..., None]
    similarity = jnp.where(real[:, None], jnp.einsum("bsc,btc->bst", unit, unit), 0).sum(axis=-1)
    others = jnp.maximum(count - 1, 1)[:, None]
    facts = jnp.stack([(similarity - 1) / others, norm, unit.var(axis=-1)])  # [3, B, S]
    low = jnp.where(real[None], facts, jnp.inf).min(axis=-1, keepdims=True)
    high = jnp.where(real[None], facts, -jnp.inf).max(axis=-1, keepdims=True)
    distance = jnp.abs((facts - low) / (high - low + 1e-8) - 0.5).sum(axis=0)
    number = {
        "chosen": jnp.argmin(jnp.where(real, distance, jnp.inf), axis=-1),
        "first": jnp.zeros_like(count),
        "middle": count // 2,
    }["first" if compute.attention == "sampled" else compute.reference]
    return jnp.where(count < 3, 0, number)


def _global_attention(compute: Compute, S: int, grid: tuple[int, int], special_tokens: int) -> Attend:
    """Return attention over S frames of a clip, or over all frames of several devices.

    Raises InputError for an approximation on several devices.
    """
    if compute.frames.mesh is None:
        attend = compute.attention if callable(compute.attention) else GLOBAL_ATTENTION[compute.attention]
        return attend(S, grid, special_tokens)
    if compute.attention != "exact":
        raise InputError(f"attention is {compute.attention!r} on several devices; expected 'exact', or one device")
    return partial(suppressed_attention, frames=compute.frames)
