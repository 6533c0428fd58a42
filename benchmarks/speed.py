"""Passes compared with the public PyTorch code, in one run on one machine: python -m benchmarks speed."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from vggtjax.errors import InputError
from vggtjax.storage.writing import writing

_COLUMNS = 200
_AGREE = {"float32": 2e-4, "bfloat16": 0.5}  # of each array's spread, at the pixel that differs most
_TITLES = {"pass": "camera + depth", "vggt4d": "vggt4d, both passes", "4dvggt-d": "4dvggt-d, both passes"}
_COMPARED = {  # heading -> figure, of which run, unit
    "s": ("seconds", "runs", 1),
    "GB": ("total", "runs", 1e9),
    "own": ("own", "runs", 1e9),
    "since start": ("since start", "first", 1e9),
}

Answer = dict[str, float]


class Worker:
    """A process that runs passes, until the context ends."""

    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "benchmarks.worker", *arguments]
        self._process: Any = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._answer()

    def run(self, *, keep: str | None = None, mask: str | None = None, **task: Any) -> Answer:
        """Run passes; return the worker's answer: seconds, bytes of memory, reads of a disk."""
        with suppress(BrokenPipeError):  # an ended process; `_answer` says so
            self._process.stdin.write(json.dumps({**task, "keep": keep, "mask": mask}) + "\n")
            self._process.stdin.flush()
        return self._answer()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.stdin.close()
        self._process.wait()

    def _answer(self) -> Answer:
        line = self._process.stdout.readline()
        if not line:
            raise InputError(f"the process of {self._process.args[3]!r} ended; its output is above")
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
    dtype: Literal["float32", "bfloat16"] = "float32",
    repeats: int = 3,
    out: Path | None = None,
) -> None:
    """Time passes here and in the public code, alternately.

    A plain pass gives cameras and depth in both. Both passes are our methods vggt4d and 4dvggt-d, each beside stages 1
    and 2 of VGGT4D: its model, maps, clusters and threshold. Its model has all heads in both passes; the second pass
    of vggt4d predicts here what is read of it, the cameras. What both compute is compared first. Where a machine has
    little memory, put the weights on a memory file system, or what is timed is the disk; such runs are marked.

    The most memory since the start is that of a process which loads its weights and runs once: here as always, in the
    public code all heads, as its `from_pretrained` loads them. In what is timed both sides map their weights.

    Args:
        weights: PyTorch weights in the layout of VGGT-1B or Depth Anything 3, such as those of make-checkpoint.
        converted: the same weights, written by vggtjax convert.
        peer: checkout of the public code: a folder with the package vggt, and with vggt4d for both passes; or with the
            package depth_anything_3, and what it imports, for weights of Depth Anything 3.
        frames: numbers of frames of a plain pass.
        both: numbers of frames of both passes; VGGT4D's cues need four.
        height: of a frame, in pixels.
        width: of a frame, in pixels.
        dtype: of the blocks here; "bfloat16" is autocast there. A plain pass then is compared loosely.
        repeats: timed runs of each, after a warm-up.
        out: JSON file for the figures of every run.
    """
    package = "depth_anything_3" if (peer / "depth_anything_3").exists() else "vggt"
    for path in (weights, converted, peer / package, *[peer / "vggt4d"] * bool(both)):
        if not path.exists():
            raise InputError(f"{path} does not exist; see --help for the expected file")
    if both and min(both) < 4:
        raise InputError(f"both has {min(both)}; expected at least 4 frames, since VGGT4D's cues are NaN for fewer")
    if repeats < 1:
        raise InputError(f"repeats is {repeats}; expected at least 1")
    if both and dtype != "float32":
        raise InputError("both is compared in float32 alone; leave --both or --dtype out")
    narrow = ("bfloat16",) * (dtype == "bfloat16")
    public = ("peer", str(weights.resolve()), str(peer.resolve()), *narrow)
    jobs = [(("pass",), count) for count in frames] + [(("vggt4d", "4dvggt-d"), count) for count in both]
    console, rows = Console(), []
    console.width = max(console.width, _COLUMNS)  # rich assumes 80 for a file
    for works, count in jobs:
        task: dict[str, Any] = {"frames": count, "height": height, "width": width}
        status = console.status(f"{_TITLES[works[0]]}, {count} frames")
        with status, Worker("ours", str(converted.resolve()), *narrow) as ours:
            with Worker(*public) as loaded:
                apart, firsts = _apart((ours, loaded), works[0], task, _AGREE[dtype])
            for work in works[1:]:
                ours.run(work=work, **task)
            with Worker(*public, "mapped") as mapped:
                mapped.run(work=works[0], **task)
                turns = [*((ours, work) for work in works), (mapped, works[0])]
                runs = [[side.run(work=work, **task) for side, work in turns] for _ in range(repeats)]
        for index, work in enumerate(works):
            row: dict[str, Any] = {"work": work, **task, "differ by": None if index else apart}  # they lack 4dvggt-d
            for side, i in (("ours", index), ("public", -1)):
                row[side] = {"first": [] if index else [firsts[i]], "runs": [run[i] for run in runs]}
            rows.append(row)
    console.print(_table(rows, f"{width} x {height}, {dtype}"))
    if out is not None:
        with writing(out) as temporary:
            temporary.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


