"""Block-sparse global attention ("Faster VGGT with block-sparse global attention", arXiv 2509.07120), as measured.

Not a part of the package: `python -m benchmarks approximations` shows why.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtjax.network.attention import attention
from vggtjax.network.suppression import Attend, SuppressedKeys

QUERIES, KEYS = 128, 64  # patches of a block, as in the paper's code


def sparse_attention(
    S: int, grid: tuple[int, int], special_tokens: int, *, keep: float, queries: int = QUERIES, keys: int = KEYS
) -> Attend:
    """Return attention in which a block of patches sees the `keep` share of key blocks with the largest q . k.

    Queries and keys of a block are averaged for that choice, which each head makes. Special tokens see everything, and
    everything sees them. Keys that are suppressed or not real are left out, or set to 0, as in exact attention.
    """
    P = grid[0] * grid[1]
    blocks = math.ceil(S * P / keys)
    kept = max(1, math.ceil(keep * blocks))

    def cut(x: Float[Array, "L ..."], size: int) -> Float[Array, "b R ..."]:
        return jnp.pad(x, ((0, -len(x) % size), *((0, 0),) * (x.ndim - 1))).reshape(-1, size, *x.shape[1:])

    def split(x: Float[Array, "L ..."]) -> tuple[Array, Array]:
        x = x.reshape(S, special_tokens + P, *x.shape[1:])
        special, patches = x[:, :special_tokens], x[:, special_tokens:]
        return special.reshape(-1, *x.shape[2:]), patches.reshape(-1, *x.shape[2:])

    def one_clip(q, k, v, visible):
        _, N, D = q.shape
        (q_special, q), (k_special, k), (v_special, v), (sees_special, sees) = map(split, (q, k, v, visible))
        real_queries = np.minimum(queries, len(q) - queries * np.arange(math.ceil(len(q) / queries)))
        q, k, v, sees = cut(q, queries), cut(k, keys), cut(v, keys), cut(sees, keys)
        counts = sees.sum(axis=1)
        pooled = (k * sees[:, :, None, None]).sum(axis=1) / jnp.maximum(counts, 1)[:, None, None]
        scores = jnp.einsum("ind,jnd->nij", q.sum(axis=1) / real_queries[:, None, None], pooled)
        chosen = jax.lax.top_k(jnp.where(counts[None, None] > 0, scores, -jnp.inf), kept)[1]  # [N, i, kept]

        def one_head(head):
            q, k, v, chosen, k_special, v_special = head

            def one_block(block):
                q, chosen = block
                seen = jnp.concatenate([k[chosen].reshape(-1, D), k_special])[None, :, None]
                values = jnp.concatenate([v[chosen].reshape(-1, D), v_special])[None, :, None]
                visible = jnp.concatenate([sees[chosen].reshape(-1), sees_special])[None]
                return attention(q[None, :, None], seen, values, visible)[0, :, 0]

            return jax.lax.map(one_block, (q, chosen))

        by_head = [x.transpose(2, 0, 1, 3) for x in (q, k, v)]
        heads = (*by_head, chosen, k_special.swapaxes(0, 1), v_special.swapaxes(0, 1))
        patches = jax.lax.map(one_head, heads).reshape(N, -1, D)[:, : S * P].swapaxes(0, 1)
        return q_special, patches

    def attend(
        q: Float[Array, "B T N D"],
        k: Float[Array, "B T N D"],
        v: Float[Array, "B T N D"],
        suppressed: SuppressedKeys | None,
        is_real: Bool[Array, "B T"] | None = None,
    ) -> Float[Array, "B T N D"]:
        visible = jnp.ones(k.shape[:2], bool) if is_real is None else is_real
        if suppressed is not None:
            hidden = suppressed.keys & suppressed.active
            if suppressed.suppress == "zero":
                k = jnp.where(hidden[:, :, None, None], 0, k)
            else:
                visible = visible & ~hidden
        special, patches = jax.lax.map(lambda clip: one_clip(*clip), (q, k, v, visible))
        special = attention(special, k, v, visible).reshape(len(q), S, special_tokens, *q.shape[2:])
        patches = patches.reshape(len(q), S, P, *q.shape[2:])
        return jnp.concatenate([special, patches], axis=2).reshape(q.shape)

    return attend
