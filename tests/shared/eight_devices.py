"""Scripts that run in a process with eight devices and print JSON."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).parents[2]
_SPLIT = {
    "JAX_PLATFORMS": "cpu",
    "PJRT_NPROC": "16",  # threads: devices that wait for each other hold one each
    "PYTHONPATH": str(_ROOT),
    "XLA_FLAGS": "--xla_force_host_platform_device_count=8 --xla_backend_optimization_level=0",
}


def printed_by(script: Path) -> Any:
    """Return the JSON that a script prints on a CPU that is split into eight devices."""
    command, environment = [sys.executable, str(script)], os.environ | _SPLIT
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)
