"""Fusion rules compared on clips that no rule was fitted to, over several seeds."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vggtjax.errors import InputError
from vggtjax.method.fusion.family import Fused, Observations, fuse, paper_rule, parse_family
from vggtjax.progress import Progress, no_progress
from vggtjax.research.evaluation.metrics.depth import depth_alignment, depth_errors
from vggtjax.research.evaluation.metrics.uncertainty import reliability_curve, uncertainty_scores
from vggtjax.research.learning.clip_passes import ClipPasses, fit_clips, observations
from vggtjax.research.learning.fit import NEEDS_FRAMES, FitConfig, FitOutcome, fit_fusion
from vggtjax.storage.markdown import markdown_table

METRICS = {
    "abs_rel": "AbsRel",
    "abs_rel_static": "static",
    "abs_rel_dynamic": "dynamic",
    "nll": "NLL",
    "nll_calibrated": "NLL, one scale",
    "ece": "ECE",
    "ause": "AUSE",
}
PAPER = "paper"
CHOSEN = "chosen by the clips for stopping"
_FRAMES = 4  # of a clip, for fits that need whole frames

Rule = Callable[[Observations], Fused]

_fused = jax.jit(fuse)


class RuleScore(NamedTuple):
    """The score of one rule with one seed: means over the test clips; and the rule's fit, if there is one."""

    rule: str
    seed: int
    metrics: dict[str, float]
    fit: FitOutcome | None
    reliability: Float[np.ndarray, "2 K"]  # claimed levels, observed shares
    stopping: dict[str, float]  # metrics on the clips for early stopping, by which a family is chosen


class Split(NamedTuple):
    """Indices of the clips for the fit, for early stopping, and for the scores."""

    fitted: list[int]
    validation: list[int]
    test: list[int]


def split_clips(count: int, seed: int, held_out: float = 0.25) -> Split:
    """Split clips at random: a share for the scores, as large a share of the rest for early stopping.

    Raises InputError for fewer than three clips, or a share that is not between 0 and 1.
    """
    if not 0 < held_out < 1:
        raise InputError(f"held_out is {held_out}; expected a share above 0 and below 1")
    if count < 3:
        raise InputError(f"{count} clips with a true depth; expected at least three: to fit, to stop at, and to score")
    order = np.random.default_rng(seed).permutation(count).tolist()
    tests = min(max(round(held_out * count), 1), count - 2)
    stops = min(max(round(held_out * (count - tests)), 1), count - tests - 1)
    return Split(sorted(order[tests + stops :]), sorted(order[tests : tests + stops]), sorted(order[:tests]))


@cache
def baselines() -> dict[str, Rule]:
    """Return the rules without a fit: either pass, hard replacement, and the paper's rule; jitted."""

    def replaced(seen: Observations) -> Fused:
        moves = seen.dynamic >= 0.5
        depth = jnp.where(moves, seen.depth1, seen.depth2)
        return Fused(depth, jnp.where(moves, seen.log_confidence1, seen.log_confidence2), moves, moves)

    return {
        "pass 1 alone": jax.jit(lambda seen: Fused(seen.depth1, seen.log_confidence1, seen.dynamic, seen.dynamic)),
        "pass 2 alone": jax.jit(lambda seen: Fused(seen.depth2, seen.log_confidence2, seen.dynamic, seen.dynamic)),
        "hard replacement": jax.jit(replaced),
        PAPER: partial(_fused, paper_rule()),
    }


