"""Rates of alternative implementations on a CPU: python -m benchmarks leads.

Every row is one implementation of a piece of VGGT-1B's work, in float32 unless named bfloat16. Rates count the
operations that the piece requires, not those executed. Choices in `vggtjax.network` follow these rates.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from vggtjax.errors import InputError
from vggtjax.network.attention import QUERIES_AT_ONCE, _attended, _in_chunks
from vggtjax.network.dpt_head import resize_aligned
from vggtjax.network.layers import MLP, apply, declare
from vggtjax.network.pieces import in_pieces
from vggtjax.storage.kept_memory import keep_freed_memory

C, N, D = 1024, 16, 64

Way = tuple[str, str, float, Callable[..., Any], tuple]  # piece, way, operations, function, inputs


def leads(*, frames: int = 2, tokens: int = 782, repeats: int = 5) -> None:
    """Measure implementations of the pieces of a pass.

    Args:
        frames: frames of a clip.
        tokens: tokens of a frame; 782 for 518 x 294 pixels.
        repeats: timed runs of each; the fastest counts.
    """
    if min(frames, tokens, repeats) < 1:
        raise InputError(f"frames, tokens and repeats are {frames}, {tokens} and {repeats}; expected at least 1")
    keep_freed_memory()
    console = Console()
    table = Table(title=f"{frames} frames of {tokens} tokens, {jax.devices()[0].device_kind}", box=None)
    for heading in ("piece", "way"):
        table.add_column(heading)
    for heading in ("ms", "GFLOP/s"):
        table.add_column(heading, justify="right")
    with jax.default_matmul_precision("highest"), console.status("measuring"):
        for piece, way, operations, function, inputs in _ways(frames, tokens):
            seconds = _fastest(function, inputs, repeats)
            rate = f"{operations / seconds / 1e9:.0f}" if operations else "-"
            table.add_row(piece, way, f"{1e3 * seconds:.1f}", rate)
    console.print(table)


def _fastest(function: Callable, inputs: tuple, repeats: int) -> float:
    compiled = jax.jit(function).lower(*inputs).compile()
    jax.block_until_ready(compiled(*inputs))
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(compiled(*inputs))
        times.append(time.perf_counter() - began)
    return min(times)


def _ways(frames: int, tokens: int) -> list[Way]:
    generator = np.random.default_rng(0)

    def draw(*shape: int, dtype=jnp.float32):
        return jnp.asarray(generator.standard_normal(shape, np.float32), dtype)

    M = frames * tokens
    x, wide = draw(M, C), draw(C, 4 * C)
    linear = 2 * M * C * 4 * C
    ways: list[Way] = [
        ("linear layer", "float32", linear, jnp.matmul, (x, wide)),
        (
            "linear layer",
            "bfloat16 to float32",
            linear,
            partial(jnp.matmul, preferred_element_type=jnp.float32),
            (x.astype(jnp.bfloat16), wide.astype(jnp.bfloat16)),
        ),
    ]
    weights = jax.tree.map(lambda leaf: 0.02 * draw(*leaf.shape), jax.eval_shape(lambda: declare(MLP(4 * C, C), x)))
    mlp = lambda weights, x: apply(MLP(4 * C, C), weights, x)  # noqa: E731
    ways += [
        ("MLP", "all tokens at once", 2 * linear, mlp, (weights, x)),
        ("MLP", "in pieces", 2 * linear, lambda weights, x: in_pieces(partial(mlp, weights), x), (weights, x)),
    ]
    q, k, v = (draw(1, M, N, D) for _ in range(3))
    products = 4 * M * M * C

    def per_head(attended: Callable, chunk: int) -> Callable:
        def heads(q, k, v):
            def one(inputs):
                q, k, v = inputs
                cut = jnp.pad(q, ((0, -M % chunk), (0, 0))).reshape(-1, chunk, D)
                return jax.lax.map(lambda some: attended(some, k, v), cut)

            return jax.lax.map(one, tuple(x[0].swapaxes(0, 1) for x in (q * D**-0.5, k, v)))

        return heads

    def bounded(q, k, v):
        weights = jnp.exp(q @ k.T)
        return weights @ v / weights.sum(axis=-1, keepdims=True)

    def no_softmax(q, k, v):
        return (q @ k.T) @ v

    ways += [
        ("global attention", "jax.nn", products, jax.nn.dot_product_attention, (q, k, v)),
        ("global attention", "ours", products, lambda q, k, v: _in_chunks(q, k, v, None), (q, k, v)),
    ]
    for chunk in sorted({min(size, M) for size in (256, 512, QUERIES_AT_ONCE, 1600)}):
        attended = lambda q, k, v: _attended(q, k, v, None)  # noqa: E731
        ways.append(("global attention", f"a head, {chunk} queries", products, per_head(attended, chunk), (q, k, v)))
    chunk = min(QUERIES_AT_ONCE, M)
    for name, attended in (("without the maximum", bounded), ("without softmax", no_softmax)):
        ways.append(
            ("global attention", f"a head, {chunk} queries, {name}", products, per_head(attended, chunk), (q, k, v))
        )
    image, kernel = draw(frames, 84, 148, 256), draw(3, 3, 256, 256)
    convolution = 2 * 9 * frames * 84 * 148 * 256 * 256
    conv = partial(
        jax.lax.conv_general_dilated, window_strides=(1, 1), padding="SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    half = (image.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16))
    ways += [
        ("convolution 3 x 3", "float32", convolution, conv, (image, kernel)),
        ("convolution 3 x 3", "bfloat16", convolution, conv, half),
        ("resize to double", "take + lerp", 0, lambda x: resize_aligned(x, (168, 296)), (image,)),
    ]
    return ways
