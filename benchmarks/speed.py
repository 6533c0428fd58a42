"""A plain pass beside the public PyTorch code, in one run on one machine: python -m benchmarks speed."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from vggtjax.errors import InputError

_AGREE = 2e-4  # of each array's spread


class Worker:
    """A process that runs passes."""

    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "benchmarks.worker", *arguments]
        self._process: Any = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._answer()

    def run(self, **task: Any) -> dict[str, float]:
        """Run a pass; return its seconds, and the most memory that the process has had."""
        self._process.stdin.write(json.dumps(task) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        """End the process."""
        self._process.stdin.close()
        self._process.wait()

    def _answer(self) -> dict[str, float]:
        line = self._process.stdout.readline()
        if not line:
            raise InputError(f"the process of {self._process.args[3]!r} ended; what it said is above")
        return json.loads(line)


def speed(
    *,
    weights: Path,
    converted: Path,
    peer: Path,
    frames: tuple[int, ...] = (2, 8),
    height: int = 294,
    width: int = 518,
    repeats: int = 3,
) -> None:
    """Time a plain pass (cameras and depth, float32) here and in the public code, one after the other, again and again.

    Args:
        weights: PyTorch weights of VGGT-1B's layout, such as make-checkpoint writes.
        converted: the same weights as vggtjax convert writes them.
        peer: checkout of the public code: a folder with the package vggt.
        frames: numbers of frames.
        height: of a frame, in pixels.
        width: of a frame, in pixels.
        repeats: timed runs of each, after one that warms up.
    """
    for path in (weights, converted, peer / "vggt"):
        if not path.exists():
            raise InputError(f"{path} does not exist; see --help for what it should be")
    console = Console()
    table = Table(title=f"a pass at {width} x {height}, float32", title_justify="left", box=None)
    for heading in ("frames", "ours (s)", "public (s)", "ratio", "ours (GB)", "public (GB)", "ratio", "differ by"):
        table.add_column(heading, justify="right")
    for count in frames:
        sides = {
            "ours": Worker("ours", str(converted.resolve())),
            "peer": Worker("peer", str(weights.resolve()), str(peer.resolve())),
        }
        task = {"frames": count, "height": height, "width": width}
        with tempfile.TemporaryDirectory() as folder, console.status(f"{count} frames"):
            for name, side in sides.items():
                side.run(**task, keep=f"{folder}/{name}.npz")
            apart = _apart(*(dict(np.load(f"{folder}/{name}.npz")) for name in sides))
            if apart > _AGREE:
                raise InputError(f"the outputs differ by {apart:.1e} of their spread; expected at most {_AGREE}")
            runs = [{name: side.run(**task, keep=None) for name, side in sides.items()} for _ in range(repeats)]
        for side in sides.values():
            side.close()
        ours, theirs = (float(np.median([run[name]["seconds"] for run in runs])) for name in sides)
        mine, others = (max(run[name]["peak"] for run in runs) / 1e9 for name in sides)
        cells = (f"{ours:.2f}", f"{theirs:.2f}", f"{ours / theirs:.2f}", f"{mine:.2f}", f"{others:.2f}")
        table.add_row(str(count), *cells, f"{mine / others:.2f}", f"{apart:.1e}")
    console.print(table)


def _apart(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> float:
    """Return the largest difference, in standard deviations of the other's array."""
    return max(float(np.abs(ours[name] - theirs[name]).max() / theirs[name].std()) for name in theirs)