def _apart(sides: tuple[Worker, Worker], work: str, task: dict[str, int], most: float) -> tuple[float, list[Answer]]:
    """Return the largest difference of the outputs, in standard deviations of the other's array, and the first runs.

    Raises InputError for too large a difference.
    Two-pass masks come from k-means with different generators, so the second pass is compared under the other's mask.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = [f"{folder}/{name}.npz" for name in ("ours", "peer")]

        def compared(**more: Any) -> tuple[float, list[Answer]]:
            runs = [side.run(work=work, keep=file, **task, **more) for side, file in zip(sides, files, strict=True)]
            return _difference(*(dict(np.load(file)) for file in files)), runs

        apart, firsts = compared()
        if work != "pass":
            Path(files[1]).rename(f"{folder}/mask.npz")
            if not np.load(f"{folder}/mask.npz")["mask"].any():
                raise InputError(f"VGGT4D's mask is empty for {task['frames']} frames; choose another number")
            second, _ = compared(mask=f"{folder}/mask.npz")
            apart = float(np.max([apart, second]))  # unlike max(), keeps NaN
    if not apart <= most:
        raise InputError(f"the outputs of {work!r} differ by {apart:.1e} of their spread; expected at most {most}")
    return apart, firsts


def _difference(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> float:
    """Return the largest difference of two sides' arrays, in standard deviations of the other's; masks aside."""
    names = theirs.keys() - {"mask"}
    return float(np.max([np.abs(ours[name] - theirs[name]).max() / theirs[name].std() for name in names]))


def _table(rows: list[dict[str, Any]], title: str) -> Table:
    table = Table(title=title, title_justify="left", box=None)
    table.add_column("work")
    pairs = [(f"ours, {unit}", f"public, {unit}", "ratio") for unit in _COMPARED]
    for heading in ("frames", *sum(pairs, ()), "differ by", "disk"):
        table.add_column(heading, justify="right")
    for row in rows:
        cells = []
        for key, which, unit in _COMPARED.values():
            if not row["ours"][which]:  # an earlier run of another method hides the peak
                cells += ["-"] * 3
                continue
            ours, theirs = (float(np.median([run[key] for run in row[side][which]])) for side in ("ours", "public"))
            cells += [f"{ours / unit:.2f}", f"{theirs / unit:.2f}", f"{ours / theirs:.2f}" if theirs else "-"]
        waited = "yes" if any(run["reads"] for side in ("ours", "public") for run in row[side]["runs"]) else "no"
        table.add_row(
            _TITLES[row["work"]],
            str(row["frames"]),
            *cells,
            "-" if row["differ by"] is None else f"{row['differ by']:.1e}",
            waited,
        )
    table.caption = (
        "GB: most memory in a run; own: of it, beside mapped files, which the weights are; "
        "since start: most of a process that loads the public way, and runs once; disk: whether a run waited for one"
    )
    table.caption_justify = "left"
    return table
