"""Ceilings: the best rates of this machine for each kind of work, at the shapes of the network.

The speed of a shared machine varies, so ceilings are measured before and after every timed run, and the floor of a run
follows from the measurements around it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from benchmarks.suite.measure import Sustained
from benchmarks.suite.work import Grid
from vggtjax.config import VGGTConfig

_IN_A_ROW = 16  # functions of the same array, and products with the same weights


class Probe(NamedTuple):
    """An amount of one kind of work, and a program that does it."""

    amount: float
    program: Sustained


class Ceilings:
    """Rates in FLOP, scalar functions or bytes per second, by kind of work, of every measurement."""

    def __init__(self, config: VGGTConfig, grid: Grid, dtype: str) -> None:
        """Compile the programs to measure, with enough work in each that the overhead of a call is negligible.

        Their inputs stay in memory: for VGGT-1B about 1 GB on a CPU, mostly the camera head's weights.

        Args:
            config: the model, whose numbers of channels are used.
            grid: rows and columns of patches; the convolution's map has four times as many of each.
            dtype: type of products in the blocks; heads are float32.
        """
        small = jax.default_backend() == "cpu"  # small enough for the cache; elsewhere, enough for all cores
        rows, queries, keys, values, pixels = (
            (1600, 800, 1600, 2**20, 2**14) if small else (2**15, 4096, 4096, 2**26, 2**17)
        )
        D = config.embed_dim // config.num_heads
        linear = {name: _linear(rows, config.embed_dim, name) for name in {dtype, "float32"}}
        self._probes: dict[str, Probe] = {
            "linear": linear[dtype],
            "linear, float32": linear["float32"],
            "attention": _attention(config.num_heads, queries, keys, D, dtype, loop=small),
            "exp": _repeated(lambda x: jnp.exp(-x), values),
            "GELU": _repeated(lambda x: jax.nn.gelu(x, approximate=False), values),
            "convolution": _convolution(pixels, (4 * grid[0], 4 * grid[1]), config.dpt_features),
            "weights": _reading(12 * config.camera_depth, config.tap_dim),
        }
        self.measurements: dict[str, list[float]] = {kind: [] for kind in self._probes}

    def measure(self) -> dict[str, float]:
        """Measure all kinds of work once more; return the rates."""
        rates = {probe: probe.amount / probe.program.seconds() for probe in set(self._probes.values())}
        measured = {kind: rates[probe] for kind, probe in self._probes.items()}
        for kind, rate in measured.items():
            self.measurements[kind].append(rate)
        return measured


class Rounds:
    """Numbers to loop over, one per timed run; ceilings are measured before the first run and after each run."""

    def __init__(self, count: int, ceilings: Ceilings) -> None:
        self._count, self._ceilings = count, ceilings
        self.rates: list[dict[str, float]] = []  # the better of the measurements before and after every run

    def __iter__(self) -> Iterator[int]:
        before = self._ceilings.measure()
        for number in range(self._count):
            yield number
            after = self._ceilings.measure()
            self.rates.append({kind: max(rate, after[kind]) for kind, rate in before.items()})
            before = after


def _linear(rows: int, C: int, dtype: str) -> Probe:
    """Return the four products of a block: qkv, projection, and both products of the MLP."""
    shapes = ((C, 3 * C), (C, C), (C, 4 * C), (4 * C, C))
    inputs = [_drawn((rows, shape[0]), dtype) for shape in shapes]
    kernels = [_drawn(shape, dtype) for shape in shapes]

    def products(inputs, kernels):
        return [jnp.matmul(x, w, preferred_element_type=jnp.float32) for x, w in zip(inputs, kernels, strict=True)]

    return Probe(2 * rows * sum(map(math.prod, shapes)), Sustained(products, (inputs, kernels)))


def _attention(heads: int, queries: int, keys: int, D: int, dtype: str, *, loop: bool) -> Probe:
    """Return both products of attention, without the softmax."""

    def one_head(inputs):
        q, k, v = inputs
        weights = jnp.matmul(q, k.T, preferred_element_type=jnp.float32).astype(q.dtype)
        return jnp.matmul(jax.lax.optimization_barrier(weights), v, preferred_element_type=jnp.float32)

    def products(inputs):
        return jax.lax.map(one_head, inputs) if loop else jax.vmap(one_head)(inputs)

    inputs = tuple(_drawn((heads, length, D), dtype) for length in (queries, keys, keys))
    return Probe(4 * heads * queries * keys * D, Sustained(products, (inputs,)))


def _repeated(function: Callable[[Array], Array], count: int) -> Probe:
    """Return a scalar function, applied to the same array repeatedly."""

    def repeated(x):
        return jax.lax.fori_loop(0, _IN_A_ROW, lambda _, x: function(x), x)

    return Probe(_IN_A_ROW * count, Sustained(repeated, (_drawn((count,)),)))


def _convolution(pixels: int, size: tuple[int, int], F: int) -> Probe:
    """Return a 3 x 3 convolution of maps of this size, with about `pixels` pixels in all, at least one map."""
    frames = max(pixels // math.prod(size), 1)

    def convolved(x, kernel):
        return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))

    arguments = (_drawn((frames, *size, F)), _drawn((3, 3, F, F)))
    return Probe(18 * frames * math.prod(size) * F**2, Sustained(convolved, arguments))


def _reading(matrices: int, E: int) -> Probe:
    """Return a product with a vector, with as many weights as the camera head's blocks."""
    weights = _drawn((matrices * E, E))

    def products(weights, x):
        return jax.lax.fori_loop(0, _IN_A_ROW, lambda _, x: (weights @ x)[:E], x)

    return Probe(_IN_A_ROW * weights.nbytes, Sustained(products, (weights, _drawn((E,)))))


def _drawn(shape: tuple[int, ...], dtype: str = "float32") -> Array:
    return jnp.asarray(0.1 * np.random.default_rng(0).standard_normal(shape, np.float32), dtype)
