"""Timing, and memory: XLA's own analysis, and the peaks of the process and of the device."""

from __future__ import annotations

import ctypes
import gc
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from tests.shared.high_water import reset_high_water
from vggtjax.network.precision import full_precision
from vggtjax.storage.memory import process_bytes

_SUSTAINED = 0.05  # seconds


@dataclass(frozen=True)
class Measured:
    """Time and memory of a workload; None where unknown on this platform."""

    seconds: tuple[float, ...] = ()  # of the timed runs
    compile_seconds: float | None = None
    temp_bytes: int | None = None  # by XLA's analysis
    output_bytes: int | None = None
    host_bytes: int | None = None  # peak of the process in a run above its start, with weights loaded in the run
    device_bytes: int | None = None  # peak of the device; None also if an earlier run had a higher peak
    failure: str = ""

    @property
    def median(self) -> float | None:
        return float(np.median(self.seconds)) if self.seconds else None

    @property
    def xla_bytes(self) -> int | None:
        """Working memory and outputs."""
        return None if self.temp_bytes is None or self.output_bytes is None else self.temp_bytes + self.output_bytes


def measure_program(
    function: Callable[..., Any],
    arguments: tuple,
    rounds: Iterable[int],
    read: Callable[[Any], None] = lambda compiled: None,
) -> Measured:
    """Compile a function of arrays, run it once for its memory, then time one run per round.

    `read` is given the compiled program before it runs.
    """
    (compiled,), compile_seconds = timed(lambda: (jax.jit(function).lower(*arguments).compile(),))
    read(compiled)
    temp, output = analysed(compiled)

    def run() -> None:
        jax.block_until_ready(compiled(*arguments))

    host, device = memory_of(run)
    return Measured(tuple(timed(run)[1] for _ in rounds), compile_seconds, temp, output, host, device)


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Return a call's result and its seconds."""
    began = time.perf_counter()
    result = call()
    return result, time.perf_counter() - began


class Sustained:
    """A compiled function of arrays, run in series long enough for the clock."""

    def __init__(self, function: Callable[..., Any], arguments: tuple) -> None:
        self._arguments = arguments
        self._compiled = jax.jit(full_precision()(function)).lower(*arguments).compile()
        self._series(1)
        self._count = min(max(math.ceil(_SUSTAINED / self._series(1)), 1), 1000)

    def seconds(self, repeats: int = 5) -> float:
        """Return the seconds of a run in the fastest of several series."""
        return min(self._series(self._count) for _ in range(repeats))

    def _series(self, count: int) -> float:
        run = self._compiled
        return timed(lambda: jax.block_until_ready([run(*self._arguments) for _ in range(count)][-1]))[1] / count


def analysed(compiled: Any) -> tuple[int | None, int | None]:
    """Return the temporary and output bytes of a compiled program, by XLA's own analysis."""
    analysis = compiled.memory_analysis()
    return (None, None) if analysis is None else (analysis.temp_size_in_bytes, analysis.output_size_in_bytes)


def memory_of(run: Callable[[], object]) -> tuple[int | None, int | None]:
    """Run; return the peak bytes of the process and of the device, minus their bytes before."""
    gc.collect()
    _give_back()
    had, device_had = reset_high_water(), _device_memory()
    run()
    device_has, has = _device_memory(), process_bytes("VmHWM")
    host = None if had is None or has is None else max(has - had, 0)
    rose = device_has.get("peak_bytes_in_use", 0) > device_had.get("peak_bytes_in_use", 0)
    return host, device_has["peak_bytes_in_use"] - device_had["bytes_in_use"] if rose else None


def without_memory(call: Callable[[], dict[str, Measured]]) -> dict[str, Measured]:
    """Return a call's result, or one failure if memory runs out."""
    try:
        return call()
    except MemoryError:
        pass
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
    return {"": Measured(failure="out of memory")}


@contextmanager
def compiling_anew() -> Iterator[None]:
    """Compile without jax's cache on disk."""
    before = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)


def _give_back() -> None:
    """Make glibc return freed memory, so that the next run's memory is visible."""
    if sys.platform.startswith("linux") and hasattr(ctypes.CDLL(None), "malloc_trim"):
        ctypes.CDLL(None).malloc_trim(0)


def _device_memory() -> dict[str, int]:
    return jax.local_devices()[0].memory_stats() or {}
