"""A process that runs one command of vggtjax and prints its peak memory: python -m benchmarks.peak_worker ARGUMENTS.

The last line of standard output is JSON: {"code", "total", "own"}; `own` leaves out mapped files, such as the weights.
"""

from __future__ import annotations

import json
import sys

from benchmarks.worker import PeakMemory
from testing.process_memory import process_bytes
from vggtjax.commands.main import main


def run(arguments: list[str]) -> None:
    """Run the command, and print what it took."""
    with PeakMemory() as peak:
        code = main(arguments)
    sys.stdout.write(json.dumps({"code": code, "total": process_bytes("VmHWM") or 0, "own": peak.own}) + "\n")


if __name__ == "__main__":
    run(sys.argv[1:])
