"""What this machine does at best of each kind of work, at the shapes that the network gives it.

A machine whose cores others use as well is not equally fast all the time, so it is looked at before and after every
timed run, and what a run could have taken at least is told from the looks beside it.
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
    """FLOP, functions of a number and bytes per second, by kind of work, of every look."""

    def __init__(self, config: VGGTConfig, grid: Grid, dtype: str) -> None:
        """Make ready to look. Small shapes are made so many that what a call costs does not count.

        What is looked at stays in memory: for VGGT-1B about 1 GB on a CPU, most of it the camera head's weights.

        Args:
            config: the model whose channels are taken.
            grid: rows and columns of patches, of which the convolution's map is four times as large.
            dtype: of products in the blocks; heads are float32.
        """
        small = jax.default_backend() == "cpu"  # as much as stays in the cache; elsewhere, enough for all cores
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
        self.looks: dict[str, list[float]] = {kind: [] for kind in self._probes}

    def look(self) -> dict[str, float]:
        """Measure all kinds of work once more, and return that."""
        rates = {probe: probe.amount / probe.program.seconds() for probe in set(self._probes.values())}
        look = {kind: rates[probe] for kind, probe in self._probes.items()}
        for kind, rate in look.items():
            self.looks[kind].append(rate)
        return look


class Rounds:
    """Numbers to loop over, one per timed run, with a look at the ceilings before the first and after each."""

    def __init__(self, count: int, ceilings: Ceilings) -> None:
        self._count, self._ceilings = count, ceilings
        self.rates: list[dict[str, float]] = []  # the better of the looks before and after every run

    def __iter__(self) -> Iterator[int]:
        before = self._ceilings.look()
        for number in range(self._count):
            yield number
            after = self._ceilings.look()
            self.rates.append({kind: max(rate, after[kind]) for kind, rate in before.items()})
            before = after


def _linear(rows: int, C: int, dtype: str) -> Probe:
    """The four products of a block: q, k and v, projection, and both of the MLP."""
    shapes = ((C, 3 * C), (C, C), (C, 4 * C), (4 * C, C))
    inputs = [_drawn((rows, shape[0]), dtype) for shape in shapes]
    kernels = [_drawn(shape, dtype) for shape in shapes]

    def products(inputs, kernels):
        return [jnp.matmul(x, w, preferred_element_type=jnp.float32) for x, w in zip(inputs, kernels, strict=True)]

    return Probe(2 * rows * sum(map(math.prod, shapes)), Sustained(products, (inputs, kernels)))


def _attention(heads: int, queries: int, keys: int, D: int, dtype: str, *, loop: bool) -> Probe:
    """Both products of attention, without the softmax between them."""

    def one_head(inputs):
        q, k, v = inputs
        weights = jnp.matmul(q, k.T, preferred_element_type=jnp.float32).astype(q.dtype)
        return jnp.matmul(jax.lax.optimization_barrier(weights), v, preferred_element_type=jnp.float32)

    def products(inputs):
        return jax.lax.map(one_head, inputs) if loop else jax.vmap(one_head)(inputs)

    inputs = tuple(_drawn((heads, length, D), dtype) for length in (queries, keys, keys))
    return Probe(4 * heads * queries * keys * D, Sustained(products, (inputs,)))


def _repeated(function: Callable[[Array], Array], count: int) -> Probe:
    """A function of single numbers, again and again of the same array."""

    def repeated(x):
        return jax.lax.fori_loop(0, _IN_A_ROW, lambda _, x: function(x), x)

    return Probe(_IN_A_ROW * count, Sustained(repeated, (_drawn((count,)),)))


def _convolution(pixels: int, size: tuple[int, int], F: int) -> Probe:
    """A 3 x 3 convolution of as many maps of this size as have about so many pixels, one at least."""
    frames = max(pixels // math.prod(size), 1)

    def convolved(x, kernel):
        return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))

    arguments = (_drawn((frames, *size, F)), _drawn((3, 3, F, F)))
    return Probe(18 * frames * math.prod(size) * F**2, Sustained(convolved, arguments))


def _reading(matrices: int, E: int) -> Probe:
    """A product with a vector, over as many weights as the camera head's blocks have."""
    weights = _drawn((matrices * E, E))

    def products(weights, x):
        return jax.lax.fori_loop(0, _IN_A_ROW, lambda _, x: (weights @ x)[:E], x)

    return Probe(_IN_A_ROW * weights.nbytes, Sustained(products, (weights, _drawn((E,)))))


def _drawn(shape: tuple[int, ...], dtype: str = "float32") -> Array:
    return jnp.asarray(0.1 * np.random.default_rng(0).standard_normal(shape, np.float32), dtype)
