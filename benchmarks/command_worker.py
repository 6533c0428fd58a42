"""A process that runs one command of vggtjax and says what it took: python -m benchmarks.command_worker ARGUMENTS.

The last line of standard output is JSON: the exit code, bytes at the peak (`own` leaves out mapped files, such as the
weights), seconds, and seconds of the processors.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.worker import PeakMemory
from vggtjax.errors import InputError
from vggtjax.storage.memory import process_bytes


def run_command(words: list[str], cache: Path, devices: int = 1) -> dict[str, Any]:
    """Run a command in a process with a cache of its own and return what it took. Raises InputError if it fails."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMPILATION")}
    environment |= {"VGGTJAX_CACHE": str(cache)}
    if devices > 1:
        count = f"--xla_force_host_platform_device_count={devices}"
        environment["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {count}"
    command = [sys.executable, "-m", "benchmarks.command_worker", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    last = done.stdout.strip().rpartition("\n")[2]
    answer = json.loads(last) if last.startswith("{") else {"code": done.returncode}
    if answer["code"] or done.returncode:
        raise InputError(f"{' '.join(words)} ended with code {answer['code']}: {done.stderr[-500:]}")
    return answer


def main(words: list[str]) -> None:
    """Run the command, and print what it took."""
    from vggtjax.interface.commands.main import main as run

    began = time.perf_counter()
    with PeakMemory() as peak:
        code = run(words)
    answer = {"code": code, "total": process_bytes("VmHWM") or 0, "own": peak.own}
    answer |= {"seconds": time.perf_counter() - began, "processor": time.process_time()}
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
