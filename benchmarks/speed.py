"""Passes beside the public PyTorch code, in one run on one machine: python -m benchmarks speed."""

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
from vggtjax.files import writing

_COLUMNS = 140
_AGREE = 2e-4  # of each array's spread
_TITLES = {"pass": "camera + depth", "vggt4d": "vggt4d, both passes", "4dvggt-d": "4dvggt-d, both passes"}

Answer = dict[str, float]


class Worker:
    """A process that runs passes."""

    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "benchmarks.worker", *arguments]
        self._process: Any = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._answer()

    def run(self, *, keep: str | None = None, mask: str | None = None, **task: Any) -> Answer:
        """Run passes; return seconds, the most memory held (in all, and beside mapped files), and reads of a disk."""
        self._process.stdin.write(json.dumps({**task, "keep": keep, "mask": mask}) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        """End the process."""
        self._process.stdin.close()
        self._process.wait()

    def _answer(self) -> Answer:
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
    both: tuple[int, ...] = (),
    height: int = 294,
    width: int = 518,
    repeats: int = 3,
    out: Path | None = None,
) -> None:
    """Time passes in float32 here and in the public code, one after the other, again and again.

    A plain pass gives cameras and depth in both. Both passes are our methods vggt4d and 4dvggt-d, each beside stages 1
    and 2 of VGGT4D: its model, maps, clusters and threshold. Its model has all heads in both passes; the second pass
    of vggt4d predicts here what is read of it, the cameras. What both compute is compared first. Where a machine has
    little memory, put the weights on a memory file system, or what is timed is the disk; such runs are marked.

    Args:
        weights: PyTorch weights of VGGT-1B's layout, such as make-checkpoint writes.
        converted: the same weights as vggtjax convert writes them.
        peer: checkout of the public code: a folder with the package vggt, and with vggt4d for both passes.
        frames: numbers of frames of a plain pass.
        both: numbers of frames of both passes; VGGT4D's cues need four.
        height: of a frame, in pixels.
        width: of a frame, in pixels.
        repeats: timed runs of each, after one that warms up.
        out: JSON file for what every run took.
    """
    for path in (weights, converted, peer / "vggt", *[peer / "vggt4d"] * bool(both)):
        if not path.exists():
            raise InputError(f"{path} does not exist; see --help for what it should be")
    if both and min(both) < 4:
        raise InputError(
            f"both has {min(both)}; expected at least 4 frames, without which VGGT4D's cues are not numbers"
        )
    if repeats < 1:
        raise InputError(f"repeats is {repeats}; expected at least 1")
    arguments = (("ours", str(converted.resolve())), ("peer", str(weights.resolve()), str(peer.resolve())))
    jobs = [(("pass",), count) for count in frames] + [(("vggt4d", "4dvggt-d"), count) for count in both]
    console, rows = Console(), []
    console.width = max(console.width, _COLUMNS)  # of a file, rich assumes 80
    for works, count in jobs:
        sides = (Worker(*arguments[0]), Worker(*arguments[1]))
        task: dict[str, Any] = {"frames": count, "height": height, "width": width}
        with console.status(f"{_TITLES[works[0]]}, {count} frames"):
            apart = _apart(sides, works[0], task)
            for work in works[1:]:
                sides[0].run(work=work, **task)
            runs = [
                [
                    side.run(work=work, **task)
                    for side, work in (*((sides[0], work) for work in works), (sides[1], works[0]))
                ]
                for _ in range(repeats)
            ]
        for side in sides:
            side.close()
        for index, work in enumerate(works):
            ours, theirs = ([run[i] for run in runs] for i in (index, -1))
            differ = None if index else apart  # the other has no 4dvggt-d
            rows.append({"work": work, **task, "ours": ours, "public": theirs, "differ by": differ})
    console.print(_table(rows, f"{width} x {height}, float32"))
    if out is not None:
        with writing(out) as temporary:
            temporary.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


def _apart(sides: tuple[Worker, Worker], work: str, task: dict[str, int]) -> float:
    """Return how far the outputs are apart at most, in standard deviations of the other's array; too far is an error.

    Two-pass masks come from k-means with different generators, so the second pass is compared under the other's mask.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = [f"{folder}/{name}.npz" for name in ("ours", "peer")]

        def compared(**more: Any) -> float:
            for side, file in zip(sides, files, strict=True):
                side.run(work=work, keep=file, **task, **more)
            return _difference(*(dict(np.load(file)) for file in files))

        apart = compared()
        if work != "pass":
            Path(files[1]).rename(f"{folder}/mask.npz")
            if not np.load(f"{folder}/mask.npz")["mask"].any():
                raise InputError(f"nothing moves by VGGT4D's mask of {task['frames']} frames; take another number")
            apart = float(np.max([apart, compared(mask=f"{folder}/mask.npz")]))  # unlike max(), keeps what is no number
    if not apart <= _AGREE:
        raise InputError(f"the outputs of {work!r} differ by {apart:.1e} of their spread; expected at most {_AGREE}")
    return apart


def _difference(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> float:
    """Return the largest difference of two sides' arrays, in standard deviations of the other's; masks aside."""
    names = theirs.keys() - {"mask"}
    return float(np.max([np.abs(ours[name] - theirs[name]).max() / theirs[name].std() for name in names]))


def _table(rows: list[dict[str, Any]], title: str) -> Table:
    table = Table(title=title, title_justify="left", box=None)
    table.add_column("work")
    pairs = [f"{name}{unit}" for unit in (" (s)", " (GB)", " own (GB)") for name in ("ours", "public", "ratio")]
    for heading in (
        "frames",
        *(name.split(" ")[0] if "ratio" in name else name for name in pairs),
        "differ by",
        "disk",
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        cells = []
        for key, unit, digits in (("seconds", 1, 2), ("total", 1e9, 2), ("own", 1e9, 2)):
            ours, theirs = (float(np.median([run[key] for run in row[side]])) / unit for side in ("ours", "public"))
            cells += [f"{ours:.{digits}f}", f"{theirs:.{digits}f}", f"{ours / theirs:.2f}" if theirs else "-"]
        waited = "yes" if any(run["reads"] for side in ("ours", "public") for run in row[side]) else "no"
        table.add_row(
            _TITLES[row["work"]],
            str(row["frames"]),
            *cells,
            "-" if row["differ by"] is None else f"{row['differ by']:.1e}",
            waited,
        )
    table.caption = "own: beside mapped files, which the weights are; disk: whether a run waited for one"
    table.caption_justify = "left"
    return table
