"""Figures of a benchmark, with matplotlib: the ladder with its spread, rotation errors scene by scene, sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.blind_guesses import Guess
from benchmarks.summaries import METRICS, Summary
from vggtjax.evaluation.ladder import LadderRow
from vggtjax.geometry.similarity import centres, umeyama_sim3
from vggtjax.storage.writing import writing

SHOWN = ("abs_rel", "rotation_error", "centre_error", "point_distance_first")  # of those compared with the plain pass
_COLOURS = {None: "0.55", "mined": "tab:blue", "true": "tab:orange"}
_NAMES = {None: "no mask", "mined": "mined mask", "true": "true mask"}


def plot_rotations(path: Path, rows: dict[str, tuple[Sequence[LadderRow], Sequence[Guess]]]) -> None:
    """Draw each clip's rotation error relative to no rotation; the dashed line is one half."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 5), layout="constrained")
    axes = figure.add_subplot()
    longest = 1e-3
    for name, (ours, guessed) in rows.items():
        there = [(guessed[row.clip].no_rotation, row.rotation_error) for row in ours if row.rotation_error is not None]
        points = np.array(there).reshape(-1, 2)
        axes.scatter(points[:, 0], points[:, 1], s=12, label=f"{name} ({len(there)})")
        longest = max(longest, *points.ravel().tolist())
    axes.plot([0, longest], [0, longest], color="0.4", linewidth=1, label="no rotation")
    axes.plot([0, longest], [0, longest / 2], color="0.4", linewidth=1, linestyle="--", label="half of it")
    axes.set(xlabel="error of no rotation (degrees)", ylabel="error of the model (degrees)")
    axes.legend()
    _save(figure, path)


def plot_ladder(path: Path, summaries: Sequence[Summary], title: str) -> None:
    """Draw a bar for every method and mask, its whisker the standard deviation between seeds.

    Above the errors themselves, whose spread is that of the scenes; below their ratios to the plain pass.
    """
    from matplotlib.figure import Figure

    methods = list(dict.fromkeys(s.method for s in summaries))
    figure = Figure(figsize=(4 * len(SHOWN), 7), layout="constrained")
    upper, lower = figure.subplots(2, len(SHOWN), sharex=True)
    for errors, ratios, metric in zip(upper, lower, SHOWN, strict=True):
        for offset, source in ((0, None), (-0.2, "mined"), (0.2, "true")):
            for axes, values in ((errors, "scores"), (ratios, "ratios")):
                found = [(s.method, getattr(s, values).get(metric)) for s in summaries if s.mask_source == source]
                there = [(methods.index(method) + offset, spread) for method, spread in found if spread is not None]
                axes.bar(
                    [x for x, _ in there],
                    [spread.mean for _, spread in there],
                    width=0.4,
                    yerr=[spread.deviation or 0 for _, spread in there],
                    capsize=3,
                    color=_COLOURS[source],
                    label=_NAMES[source],
                )
        errors.set_title(METRICS[metric])
        ratios.set_title(f"{METRICS[metric]} / vggt")
        ratios.axhline(1, color="0.3", linestyle=":")
        spreads = [spread for s in summaries if (spread := s.ratios.get(metric)) is not None]
        reach = max([0.05, *(abs(spread.mean - 1) + (spread.deviation or 0) for spread in spreads)])
        ratios.set_ylim(max(1 - 1.1 * reach, 0), 1 + 1.1 * reach)
        ratios.set_xticks(range(len(methods)), methods, rotation=20, ha="right")
    figure.legend(*upper[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(title)
    _save(figure, path)


def plot_sweep(path: Path, summaries: Sequence[Summary], method: str) -> None:
    """Draw a method's errors over the number of pairs with suppressed keys; dotted: the plain pass."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4 * len(SHOWN), 4), layout="constrained")
    lines = dict.fromkeys((s.mask_source, s.suppress) for s in summaries if s.method == method)
    for axes, metric in zip(figure.subplots(1, len(SHOWN)), SHOWN, strict=True):
        for source, suppress in lines:
            chosen = [
                (s.mask_pairs, s.scores[metric].mean)
                for s in summaries
                if (s.method, s.mask_source, s.suppress) == (method, source, suppress) and metric in s.scores
            ]
            style = "-" if suppress == "zero" else "--"
            pairs, values = zip(*sorted(chosen), strict=True) if chosen else ((), ())
            axes.plot(pairs, values, style, marker=".", color=_COLOURS[source], label=f"{_NAMES[source]}, {suppress}")
        for s in summaries:
            if s.mask_source is None and metric in s.scores:
                axes.axhline(s.scores[metric].mean, color="0.3", linestyle=":", label=s.method)
        axes.set(xlabel="pairs with suppressed keys", title=METRICS[metric])
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    figure.suptitle(method)
    _save(figure, path)


def _save(figure, path: Path) -> None:
    with writing(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def plot_paths(
    path: Path, cameras: dict[str, np.ndarray], reference: np.ndarray, title: str, name: str = "true"
) -> None:
    """Draw the paths of cameras from above, each fitted to a reference of this name by a similarity."""
    from matplotlib.figure import Figure

    columns = 3
    rows = -(-len(cameras) // columns)
    figure = Figure(figsize=(4 * columns, 4 * rows), layout="constrained")
    wanted = centres(reference)
    every = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in every[len(cameras) :]:
        axes.set_axis_off()
    for axes, (way, poses) in zip(every, cameras.items(), strict=False):
        found = umeyama_sim3(centres(poses), wanted, allow_line=True).apply(centres(poses))
        axes.plot(wanted[:, 0], wanted[:, 2], color="0.6", linewidth=3, label=name)
        axes.plot(found[:, 0], found[:, 2], color="tab:blue", linewidth=1.2, label="found")
        axes.plot(*found[[0, -1]][:, [0, 2]].T, ".", color="tab:red", label="first, last")
        axes.set_title(way, fontsize=9)
        axes.set_aspect("equal")
    figure.axes[0].legend(fontsize=8)
    figure.suptitle(title)
    _save(figure, path)
