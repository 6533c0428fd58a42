"""Pictures of fits, with matplotlib: precision against confidence, calibration, scores, losses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from vggtjax.method.fusion.family import FusionParams, log_precisions
from vggtjax.research.evaluation.metrics.depth import depth_alignment
from vggtjax.research.evaluation.plots import add_legend, new_figure
from vggtjax.research.learning.ablation import PAPER, RuleScore
from vggtjax.research.learning.clip_passes import ClipPasses, observations
from vggtjax.storage.writing import writing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BINS = 12
_DPI = 110
_COLUMNS = 4

_claims = jax.jit(log_precisions)


def draw_fits(folder: Path, scores: Sequence[RuleScore], clips: Sequence[ClipPasses], shown: str) -> None:
    """Draw all pictures into a folder, precision and calibration of the family `shown`."""
    figures = {
        "precision.png": _precision(scores, clips, shown),
        "calibration.png": _calibration(scores, shown),
        "scores.png": _scores(scores),
        "losses.png": _losses(scores),
    }
    for name, figure in figures.items():
        with writing(folder / name) as path:
            figure.savefig(path, dpi=_DPI)


def precision_by_confidence(
    clips: Sequence[ClipPasses], which: int, trees: Sequence[FusionParams]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bins of a pass's confidence, the precision observed in each bin, and the precision that trees claim there.

    All bins have the same number of pixels. Observed precision is one over the mean squared error after one scale for
    each clip, in the unit of the prediction; claimed precision is one over the mean claimed variance, [trees, bins].
    """
    confidences, squares, variances = [], [], []
    for clip in clips:
        known = np.isfinite(clip.truth) & (clip.truth > 0)
        depth = (clip.depth1, clip.depth2)[which][known].astype(np.float64)
        truth = clip.truth[known] / depth_alignment(depth, clip.truth[known], "scale")[0]
        confidences.append((clip.confidence1, clip.confidence2)[which][known])
        squares.append((depth - truth) ** 2)
        seen = observations(clip)
        claims = [np.asarray(_claims(tree, seen)[which], np.float64)[known] for tree in trees]
        variances.append(np.exp(-np.asarray(claims).reshape(len(trees), -1)))
    confidence, square, variance = np.concatenate(confidences), np.concatenate(squares), np.concatenate(variances, 1)
    parts = np.array_split(np.argsort(confidence), _BINS)
    middles = np.array([np.exp(np.log(confidence[part]).mean()) for part in parts])
    observed = np.array([1 / square[part].mean() for part in parts])
    return middles, observed, np.stack([1 / variance[:, part].mean(axis=1) for part in parts], axis=1)


def _precision(scores: Sequence[RuleScore], clips: Sequence[ClipPasses], shown: str) -> Figure:
    figure = new_figure(9, 4)
    fits = [score.fit for score in scores if score.rule == shown and score.fit is not None]
    for which in (0, 1):
        axis = figure.add_subplot(1, 2, which + 1)
        middles, observed, claimed = precision_by_confidence(clips, which, [fit.params for fit in fits])
        axis.plot(middles, observed, "o", color="black", label="observed: 1 / mean squared error")
        axis.plot(middles, middles, color="tab:orange", label="paper: the confidence itself")
        for i, line in enumerate(claimed):
            axis.plot(middles, line, color="tab:blue", alpha=0.6, label=None if i else f"{shown}, each seed")
        axis.loglog()
        axis.set(xlabel="confidence", ylabel="precision of depth", title=f"pass {which + 1}")
        axis.grid(alpha=0.3, which="both")
    add_legend(figure, 3)
    return figure


def _calibration(scores: Sequence[RuleScore], shown: str) -> Figure:
    figure = new_figure(4.8, 4.6)
    axis = figure.add_subplot()
    axis.plot([0, 1], [0, 1], color="black", linewidth=1, label="calibrated")
    for rule, color in ((PAPER, "tab:orange"), (shown, "tab:blue")):
        for i, score in enumerate(score for score in scores if score.rule == rule):
            axis.plot(*score.reliability, ".-", color=color, alpha=0.6, label=None if i else rule)
    axis.set(xlabel="claimed share of errors within the interval", ylabel="observed share", xlim=(0, 1), ylim=(0, 1))
    axis.set_aspect("equal")
    axis.grid(alpha=0.3)
    axis.legend(frameon=False)
    return figure


def _scores(scores: Sequence[RuleScore]) -> Figure:
    names = {"abs_rel": "AbsRel", "nll": "NLL, nats", "ece": "ECE"}
    rules = list(dict.fromkeys(score.rule for score in scores))
    colors = {score.rule: "tab:blue" if score.fit is not None else "tab:gray" for score in scores}
    colors[PAPER] = "tab:orange"
    figure = new_figure(11, 0.8 + 0.34 * len(rules))
    for place, (name, title) in enumerate(names.items()):
        axis = figure.add_subplot(1, len(names), place + 1)
        for row, rule in enumerate(rules):
            values = [score.metrics[name] for score in scores if score.rule == rule]
            axis.plot(values, [row] * len(values), "o", color=colors[rule], alpha=0.5, markersize=5)
            axis.plot([np.mean(values)], [row], "|", color=colors[rule], markersize=16, markeredgewidth=2)
        axis.set_yticks(range(len(rules)), rules if place == 0 else [""] * len(rules))
        axis.invert_yaxis()
        axis.set_xlabel(f"{title} (lower is better)")
        axis.grid(alpha=0.3)
    return figure


def _losses(scores: Sequence[RuleScore]) -> Figure:
    fitted: dict[str, list[Any]] = {}
    for score in scores:
        if score.fit is not None:
            fitted.setdefault(score.rule, []).append(score.fit)
    columns = min(max(len(fitted), 1), _COLUMNS)
    rows = -(-max(len(fitted), 1) // columns)
    figure = new_figure(3 * columns + 1, 2.4 * rows + 0.5)
    for place, (rule, fits) in enumerate(fitted.items()):
        axis = figure.add_subplot(rows, columns, place + 1)
        for i, fit in enumerate(fits):
            step, inside, outside = fit.losses.T
            axis.plot(step, inside, color="tab:gray", alpha=0.6, label=None if i or place else "fitted clips")
            axis.plot(step, outside, color="tab:blue", alpha=0.6, label=None if i or place else "held-out clips")
        axis.set(title=rule, xlabel="step", ylabel="" if place % columns else "objective")
        axis.grid(alpha=0.3)
    if fitted:
        add_legend(figure, 2)
    return figure
