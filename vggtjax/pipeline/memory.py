"""The memory that a clip needs when all of its frames are run together, predicted before it is loaded.

It is the weights, the process, and the larger of two: what the compiler takes of programs that are compiled side by
side, and what the passes hold: the blocks of every frame, the dense head of the frames that it computes at once, and
pictures and results. Devices that share the frames hold keys and values of all of them, too. On a CPU the rates are
fitted to XLA's own counts of both passes, and to measured peaks of processes that compile their programs
(`python -m benchmarks memory`); on a GPU to XLA's counts alone (`python -m benchmarks accelerator`).
"""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any, NamedTuple, Protocol, TypedDict, Unpack

import jax

from vggtjax.clips.clip import MOST_BYTES
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.heads.dpt_head import HIDDEN, PIXELS_AT_ONCE
from vggtjax.network.kernels.cpu_attention import LOGITS_OF_ALL_HEADS, chunk_count
from vggtjax.network.kernels.gathered_attention import GATHERED_AT_ONCE
from vggtjax.options import find_method, has_accelerator
from vggtjax.storage.memory import Room, host_room

ERROR = 0.15  # of a measured peak: predictions are as near
_FLOAT = 4  # bytes
_PROCESS = 0.54e9  # Python, libraries, the compiler of one pass
_COMPILING = 0.26e9  # more than that, where the second pass has a program of its own


class Rates(NamedTuple):
    """What a platform holds."""

    rows: float  # copies of a frame's tokens, in and between the blocks
    maps: float  # copies of the dense head's maps at full resolution
    pixel: float  # bytes: pictures, the results of both passes, and what is made of them before it is written


_CPU = Rates(rows=12.5, maps=0.5, pixel=150.0)
_ACCELERATOR = Rates(rows=7.9, maps=0.6, pixel=60.0)  # blocks in bfloat16; what is written is on the host

_GB = 1e9
GPUS = {"h100": 80 * _GB, "h200": 141 * _GB, "a100": 80 * _GB, "l4": 24 * _GB, "rtx4090": 24 * _GB, "rtx3090": 24 * _GB}


class Sized(Protocol):
    """What is known of a model, loaded or not."""

    @property
    def config(self) -> VGGTConfig: ...

    @property
    def parameter_bytes(self) -> int: ...


class Load(TypedDict, total=False):
    """What is in memory beside a clip's frames: passes of the method, more clips at the same time, more devices."""

    method: str
    clips: int
    devices: int


def predicted_bytes(
    model: Sized,
    frames: int,
    height: int,
    width: int,
    *,
    method: str = "4dvggt-d",
    clips: int = 1,
    devices: int = 1,
    accelerator: bool | None = None,
) -> float:
    """Return how much memory a method takes on all frames of a clip at once, with the model and the process.

    On a GPU that is the memory of one device, and the process is not counted; on a CPU the devices of this process
    share its memory. `accelerator` tells which it is, by default by what jax has. `clips` such clips are held at the
    same time: in a batch one is computed while the next is read and the last is written. The frames are shared by
    `devices`, each with a copy of the weights.
    """
    host = not (has_accelerator() if accelerator is None else accelerator)
    here = min(devices, jax.local_device_count()) if host else 1  # devices that share one memory
    picture = clips * (_CPU if host else _ACCELERATOR).pixel * height * width
    held = frames if host else -(-frames // devices)  # every process loads the whole clip and returns all of it
    run = here * pass_bytes(model.config, frames, height, width, devices=devices, accelerator=not host) + held * picture
    if host:
        row = find_method(method)
        second_is_another = row.needs_second_pass and "depth" not in row.second_outputs()  # program
        run = _PROCESS + max(run, _COMPILING if second_is_another else 0)
    run = max(run, frames * picture)  # after a pass, every device reads all frames
    return here * model.parameter_bytes + run


def pass_bytes(
    config: VGGTConfig, frames: int, height: int, width: int, *, devices: int = 1, accelerator: bool | None = None
) -> float:
    """Return what the passes hold on each device beside weights, pictures and results: XLA's count, within a third."""
    host = not (has_accelerator() if accelerator is None else accelerator)
    rates = _CPU if host else _ACCELERATOR
    share = -(-frames // devices)
    tokens = config.special_tokens + height * width // config.patch_size**2
    rows = rates.rows * tokens * config.embed_dim
    is_short = host and tokens**2 <= LOGITS_OF_ALL_HEADS
    logits = config.num_heads * tokens**2 if is_short else 0
    at_once = min(share, max(PIXELS_AT_ONCE // (height * width), 1))  # frames of the dense head, at most
    maps = rates.maps * max(config.dpt_features // 2, HIDDEN) * height * width
    largest = at_once * maps
    if devices > 1:  # gathered keys and values, and on a CPU the logits of a chunk of queries to all of these keys
        keys = share * devices * tokens
        chunk = share * tokens / chunk_count(share * tokens, keys) * keys if host else 0
        largest = max(largest, 2 * min(keys * config.embed_dim, GATHERED_AT_ONCE) + chunk)
    return _FLOAT * (share * (rows + logits) + largest)


def available(params: Any = None) -> Room | None:
    """Return how much there is for a model and its passes; None where it is not known.

    On a CPU what the process holds is included; on a GPU, of what is in use, `params` alone: arrays of a loaded model,
    of which those on the host take nothing. None stands for a model that is not loaded.
    """
    if not has_accelerator():
        return host_room()
    stats = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" not in stats:
        return None
    free = stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    held = sum(leaf.nbytes for leaf in jax.tree.leaves(params) if isinstance(leaf, jax.Array))
    return Room(free + held, "on the device")


def room_of_gpu(name: str) -> Room:
    """Return what jax takes of the memory of a GPU of `GPUS`, which need not be here.

    Raises InputError for a share of it in the environment that is no number above 0 and up to 1.
    """
    given, share = os.environ.get("XLA_PYTHON_CLIENT_MEM_FRACTION", ".75"), 0.0  # jax's default
    with suppress(ValueError):
        share = float(given)
    if not 0 < share <= 1:
        raise InputError(
            f"XLA_PYTHON_CLIENT_MEM_FRACTION is {given!r}; expected a number above 0 and up to 1, or unset"
        )
    return Room(share * GPUS[name], f"of an {name}")


def most_frames(
    model: Sized, height: int, width: int, size: float, *, accelerator: bool | None = None, **how: Unpack[Load]
) -> int:
    """Return the most frames that are predicted to fit in `size` bytes when they are run together; maybe 0.

    `accelerator` and `how` are the options of `predicted_bytes`.
    """
    low, high = 0, max(1, MOST_BYTES // (3 * _FLOAT * height * width)) + 1  # the first fits, the last does not
    while high - low > 1:
        middle = (low + high) // 2
        fits = predicted_bytes(model, middle, height, width, accelerator=accelerator, **how) <= size
        low, high = (middle, high) if fits else (low, middle)
    return low