def ablate(
    clips: Sequence[ClipPasses],
    families: Sequence[str],
    config: FitConfig,
    *,
    seeds: Sequence[int] = range(5),
    held_out: float = 0.25,
    pixels: int = 16384,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> list[RuleScore]:
    """Fit families to clips, and score the fitted rules and the baselines on other clips.

    Args:
        clips: at least three, with true depth.
        families: names for `parse_family`.
        config: of the fits; family and seed are filled in.
        seeds: each seed splits the clips and draws pixels anew.
        held_out: share of the clips for the scores, and of the other clips for early stopping.
        pixels: of a clip, for fits that do not need whole frames.
        folder: for the states of fits, from which an interrupted run resumes; None keeps no states.
        progress: called with the fits done and their number.

    Returns:
        For every seed the scores of the baselines and of the families, and, of several families, those of the family
        with the lowest NLL on the clips for early stopping.
    """
    parts = {name: family for name in families if (family := parse_family(name))}  # the paper's rule is a baseline
    scores: list[RuleScore] = []
    seen = [observations(clip) for clip in clips]
    total, done = len(seeds) * len(parts), 0
    for seed in seeds:
        split = split_clips(len(clips), seed, held_out)

        def score(name: str, rule: Rule, fit: FitOutcome | None = None, split=split, seed=seed) -> RuleScore:
            groups = [[(clips[i], seen[i]) for i in indices] for indices in (split.test, split.validation)]
            (metrics, reliability), (stopping, _) = (score_rule(rule, group) for group in groups)
            return RuleScore(name, seed, metrics, fit, reliability, stopping)

        scores += [score(name, rule) for name, rule in baselines().items()]
        fitted: list[RuleScore] = []
        for name, family in parts.items():
            settings = dataclasses.replace(config, family=family, seed=seed)
            fit = fit_split(clips, seen, split, settings, pixels=pixels, folder=folder)
            fitted.append(score(name, partial(_fused, fit.params), fit))
            done += 1
            (progress or no_progress)(done, total)
        scores += fitted
        if len(fitted) > 1:
            best = min(fitted, key=lambda one: one.stopping["nll"])
            scores.append(best._replace(rule=CHOSEN, fit=None))
    return scores


def fit_split(
    clips: Sequence[ClipPasses],
    seen: Sequence[Observations],
    split: Split,
    config: FitConfig,
    *,
    pixels: int = 16384,
    folder: Path | None = None,
) -> FitOutcome:
    """Fit one family to the clips of a split; `seen` holds the `observations` of each, other arguments as for `ablate`.

    Fits that need whole frames (the gate, photometric and geometric objectives) take four frames of each clip, other
    fits `pixels` of all frames.
    """
    whole = config.objective in NEEDS_FRAMES or "gate" in config.family
    sampling: dict[str, Any] = {"frames": _FRAMES} if whole else {"pixels": pixels, "seed": config.seed}
    fitted, stopping = (
        fit_clips([clips[i] for i in indices], [seen[i] for i in indices], **sampling)
        for indices in (split.fitted, split.validation)
    )
    checkpoint = None
    if folder is not None:
        facts = [dataclasses.asdict(config), split, sampling]
        checkpoint = folder / f"{hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:24]}.npz"
    return fit_fusion(fitted, stopping, config, checkpoint=checkpoint)


def score_rule(
    rule: Rule, clips: Sequence[tuple[ClipPasses, Observations]]
) -> tuple[dict[str, float], Float[np.ndarray, "2 K"]]:
    """Return a rule's metrics and reliability curve, means over clips; each clip is aligned to its truth by one scale.

    Metrics that no clip defines are absent, such as the error of dynamic pixels where nothing moves.
    """
    scores: list[dict[str, float]] = []
    curves = []
    for clip, seen in clips:
        fused = rule(seen)
        depth, precision = np.asarray(fused.depth, np.float64), np.asarray(fused.precision, np.float64)
        known = np.isfinite(clip.truth) & (clip.truth > 0)
        truth = clip.truth[known] / depth_alignment(depth[known], clip.truth[known], "scale")[0]
        depth, moves = depth[known], clip.true_dynamic[known]
        claimed = uncertainty_scores(depth, truth, precision[known])
        metrics = {"abs_rel": depth_errors(depth, truth, scale=1.0).abs_rel}
        for name, part in (("abs_rel_static", ~moves), ("abs_rel_dynamic", moves)):
            if part.any() and clip.true_dynamic.any():
                metrics[name] = depth_errors(depth[part], truth[part], scale=1.0).abs_rel
        metrics |= {name: getattr(claimed, name) for name in ("nll", "nll_calibrated", "ece", "ause")}
        scores.append(metrics)
        curves.append(np.stack(reliability_curve(depth - truth, precision[known], 1.0)))
    means = {name: float(np.mean(values)) for name, values in _by_metric(scores).items()}
    return means, np.mean(curves, axis=0)


def table(scores: Sequence[RuleScore]) -> dict[str, dict[str, tuple[float, float]]]:
    """Return mean and standard deviation over the seeds of every rule's metrics."""
    return {
        rule: {name: _spread(values) for name, values in _by_metric(list(by_seed.values())).items()}
        for rule, by_seed in _by_rule(scores).items()
    }


def gains(scores: Sequence[RuleScore], against: str = PAPER) -> dict[str, dict[str, tuple[float, float, int]]]:
    """Return every rule's metrics minus those of another rule: mean, standard deviation, number of seeds below 0."""
    by_rule = _by_rule(scores)
    base = by_rule.pop(against)
    rows: dict[str, dict[str, tuple[float, float, int]]] = {}
    for rule, by_seed in by_rule.items():
        differences = _by_metric(
            [{name: m[name] - base[seed][name] for name in m.keys() & base[seed]} for seed, m in by_seed.items()]
        )
        rows[rule] = {name: (*_spread(values), sum(v < 0 for v in values)) for name, values in differences.items()}
    return rows


def markdown(rows: Mapping[str, Mapping[str, tuple[float, float]]]) -> str:
    """Return the rows of `table` in Markdown, mean ± standard deviation."""
    names = [name for name in METRICS if any(name in row for row in rows.values())]
    cells = [
        [rule, *(f"{row[name][0]:.4f} ± {row[name][1]:.4f}" if name in row else "-" for name in names)]
        for rule, row in rows.items()
    ]
    return markdown_table(["rule", *(METRICS[name] for name in names)], cells)


def _by_rule(scores: Sequence[RuleScore]) -> dict[str, dict[int, dict[str, float]]]:
    """Return rule -> seed -> metrics."""
    rules = dict.fromkeys(score.rule for score in scores)
    return {rule: {score.seed: score.metrics for score in scores if score.rule == rule} for rule in rules}


def _by_metric(metrics: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """Return metric -> values, in the order of METRICS, without metrics that are absent everywhere."""
    lists = {name: [one[name] for one in metrics if name in one] for name in METRICS}
    return {name: values for name, values in lists.items() if values}


def _spread(values: Sequence[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
