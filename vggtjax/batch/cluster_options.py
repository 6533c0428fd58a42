"""Where a batch runs, as options. Imports neither jax nor ray."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from vggtjax.errors import InputError, check_choice, whole_number
from vggtjax.storage.flags import InWords


@dataclass(frozen=True)
class Cluster:
    """Where a batch runs. Raises InputError for an invalid value, or for options without an engine that reads them.

    Attributes:
        engine: local: in this process; ray: on a cluster of Ray
        address: of the cluster, as host:port; auto: the one that runs on this machine; RAY_ADDRESS, or a new one of
            this machine alone, by default
        workers: how many workers, each with a model of its own; as many as the cluster has room for by default
        worker_cpus: CPUs of a worker; by default all of a machine, or 1 beside a GPU
        worker_gpus: GPUs of a worker; by default as many as --devices, if the cluster has any
    """

    engine: Literal["local", "ray"] = "local"
    address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT|auto", help_behavior_hint="")] = None
    workers: InWords[int | None] = None
    worker_cpus: InWords[int | None] = None
    worker_gpus: InWords[float | None] = None

    def __post_init__(self) -> None:
        check_choice("engine", self.engine, ("local", "ray"))
        given = {"address": self.address, "workers": self.workers, "worker_cpus": self.worker_cpus}
        for name, value in (given | {"worker_gpus": self.worker_gpus}).items():
            if value is not None and self.engine == "local":
                raise InputError(f"--{name.replace('_', '-')} needs --engine ray")
        for name in ("workers", "worker_cpus"):
            if (value := given[name]) is not None:
                whole_number(name, value, 1)
        if self.worker_gpus is not None and not 0 <= self.worker_gpus <= 1024:
            raise InputError(f"worker_gpus is {self.worker_gpus}; expected 0 to 1024")
        if self.address is not None and self.address.startswith("ray://"):
            raise InputError(
                f"address is {self.address}; expected host:port: run the command on a machine of the cluster"
            )
