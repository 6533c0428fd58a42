"""Figures of the suite: times beside their floors, and the growth of time and memory with frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.suite.report import Row
from benchmarks.suite.work import UNITS
from vggtjax.storage.writing import writing

_COLOURS = dict(
    zip(UNITS, ("tab:blue", "tab:cyan", "tab:orange", "tab:red", "tab:olive", "tab:green", "tab:purple"), strict=True)
)
_BAR = 0.32  # inches
_MEGABYTE = 1e6


def plot_roofline(path: Path, rows: Sequence[Row], caption: str) -> None:
    """Draw a bar per row, 100 % its median time: in colour the floor of each kind of work."""
    from matplotlib.figure import Figure

    rows = [row for row in rows if row.floor and row.measured.seconds]
    figure = Figure(figsize=(9, 2.2 + _BAR * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    left = np.zeros(len(rows))
    shares = [{kind: 100 * s / (row.measured.median or 1) for kind, s in row.floor.items()} for row in rows]
    places = np.arange(len(rows))
    for kind in UNITS:
        widths = np.array([share.get(kind, 0.0) for share in shares])
        if widths.any():
            axes.barh(places, widths, left=left, color=_COLOURS[kind], label=kind)
        left += widths
    axes.barh(places, np.maximum(100 - left, 0), left=left, color="0.9", label="above the floor")
    for place, row in enumerate(rows):
        text = f"{row.measured.median:.3g} s, {(row.flop_per_second or 0) / 1e9:.3g} GFLOP/s"
        axes.text(101, place, text, va="center", fontsize=8)
    axes.set_yticks(places, [_label(row, frames=True) for row in rows], fontsize=8)
    axes.set(xlim=(0, max([128.0, *left.tolist()])), xticks=range(0, 101, 20), ylim=(len(rows) - 0.4, -0.6))
    axes.set_xlabel("% of the measured time; in colour the least that each kind of work takes here")
    figure.legend(loc="outside upper center", ncols=4, fontsize=8)
    _save(figure, path, caption)


def plot_scaling(path: Path, rows: Sequence[Row], caption: str) -> None:
    """Draw seconds (dashed: the floor) and memory over frames, both axes logarithmic."""
    from matplotlib.figure import Figure

    rows = [row for row in rows if row.frames and row.measured.xla_bytes]
    figure = Figure(figsize=(11, 5), layout="constrained")
    times, memories = figure.subplots(1, 2)
    for number, label in enumerate(dict.fromkeys(_label(row, frames=False) for row in rows)):
        own = sorted((row for row in rows if _label(row, frames=False) == label), key=lambda row: row.frames or 0)
        frames = [row.frames for row in own]
        colour = f"C{number % 10}"
        times.plot(frames, [row.measured.median for row in own], marker=".", color=colour, label=label)
        times.plot(frames, [row.floor_seconds for row in own], color=colour, linestyle="--", linewidth=1)
        memories.plot(
            frames, [(row.measured.xla_bytes or 0) / _MEGABYTE for row in own], marker=".", color=colour, label=label
        )
    for axes, name in ((times, "seconds; dashed: the floor"), (memories, "MB beyond weights and images, by XLA")):
        axes.set(xscale="log", yscale="log", xlabel="frames", ylabel=name)
        _number_frames(axes, [row.frames or 0 for row in rows])
    figure.legend(*times.get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize=8)
    _save(figure, path, caption)


def plot_growth(
    path: Path, lines: Mapping[str, tuple[Sequence[int], Sequence[float]]], kept: float, caption: str
) -> None:
    """Draw bytes over frames.

    Args:
        path: the file to write.
        lines: label -> frames, bytes.
        kept: bytes per frame in the public code.
        caption: below the axes.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axes = figure.add_subplot()
    for label, (frames, sizes) in lines.items():
        style = "-" if "float32" in label else ":"
        axes.plot(frames, np.array(sizes) / _MEGABYTE, style, marker=".", label=label)
    frames = sorted({count for counted, _ in lines.values() for count in counted})
    label = f"kept by the public code of VGGT: all pairs' outputs in float32, {kept / _MEGABYTE:.3g} MB a frame"
    axes.plot(frames, np.array(frames) * kept / _MEGABYTE, "--", color="0.3", label=label)
    axes.set(xlabel="frames", ylabel="MB beyond weights and images", ylim=(0, None))
    axes.set_xticks(frames)
    axes.legend(fontsize=8)
    _save(figure, path, caption)


def _number_frames(axes, frames: Sequence[int]) -> None:
    shown = sorted(set(frames))
    axes.set_xticks(shown, [str(count) for count in shown])
    axes.minorticks_off()


def _label(row: Row, *, frames: bool) -> str:
    label = f"{row.workload}, {row.size} {row.width} x {row.height}"
    return f"{label}, {row.frames} frames" if frames else label


def _save(figure, path: Path, caption: str) -> None:
    figure.supxlabel(caption, fontsize=7)
    with writing(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")
