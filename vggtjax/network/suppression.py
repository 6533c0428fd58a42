"""The suppression of dynamic keys (4DVGGT-D, stage 2): what a pass suppresses, and the attention of one block."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from vggtjax.config import Suppress
from vggtjax.errors import InputError, check_choice, whole_number
from vggtjax.network.kernels.attention import attention
from vggtjax.network.kernels.frames import Frames
from vggtjax.network.kernels.gathered_attention import gathered_attention


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("dynamic_tokens", "mask_pairs", "strength"),
    meta_fields=("suppress",),
)
@dataclass(frozen=True)
class Suppression:
    """The keys that a pass suppresses: a pytree whose leaves are arrays; `suppress` is static under jit.

    Attributes:
        dynamic_tokens: patches whose keys are suppressed, [B, S, H / patch, W / patch]; None for the plain pass. Shares
            m in [0, 1] in place of booleans scale a key by 1 - m, with a gradient with respect to m.
        suppress: "zero" (the key becomes 0, 4DVGGT-D) or "drop" (key and value are excluded from the softmax, VGGT4D;
            not with shares or a strength).
        mask_pairs: number of pairs of blocks, from the first, in which keys are suppressed (L_mask of the paper); the
            number that the model's configuration recommends if None. It can be traced: one compilation serves all
            numbers.
        strength: share of the suppression in every pair, in [0, 1], in place of `mask_pairs`: a key is scaled by
            1 - strength m.
    """

    dynamic_tokens: Bool[Array, "B S h w"] | Float[Array, "B S h w"] | None = None
    suppress: Suppress = "zero"
    mask_pairs: int | Int[Array, ""] | None = None
    strength: Float[Array, " depth"] | None = None

    def check(self, shape: tuple[int, ...], depth: int) -> None:
        """Raise InputError unless the values fit patches of shape (B, S, h, w) and a model with `depth` pairs."""
        tokens, strength = self.dynamic_tokens, self.strength
        if tokens is not None and tuple(tokens.shape) != shape:
            raise InputError(f"dynamic_tokens have shape {tuple(tokens.shape)}; expected {shape}")
        shares = tokens is not None and jnp.issubdtype(tokens.dtype, jnp.floating)
        if tokens is not None and tokens.dtype != bool and not shares:
            raise InputError(f"dynamic_tokens have type {tokens.dtype}; expected bool, or shares as floats")
        if self.mask_pairs is not None and not isinstance(self.mask_pairs, Tracer):
            whole_number("mask_pairs", self.mask_pairs, 0)
        check_choice("suppress", self.suppress, get_args(Suppress))
        if self.suppress != "zero" and (shares or strength is not None):
            raise InputError(
                f"suppress is {self.suppress!r} with shares of tokens or a strength; expected 'zero': a key cannot "
                "be dropped in part"
            )
        if strength is not None and tuple(strength.shape) != (depth,):
            raise InputError(f"strength has shape {tuple(strength.shape)}; expected {(depth,)}, one for each pair")

    def hidden_tokens(self, special_tokens: int) -> Bool[Array, "B S T"] | Float[Array, "B S T"] | None:
        """Return which tokens have suppressed keys, or their shares; never the special tokens before the patches."""
        tokens = self.dynamic_tokens
        if tokens is None:
            return None
        if self.strength is not None:
            tokens = tokens.astype(jnp.promote_types(tokens.dtype, self.strength.dtype))
        return jnp.pad(tokens.reshape(*tokens.shape[:2], -1), ((0, 0), (0, 0), (special_tokens, 0)))

    def active(self, depth: int, recommended: int) -> Bool[Array, " depth"] | Float[Array, " depth"]:
        """Return in which pairs keys are suppressed: flags for boolean tokens, the share of each pair for shares.

        `recommended` is the number of pairs where none is given.
        """
        if self.strength is not None:
            return self.strength
        pairs = jnp.arange(depth) < (recommended if self.mask_pairs is None else self.mask_pairs)
        tokens = self.dynamic_tokens
        return pairs if tokens is None or tokens.dtype == bool else pairs.astype(tokens.dtype)


@dataclass(frozen=True)
class SuppressedKeys:
    """The keys that one block suppresses; `active` is the pair's flag, or the share of the suppression for shares."""

    hidden: Bool[Array, "B T"] | Float[Array, "B T"]
    active: Bool[Array, ""] | Float[Array, ""]
    suppress: Suppress

    @property
    def are_shares(self) -> bool:
        """Whether keys are scaled by `scaled`, not hidden as a whole."""
        return jnp.issubdtype(self.hidden.dtype, jnp.floating)

    def scaled(self, k: Float[Array, "B T N D"]) -> Float[Array, "B T N D"]:
        """Return the keys, scaled by 1 - their shares."""
        return k * (1 - self.active * self.hidden).astype(k.dtype)[:, :, None, None]


# (q, k, v, suppressed keys, real tokens) -> outputs: `suppressed_attention`, or an approximation of it
Attend = Callable[[Array, Array, Array, SuppressedKeys | None, Array | None], Array]


def suppressed_attention(
    q: Float[Array, "B T N D"],
    k: Float[Array, "B T N D"],
    v: Float[Array, "B T N D"],
    suppressed: SuppressedKeys | None = None,
    is_real: Bool[Array, "B T"] | None = None,
    frames: Frames = Frames(),
) -> Float[Array, "B T N D"]:
    """Return attention with suppressed keys where the pair's flag is set; keys that are not real are always excluded.

    "zero" replaces a suppressed key by 0; its logit 0 stays in the softmax (4DVGGT-D). "drop" excludes key and value
    (VGGT4D). The flag is a scalar per pair, so the choice is a branch, not a select. A share m scales the key by 1 - m,
    which equals "zero" for shares of 0 and 1. With `frames` on several devices, queries see the keys of all of them.
    """
    attend = attention if frames.mesh is None else partial(gathered_attention, frames=frames)
    if suppressed is None:
        return attend(q, k, v, is_real)
    if suppressed.are_shares:
        return attend(q, suppressed.scaled(k), v, is_real)

    def zero(q, k, v, hidden):
        return attend(q, jnp.where(hidden[:, :, None, None], 0, k), v, is_real)

    def drop(q, k, v, hidden):
        return attend(q, k, v, ~hidden if is_real is None else ~hidden & is_real)

    def plain(q, k, v, hidden):
        return attend(q, k, v, is_real)

    masked = {"zero": zero, "drop": drop}[suppressed.suppress]
    with jax.named_scope("suppress"):
        return jax.lax.cond(suppressed.active, masked, plain, q, k, v, suppressed.hidden)
