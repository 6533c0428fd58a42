"""Settings of a command's process: threads of a split CPU, limits that are too low."""

from __future__ import annotations

import os
import re

from vggtjax.errors import InputError
from vggtjax.storage.free_memory import in_gigabytes, own_limits

_LIBRARIES, _OF_A_CORE = 1_000_000_000, 20_000_000  # bytes of address space; a core's threads have stacks


def give_devices_threads() -> None:
    """Have XLA start two threads for each device of a split CPU, unless PJRT_NPROC says how many.

    XLA_FLAGS or JAX_NUM_CPU_DEVICES splits it. By default there are as many threads as devices, if these are more than
    the cores. Devices that wait for each other then hold all threads, nobody computes what they wait for, and XLA ends
    the process after 40 seconds.

    Call it before jax starts: XLA reads the variable once.
    """
    counts = re.findall(r"--xla_force_host_platform_device_count=(\d{1,4})\b", os.environ.get("XLA_FLAGS", ""))
    counts += re.findall(r"^\d{1,4}$", os.environ.get("JAX_NUM_CPU_DEVICES", ""))
    if counts and int(counts[-1]) > 1:
        os.environ.setdefault("PJRT_NPROC", str(max(2 * int(counts[-1]), os.cpu_count() or 1)))


def check_limits() -> None:
    """Raise InputError where a limit of this process (`ulimit -v`) does not even leave room for loading the libraries.

    A library that cannot start a thread or map a file ends the process without a sentence.
    """
    needed = _LIBRARIES + _OF_A_CORE * (os.cpu_count() or 1)
    for name, limit, used in own_limits():
        if limit - used < needed:
            raise InputError(
                f"{name} leaves this process {in_gigabytes(limit - used)}, and its libraries take "
                f"{in_gigabytes(needed)}; set a higher limit, or none: {name} unlimited"
            )
