"""The parts of gpu-day, in their order, and a process that runs one: python -m benchmarks.gpu_day.parts PART SIZE FILE.

It ends when its input ends.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.gpu_day.kernels import kernels
from benchmarks.gpu_day.lines import Lines
from benchmarks.gpu_day.parity import parity
from benchmarks.gpu_day.paths import attention_paths
from benchmarks.gpu_day.speed import speed
from benchmarks.suite.cases import Size
from benchmarks.suite.report import describe, machine
from vggtjax.network.kernels.attention import cudnn_works


class Part(NamedTuple):
    """A part: what it tells, its share of the time, and the function that tells it."""

    about: str
    share: float
    run: Callable[[Size, Lines], None]


PARTS = {
    "parity": Part("Are the numbers those of the public code, in float32 and in bfloat16?", 0.28, parity),
    "attention": Part("Has every way of attention the CPU's numbers, and how fast is it?", 0.16, attention_paths),
    "speed": Part("How long do the parts take, how much memory, and are the targets met?", 0.40, speed),
    "kernels": Part("Where does the time of both passes go?", 0.16, kernels),
}  # fmt: skip


def main(part: str, size: Any, file: str) -> None:
    """Run a part; its lines go to the file."""
    threading.Thread(target=_end_with_input, daemon=True).start()
    lines = Lines(Path(file))
    uses_cudnn = machine()["platform"] == "gpu" and cudnn_works()
    lines.facts(machine=describe(machine()), cudnn="works" if uses_cudnn else "not used")
    PARTS[part].run(size, lines)


def _end_with_input() -> None:
    """End the process where its starter is gone. A buffered read would hold a lock that Python's end waits for."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
