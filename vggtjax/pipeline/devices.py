"""The frames of one clip on several devices: the mesh, and where parameters and frames are on it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array

from vggtjax.errors import InputError, whole_number
from vggtjax.network.kernels.frames import AXIS, BY_FRAME, REPLICATED, Frames
from vggtjax.storage.backend import backend


def frames_mesh(devices: int) -> Mesh | None:
    """Return the mesh of the first `devices` devices, of all processes together; None for one device.

    Raises InputError for fewer devices than that.
    """
    backend()  # or an error that says what to do
    count, present = whole_number("devices", devices, 1), jax.devices()
    if count > len(present):
        advice = f"take at most {len(present)}"
        if present[0].platform == "cpu":
            advice += f", or split the CPU by XLA_FLAGS=--xla_force_host_platform_device_count={count}"
        raise InputError(f"devices is {count} and jax sees {len(present)} here; {advice}")
    return None if count == 1 else Mesh(np.array(present[:count]), (AXIS,))


def by_frame_padded(x: Array, mesh: Mesh) -> Array:
    """Return an array [B, S, ...] shared by the devices, with zeros after its frames that make shares equal.

    Raises InputError for a mesh without an axis of frames.
    """
    if AXIS not in mesh.axis_names:
        raise InputError(f"mesh has the axes {mesh.axis_names}; expected one named {AXIS!r}, as frames_mesh makes it")
    padding = shared_length(x.shape[1], mesh) - x.shape[1]
    return shard_frames(jnp.pad(x, ((0, 0), (0, padding), *((0, 0),) * (x.ndim - 2))) if padding else x, mesh)


def replicate(tree: Any, mesh: Mesh | None) -> Any:
    """Return the arrays on every device of the mesh; what is there already is not copied."""
    return jax.device_put(tree, Frames(mesh).sharding(REPLICATED))


def shard_frames(tree: Any, mesh: Mesh | None) -> Any:
    """Return arrays [B, S, ...] shared by the devices of the mesh, which S divides."""
    return jax.device_put(tree, Frames(mesh).sharding(BY_FRAME))


def on_host(x: Array | np.ndarray) -> np.ndarray:
    """Return an array of all devices, of those of other processes too."""
    if isinstance(x, Array) and not x.is_fully_addressable:
        from jax.experimental import multihost_utils

        return np.asarray(multihost_utils.process_allgather(x, tiled=True))
    return np.asarray(x)


def shared_length(frames: int, mesh: Mesh | None) -> int:
    """Return the number of frames rounded up, so that every device has a share of equal length."""
    devices = Frames(mesh).devices
    return -(-frames // devices) * devices
