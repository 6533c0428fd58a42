"""Whether this computer's CPU multiplies bfloat16 faster than float32: a trial of a few products, made once and kept.

A run that is stopped and started again has to compute in the same type, however busy the computer is by then.
"""

from __future__ import annotations

import hashlib
import json
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vggtjax.errors import VggtjaxError, one_line
from vggtjax.storage.cache import TRIALS, cache_folder
from vggtjax.storage.process import core_count
from vggtjax.storage.writing import writing

_UNITS = {"amx_bf16", "avx512_bf16", "bf16"}  # as Linux names them: Intel's AMX; Intel and AMD; ARM
_CPU_INFO = Path("/proc/cpuinfo")
_FEWEST_CHANNELS = 512  # a smaller model's products are too small to gain
_FASTER = 1.5  # at least so many times as fast are products in bfloat16 where it is chosen
_ROWS, _ROUNDS = 512, 5


class DtypeChoice(NamedTuple):
    """A type for the transformer's products on a CPU, and why."""

    dtype: str
    reason: str


def choose_dtype(channels: int) -> DtypeChoice | None:
    """Return bfloat16 where this CPU multiplies it much faster, else float32; None for a model too small to gain.

    `channels` are those of the transformer's tokens. The trial takes about a third of a second, mostly to compile; the
    user's cache keeps its outcome for this processor, number of cores and version of jax.
    """
    if channels < _FEWEST_CHANNELS:
        return None
    facts = _facts()
    if not any(_UNITS & set(values.split()) for name, values in facts if name in ("flags", "features")):
        return DtypeChoice("float32", "this processor has no known unit for bfloat16")
    try:
        gain = _kept_gain(facts, channels)
    except Exception as error:  # whatever fails, float32 works
        return DtypeChoice("float32", f"the trial of bfloat16 failed: {one_line(str(error)) or type(error).__name__}")
    reason = f"this processor multiplies bfloat16 {gain:.1f} times as fast as float32"
    return DtypeChoice("bfloat16" if gain >= _FASTER else "float32", reason)


def _facts() -> list[tuple[str, str]]:
    """Return what Linux says of the first processor, as names and values; nothing on other systems."""
    with suppress(OSError):
        first = _CPU_INFO.read_text(encoding="utf-8", errors="replace").partition("\n\n")[0]
        rows = (line.partition(":") for line in first.splitlines())
        return [(name.strip().lower(), value.strip()) for name, _, value in rows]
    return []


def _kept_gain(facts: list[tuple[str, str]], channels: int) -> float:
    """Return how many times as fast bfloat16 is, as an earlier run measured it, or measured now and kept."""
    named = [value for name, value in facts if name in ("model name", "cpu implementer", "cpu part")]
    text = json.dumps([named, core_count(), jax.__version__, channels])
    path = cache_folder() / TRIALS / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"
    with suppress(OSError, ValueError, TypeError, KeyError):
        return float(json.loads(path.read_text(encoding="utf-8"))["gain"])
    narrow, wide = _seconds(channels)
    # A cache that cannot be written costs the next run a third of a second.
    with suppress(VggtjaxError, OSError), writing(path) as temporary:
        temporary.write_text(json.dumps({"gain": wide / narrow}), encoding="utf-8")
    return wide / narrow


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
