"""Whether this computer's CPU multiplies bfloat16 faster than float32: a trial of a few products."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

_UNITS = {"amx_bf16", "avx512_bf16", "bf16"}  # as Linux names them: Intel's AMX; Intel and AMD; ARM
_CPU_INFO = Path("/proc/cpuinfo")
_FEWEST_CHANNELS = 512  # a smaller model's products are too small to gain
_FASTER = 1.5  # at least so many times as fast are products in bfloat16 where it is chosen
_ROWS, _ROUNDS = 512, 5


class Choice(NamedTuple):
    """A type for the transformer's products on a CPU, and why."""

    dtype: str
    reason: str


def choose_dtype(channels: int) -> Choice | None:
    """Return bfloat16 where this CPU multiplies it much faster, else float32; None for a model too small to gain.

    `channels` are those of the transformer's tokens. The trial takes about a third of a second, mostly to compile.
    """
    if channels < _FEWEST_CHANNELS:
        return None
    if not _has_unit():
        return Choice("float32", "this processor has no known unit for bfloat16")
    try:
        narrow, wide = _seconds(channels)
    except (RuntimeError, MemoryError) as error:
        return Choice("float32", f"the trial of bfloat16 failed: {str(error).splitlines()[0]}")
    gain = f"this processor multiplies bfloat16 {wide / narrow:.1f} times as fast as float32"
    return Choice("bfloat16" if wide >= _FASTER * narrow else "float32", gain)


def _has_unit() -> bool:
    """Return whether Linux names a unit for bfloat16; False on other systems."""
    try:
        text = _CPU_INFO.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    rows = (line.partition(":") for line in text.splitlines())
    return any(
        _UNITS & set(values.split()) for name, _, values in rows if name.strip().lower() in ("flags", "features")
    )


def _seconds(channels: int) -> tuple[float, float]:
    """Return the shortest times of the MLP's first product in bfloat16, summed in float32, and in float32."""

    @jax.jit
    def product(x, kernel):
        return jnp.matmul(x, kernel, preferred_element_type=jnp.float32)

    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        shapes = ((_ROWS, channels), (channels, 4 * channels))
        inputs = [[jnp.ones(shape, dtype) for shape in shapes] for dtype in ("bfloat16", "float32")]

        def once(arrays) -> float:
            started = time.perf_counter()
            jax.block_until_ready(product(*arrays))
            return time.perf_counter() - started

        rounds = [[once(arrays) for arrays in inputs] for _ in range(1 + _ROUNDS)][1:]  # the first one compiles
    narrow, wide = (min(times) for times in zip(*rounds, strict=True))
    return narrow, wide
