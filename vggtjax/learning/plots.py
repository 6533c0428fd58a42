"""Pictures of fits, with matplotlib: precision against confidence, calibration, scores, losses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vggtjax.errors import MissingExtraError
from vggtjax.evaluation.video_depth import depth_alignment
from vggtjax.files import writing
from vggtjax.learning.ablation import PAPER, Outcome
from vggtjax.learning.clip_passes import ClipPasses

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BINS = 12
_DPI = 110


def check_matplotlib() -> None:
    """Raise MissingExtraError if there is no matplotlib, before anything is fitted."""
    try:
        import matplotlib as _  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("drawing a fit", "train") from error


def draw_fits(folder: Path, outcomes: Sequence[Outcome], clips: Sequence[ClipPasses], shown: str) -> list[Path]:
    """Draw all pictures into a folder; `shown` is the family whose precision and calibration are looked at."""
    figures = {
        "precision.png": _precision(outcomes, clips, shown),
        "calibration.png": _calibration(outcomes, shown),
        "scores.png": _scores(outcomes),
        "losses.png": _losses(outcomes),
    }
    for name, figure in figures.items():
        with writing(folder / name) as path:
            figure.savefig(path, dpi=_DPI)
    return [folder / name for name in figures]


def observed_precision(clips: Sequence[ClipPasses], which: int) -> tuple[np.ndarray, np.ndarray]:
    """Return bins of a pass's confidence, and one over the mean squared error of depth in each of them.

    Bins have as many pixels each; errors are those after one scale for each clip, in the unit of the prediction.
    """
    confidences, squares = [], []
    for clip in clips:
        known = np.isfinite(clip.truth) & (clip.truth > 0)
        depth = (clip.depth1, clip.depth2)[which][known].astype(np.float64)
        truth = clip.truth[known] / depth_alignment(depth, clip.truth[known], "scale")[0]
        confidences.append((clip.confidence1, clip.confidence2)[which][known])
        squares.append((depth - truth) ** 2)
    confidence, square = np.concatenate(confidences), np.concatenate(squares)
    parts = np.array_split(np.argsort(confidence), _BINS)
    means = [(np.exp(np.log(confidence[part]).mean()), 1 / square[part].mean()) for part in parts]
    middles, observed = np.array(means).T
    return middles, observed


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _precision(outcomes: Sequence[Outcome], clips: Sequence[ClipPasses], shown: str) -> Figure:
    figure = _figure(9, 4)
    fits = [outcome.fit for outcome in outcomes if outcome.rule == shown and outcome.fit is not None]
    for which in (0, 1):
        axis = figure.add_subplot(1, 2, which + 1)
        middles, observed = observed_precision(clips, which)
        grid = np.geomspace(middles[0], middles[-1], 100)
        axis.plot(middles, observed, "o", color="black", label="observed: 1 / mean squared error")
        axis.plot(grid, grid, color="tab:orange", label="paper: the confidence itself")
        for i, fit in enumerate(fits):
            scale, power, floor = (float(fit.params[name][which]) for name in ("scale", "power", "floor"))
            learned = np.exp(scale) * grid**power + floor
            axis.plot(grid, learned, color="tab:blue", alpha=0.6, label=f"{shown}, each seed" if not i else None)
        axis.set(
            xscale="log", yscale="log", xlabel="confidence", ylabel="precision of depth", title=f"pass {which + 1}"
        )
        axis.grid(alpha=0.3, which="both")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def _calibration(outcomes: Sequence[Outcome], shown: str) -> Figure:
    figure = _figure(4.8, 4.6)
    axis = figure.add_subplot()
    axis.plot([0, 1], [0, 1], color="black", linewidth=1, label="calibrated")
    for rule, color in ((PAPER, "tab:orange"), (shown, "tab:blue")):
        for i, outcome in enumerate(outcome for outcome in outcomes if outcome.rule == rule):
            axis.plot(*outcome.reliability, ".-", color=color, alpha=0.6, label=None if i else rule)
    axis.set(xlabel="claimed share of errors within the interval", ylabel="observed share", xlim=(0, 1), ylim=(0, 1))
    axis.set_aspect("equal")
    axis.grid(alpha=0.3)
    axis.legend(frameon=False)
    return figure


def _scores(outcomes: Sequence[Outcome]) -> Figure:
    names = {"abs_rel": "AbsRel", "nll": "NLL, nats", "ece": "ECE"}
    rules = list(dict.fromkeys(outcome.rule for outcome in outcomes))
    figure = _figure(11, 0.8 + 0.34 * len(rules))
    for place, (name, title) in enumerate(names.items()):
        axis = figure.add_subplot(1, len(names), place + 1)
        for row, rule in enumerate(rules):
            values = [outcome.metrics[name] for outcome in outcomes if outcome.rule == rule]
            color = "tab:orange" if rule == PAPER else "tab:blue" if outcomes_fit(outcomes, rule) else "tab:gray"
            axis.plot(values, [row] * len(values), "o", color=color, alpha=0.5, markersize=5)
            axis.plot([np.mean(values)], [row], "|", color=color, markersize=16, markeredgewidth=2)
        axis.set_yticks(range(len(rules)), rules if place == 0 else [""] * len(rules))
        axis.invert_yaxis()
        axis.set_xlabel(f"{title} (lower is better)")
        axis.grid(alpha=0.3)
    return figure


def outcomes_fit(outcomes: Sequence[Outcome], rule: str) -> bool:
    """Return whether a rule was fitted."""
    return any(outcome.fit is not None for outcome in outcomes if outcome.rule == rule)


def _losses(outcomes: Sequence[Outcome]) -> Figure:
    fitted: Mapping[str, list[Any]] = {}
    for outcome in outcomes:
        if outcome.fit is not None:
            fitted = {**fitted, outcome.rule: [*fitted.get(outcome.rule, []), outcome.fit]}
    figure = _figure(max(3.0 * len(fitted), 4), 3.2)
    for place, (rule, fits) in enumerate(fitted.items()):
        axis = figure.add_subplot(1, max(len(fitted), 1), place + 1)
        for i, fit in enumerate(fits):
            step, inside, outside = fit.losses.T
            axis.plot(step, inside, color="tab:gray", alpha=0.6, label=None if i or place else "fitted clips")
            axis.plot(step, outside, color="tab:blue", alpha=0.6, label=None if i or place else "held-out clips")
        axis.set(title=rule, xlabel="step", ylabel="" if place else "objective")
        axis.grid(alpha=0.3)
    if fitted:
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure
