"""A process that runs one part: python -m benchmarks.gpu_day.worker PART SIZE FILE. It ends when its input ends."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from typing import Any

from benchmarks.gpu_day.lines import Lines
from benchmarks.gpu_day.parts import PARTS
from benchmarks.suite.report import describe, machine
from vggtjax.network.attention import cudnn_works


def main(part: str, size: Any, file: str) -> None:
    """Run a part; its lines go to the file."""
    threading.Thread(target=_end_with_input, daemon=True).start()
    lines = Lines(Path(file))
    lines.facts(machine=describe(machine()), cudnn="works" if cudnn_works() else "not used")
    PARTS[part].run(size, lines)


def _end_with_input() -> None:
    """End the process where its starter is gone. A buffered read would hold a lock that Python's end waits for."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
