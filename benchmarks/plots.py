"""Figures of the benchmarks, with matplotlib: the ladder with its spread, sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.summaries import METRICS, Summary
from vggtjax.storage.writing import writing

SHOWN = ("abs_rel", "rotation_error", "centre_error", "point_distance_first")  # of those compared with the plain pass
_COLOURS: dict[str | None, str] = {"mined": "tab:blue", "matches": "tab:green", "true": "tab:orange"}
_NAMES: dict[str | None, str] = {"mined": "mined mask", "matches": "mask with matches", "true": "true mask"}


def plot_ladder(path: Path, summaries: Sequence[Summary], title: str) -> None:
    """Draw a bar of errors relative to the plain pass's for every method and mask.

    Its whisker is the standard deviation between seeds.
    """
    from matplotlib.figure import Figure

    chosen = [s for s in summaries if s.mask_source is not None]
    methods = list(dict.fromkeys(s.method for s in chosen))
    figure = Figure(figsize=(4 * len(SHOWN), 4), layout="constrained")
    for axes, metric in zip(figure.subplots(1, len(SHOWN)), SHOWN, strict=True):
        for offset, source in ((-0.27, "mined"), (0, "matches"), (0.27, "true")):
            found = [(s.method, s.ratios[metric]) for s in chosen if s.mask_source == source and metric in s.ratios]
            axes.bar(
                [methods.index(method) + offset for method, _ in found],
                [spread.mean for _, spread in found],
                width=0.27,
                yerr=[spread.deviation or 0 for _, spread in found],
                capsize=3,
                color=_COLOURS[source],
                label=_NAMES[source],
            )
        axes.set_title(f"{METRICS[metric]} / vggt")
        axes.axhline(1, color="0.3", linestyle=":")
        spreads = [s.ratios[metric] for s in chosen if metric in s.ratios]
        reach = max([0.05, *(abs(spread.mean - 1) + (spread.deviation or 0) for spread in spreads)])
        axes.set_ylim(max(1 - 1.1 * reach, 0), 1 + 1.1 * reach)
        axes.set_xticks(range(len(methods)), methods, rotation=20, ha="right")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
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
