"""The accelerators that programs are compiled for, whether or not they are there."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import distribution
from importlib.util import find_spec
from typing import Any, Literal

import jax
from jax.experimental import topologies

from vggtjax.errors import InputError, check_choice

Platform = Literal["cuda", "tpu"]
_SUSTAINED = {"bfloat16": 0.8, "tf32": 0.8, "float32": 0.9}  # share of the peak that large products reach
_CUDNN = (9, 8, 0)


@dataclass(frozen=True)
class Target:
    """An accelerator: the peaks of its data sheet, and what its compiler has to know of it.

    Attributes:
        name: as its maker spells it.
        platform: the compiler.
        bfloat16, tf32, float32: FLOP/s of products without sparsity, sums in float32. A TPU computes "tf32" as three
            passes in bfloat16 and "float32" as six.
        bandwidth: bytes/s of its memory.
        memory: bytes.
        capability: of CUDA, major and minor.
        cores, threads, clock: multiprocessors, threads of each, GHz.
        shared: bytes of shared memory of a multiprocessor; a block may take all but 1 KiB.
        cache: bytes of the last cache.
    """

    name: str
    platform: Platform
    bfloat16: float
    tf32: float
    float32: float
    bandwidth: float
    memory: int
    capability: tuple[int, int] = (0, 0)
    cores: int = 0
    threads: int = 0
    clock: float = 0.0
    shared: int = 0
    cache: int = 0

    def seconds(self, flop: Mapping[str, float], moved: float) -> float:
        """Return the roofline of a kernel: the longer of computing and of moving bytes."""
        return max(sum(amount / self.rate(kind) for kind, amount in flop.items()), moved / self.bandwidth)

    def rate(self, kind: str) -> float:
        """Return FLOP/s that large products in "bfloat16", "tf32" or "float32" sustain."""
        return _SUSTAINED[kind] * getattr(self, kind)

    def devices(self, count: int) -> Sequence[Any]:
        """Return `count` devices to compile for. Raises InputError without the compiler for them."""
        _require(self.platform)
        jax.local_devices()  # plugins register
        if self.platform == "tpu":
            topology = topologies.get_topology_desc(f"v5e:{_TPU_LAYOUTS[count]}", "tpu")
        else:
            described = {"target_config": self._description(), "topology": f"1x1x{count}"}
            topology = topologies.get_topology_desc("", "cuda", **described)
        return topology.devices[:count]

    def _description(self) -> str:
        """Return what XLA calls a target configuration, as text."""
        major, minor = self.capability
        versions = dict(zip(("major", "minor", "patch"), _CUDNN, strict=True))
        device = {
            "threads_per_block_limit": 1024,
            "threads_per_warp": 32,
            "shared_memory_per_block": 48 * 1024,
            "shared_memory_per_core": self.shared,
            "shared_memory_per_block_optin": self.shared - 1024,
            "threads_per_core_limit": self.threads,
            "core_count": self.cores,
            "fpus_per_core": 64 if self.capability == (8, 0) else 128,
            "block_dim_limit_x": 2**31 - 1,
            "block_dim_limit_y": 2**16 - 1,
            "block_dim_limit_z": 2**16 - 1,
            "memory_bandwidth": int(self.bandwidth),
            "l2_cache_size": self.cache,
            "clock_rate_ghz": self.clock,
            "device_memory_size": self.memory,
            "cuda_compute_capability": {"major": major, "minor": minor},
            "registers_per_core_limit": 65536,
            "registers_per_block_limit": 65536,
        }
        fields = {
            "gpu_device_info": device,
            "platform_name": '"CUDA"',
            "dnn_version_info": versions,
            "device_description_str": f'"{self.name}"',
        }
        return _text(fields)


_COMPILERS = {"cuda": ("jax_cuda12_plugin", "jax_cuda13_plugin"), "tpu": ("libtpu",)}
_TPU_LAYOUTS = {1: "1x1", 4: "2x2", 8: "2x4"}
_GB, _KB, _MB = 2**30, 2**10, 2**20

TARGETS = {  # data sheets of NVIDIA and Google
    "h100": Target(
        "NVIDIA H100 80GB HBM3", "cuda", 989e12, 494e12, 67e12, 3.35e12, 80 * _GB,
        (9, 0), 132, 2048, 1.98, 228 * _KB, 50 * _MB,
    ),
    "h200": Target(
        "NVIDIA H200", "cuda", 989e12, 494e12, 67e12, 4.8e12, 141 * _GB,
        (9, 0), 132, 2048, 1.98, 228 * _KB, 50 * _MB,
    ),
    "a100": Target(
        "NVIDIA A100-SXM4-80GB", "cuda", 312e12, 156e12, 19.5e12, 2.04e12, 80 * _GB,
        (8, 0), 108, 2048, 1.41, 164 * _KB, 40 * _MB,
    ),
    "l4": Target(
        "NVIDIA L4", "cuda", 121e12, 60e12, 30.3e12, 0.3e12, 24 * _GB,
        (8, 9), 58, 1536, 2.04, 100 * _KB, 48 * _MB,
    ),
    "rtx4090": Target(
        "NVIDIA GeForce RTX 4090", "cuda", 165e12, 82.6e12, 82.6e12, 1.008e12, 24 * _GB,
        (8, 9), 128, 1536, 2.52, 100 * _KB, 72 * _MB,
    ),
    "rtx3090": Target(
        "NVIDIA GeForce RTX 3090", "cuda", 71e12, 35.6e12, 35.6e12, 0.936e12, 24 * _GB,
        (8, 6), 82, 1536, 1.70, 100 * _KB, 6 * _MB,
    ),
    "v5e": Target("TPU v5e", "tpu", 197e12, 197e12 / 3, 197e12 / 6, 0.819e12, 16 * _GB),
}  # fmt: skip


def target(name: str) -> Target:
    """Return the target with this name. Raises InputError for another name."""
    check_choice("target", name, tuple(TARGETS))
    return TARGETS[name]


def _require(platform: Platform) -> None:
    """Raise InputError unless the compiler for a platform is installed; tell jax where that for TPUs is."""
    if not any(map(find_spec, _COMPILERS[platform])):
        raise InputError(f"the compiler for {platform} is not installed; pip install -e '.[accelerator]'")
    if platform == "tpu":
        os.environ.setdefault("TPU_SKIP_MDS_QUERY", "1")  # of the cloud, about the machine: there is no TPU here
        os.environ.setdefault("TPU_LIBRARY_PATH", str(distribution("libtpu").locate_file("libtpu/libtpu.so")))


def _text(fields: dict[str, Any]) -> str:
    """Return a protocol buffer as text."""
    lines = (
        f"{name} {{ {_text(value)} }}" if isinstance(value, dict) else f"{name}: {value}"
        for name, value in fields.items()
    )
    return "\n".join(lines)
