"""Every way to compute attention, against the CPU's numbers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gpu_day.lines import Lines
from benchmarks.suite.cases import Size
from benchmarks.suite.measure import timed
from vggtjax.network.kernels import attention, cpu_attention

Path = Callable[..., jax.Array]  # queries, keys, values, visible keys or None

_MOST = {"float32": 1e-4, "bfloat16": 0.05}  # error in standard deviations of the CPU's float32 numbers
_REPEATS = 3
_SHAPES = {  # clips or frames, tokens, heads, channels
    "tiny": {"frame attention": (2, 37, 2, 16)},
    "full": {"frame attention": (8, 1041, 16, 64), "global attention": (1, 8 * 1041, 16, 64)},
}


def attention_paths(size: Size, lines: Lines) -> None:
    """Compare outputs, and the gradient by the queries of the path that is chosen here, with and without a mask."""
    cpu = jax.local_devices(backend="cpu")[0]
    for name, shape in _SHAPES["tiny" if size == "tiny" else "full"].items():
        generator = np.random.default_rng(0)
        q, k, v = (generator.standard_normal(shape, np.float32) for _ in range(3))
        visible = generator.random(shape[:2]) < 0.7
        for dtype, most in _MOST.items():
            inputs = [jnp.asarray(x, dtype) for x in (q, k, v)]
            q32, k32, v32 = (np.asarray(x, np.float32) for x in inputs)
            for mask in (None, visible):
                with jax.default_device(cpu):
                    expected = np.asarray(_run(cpu_attention.attention_in_chunks, q32, k32, v32, mask))
                    gradient = np.asarray(_run(_gradient(cpu_attention.attention_in_chunks), q32, k32, v32, mask))
                for path, function in _paths(dtype).items():
                    wanted = gradient if "gradient" in path else expected
                    row = {"shape": name, "path": path, "mask": "no" if mask is None else "yes"}
                    title = f"{dtype}: error in deviations of the CPU's numbers, the fastest of {_REPEATS} runs"
                    lines.row(title, **row, **_compared(function, inputs, mask, wanted, most))


def _paths(dtype: str) -> dict[str, Path | None]:
    """Return the ways by name; None for one that this machine or type does not have."""
    cudnn = dtype == "bfloat16" and jax.default_backend() == "gpu" and attention.cudnn_works()
    return {
        "chosen here": attention.attention,
        "chosen here, gradient": _gradient(attention.attention),
        "at once": attention._at_once,
        "as many clips as fit": _cut,
        "in chunks": cpu_attention.attention_in_chunks,
        "cuDNN": partial(attention._packed, implementation="cudnn") if cudnn else None,
        "kernel for TPUs": attention._on_tpu if jax.default_backend() == "tpu" else None,
    }


def _cut(q, k, v, visible):
    """Compute one clip at a time, as where the logits of all do not fit."""
    with mock.patch.object(attention, "LOGITS_AT_ONCE", q.shape[2] * q.shape[1] * k.shape[1]):
        return attention._at_once_or_in_chunks(q, k, v, visible)


def _gradient(path: Path) -> Path:
    def gradient(q, k, v, visible):
        return jax.grad(lambda q: path(q, k, v, visible).astype(jnp.float32).sum())(q)

    return gradient


def _run(path: Path, q, k, v, visible):
    with jax.default_matmul_precision("highest"):
        return jax.jit(path)(q, k, v, visible)


def _compared(path: Path | None, inputs, visible, expected: np.ndarray, most: float) -> dict[str, float | bool | str]:
    if path is None:
        return {"error": "not on this machine, or not for this type"}
    with jax.default_matmul_precision("highest"):
        run = jax.jit(path).lower(*inputs, visible).compile()
    made = np.asarray(run(*inputs, visible), np.float32)
    seconds = min(timed(lambda: jax.block_until_ready(run(*inputs, visible)))[1] for _ in range(_REPEATS))
    error = float(np.abs(made - expected).max() / expected.std())
    return {"error": error, "at_most": most, "holds": error <= most, "ms": 1e3 * seconds}
