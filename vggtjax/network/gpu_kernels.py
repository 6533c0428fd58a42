"""Whether a kernel that is not XLA's own can be in a program: jax has to divide it, and the GPU has to run it."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp


def is_in_shard_map() -> bool:
    """Return whether what is traced is the program of one device."""
    return bool(jax.sharding.get_abstract_mesh().manual_axes)


def is_on_one(backend: str) -> bool:
    """Return whether arrays are on one device: jax cannot divide the work of a kernel among several."""
    return is_in_shard_map() or jax.default_backend() != backend or jax.device_count() == 1


def compiles_for_gpus() -> bool:
    """Return whether jax compiles for NVIDIA GPUs here."""
    return any(find_spec(f"jax_cuda{version}_plugin") for version in (12, 13))


def runs(function: Callable[..., Any], *shapes: jax.ShapeDtypeStruct) -> bool:
    """Return whether a function runs on the first NVIDIA GPU; without a GPU, whether jax lowers it for one.

    jax 0.11 lowers Pallas's kernels only where a GPU is there, or named as that of an abstract mesh.
    """
    try:
        try:
            device = jax.local_devices(backend="cuda")[0]
        except RuntimeError:
            jax.jit(function).trace(*shapes).lower(lowering_platforms=("cuda",))
            return True
        with jax.ensure_compile_time_eval(), jax.default_device(device):
            jax.block_until_ready(function(*(jnp.ones(shape.shape, shape.dtype) for shape in shapes)))
    except Exception:  # a library that is missing, too old or too new, or too old a GPU: XLA computes it
        return False
    return True
