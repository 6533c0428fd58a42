"""Rules of fusion side by side on clips that none of them was fitted to, over several seeds."""

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
from vggtjax.evaluation.metrics.depth import depth_errors
from vggtjax.evaluation.metrics.uncertainty import reliability_curve, uncertainty_scores
from vggtjax.evaluation.metrics.video_depth import depth_alignment
from vggtjax.learning.clip_passes import ClipPasses, fit_clips, observations
from vggtjax.learning.fit import NEEDS_FRAMES, Fit, FitConfig, fit_fusion
from vggtjax.method.fusion_rule import Fused, Observations, fuse, identity, parse_family

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
_FRAMES = 4  # of a clip, for fits that look at whole frames

Rule = Callable[[Observations], Fused]

_fused = jax.jit(fuse)


class Outcome(NamedTuple):
    """What one rule scored with one seed: means over the test clips; and its fit, if it was fitted."""

    rule: str
    seed: int
    metrics: dict[str, float]
    fit: Fit | None
    reliability: Float[np.ndarray, "2 K"]  # claimed levels, observed shares
    stopping: dict[str, float]  # the metrics on the clips for early stopping, by which a family is chosen


class Split(NamedTuple):
    """Which clips are fitted to, looked at for early stopping, and kept for the scores."""

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
        raise InputError(f"{count} clips with a true depth; expected three at least: to fit, to stop at, and to score")
    order = np.random.default_rng(seed).permutation(count).tolist()
    tests = min(max(round(held_out * count), 1), count - 2)
    stops = min(max(round(held_out * (count - tests)), 1), count - tests - 1)
    return Split(sorted(order[tests + stops :]), sorted(order[tests : tests + stops]), sorted(order[:tests]))


@cache
def baselines() -> dict[str, Rule]:
    """Return the rules that nothing is learned of: either pass, hard replacement, and the paper's; jitted."""

    def replaced(seen: Observations) -> Fused:
        moves = seen.dynamic >= 0.5
        depth = jnp.where(moves, seen.depth1, seen.depth2)
        return Fused(depth, jnp.where(moves, seen.log_confidence1, seen.log_confidence2), moves, moves)

    return {
        "pass 1 alone": jax.jit(lambda seen: Fused(seen.depth1, seen.log_confidence1, seen.dynamic, seen.dynamic)),
        "pass 2 alone": jax.jit(lambda seen: Fused(seen.depth2, seen.log_confidence2, seen.dynamic, seen.dynamic)),
        "hard replacement": jax.jit(replaced),
        PAPER: partial(_fused, identity()),
    }


def ablate(
    clips: Sequence[ClipPasses],
    patch_size: int,
    families: Sequence[str],
    config: FitConfig,
    *,
    seeds: Sequence[int] = range(5),
    held_out: float = 0.25,
    pixels: int = 16384,
    folder: Path | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Outcome]:
    """Fit families to clips and score them, and the baselines, on clips that they were not fitted to.

    Args:
        clips: at least three, with true depth.
        patch_size: of the model.
        families: names that `parse_family` takes.
        config: of the fits; family and seed are filled in.
        seeds: each splits the clips anew, and draws other pixels.
        held_out: share of the clips for the scores, and of the rest for early stopping.
        pixels: of a clip that fits look at, where they need no whole frames.
        folder: for the states of fits, so that an interrupted run goes on; none if None.
        progress: called with the fits done and their number.

    Returns:
        For every seed the outcomes of the baselines, those of the families, and that of the family with the lowest NLL
        on the clips for stopping, if there are several.
    """
    chosen = {name: parse_family(name) for name in families}
    found: list[Outcome] = []
    seen = [observations(clip, patch_size) for clip in clips]
    total, done = len(seeds) * sum(map(bool, chosen.values())), 0
    for seed in seeds:
        split = split_clips(len(clips), seed, held_out)

        def outcome(name: str, rule: Rule, fit: Fit | None = None, split=split, seed=seed) -> Outcome:
            parts = [[(clips[i], seen[i]) for i in indices] for indices in (split.test, split.validation)]
            (metrics, reliability), (stopping, _) = (score_rule(rule, part) for part in parts)
            return Outcome(name, seed, metrics, fit, reliability, stopping)

        found += [outcome(name, rule) for name, rule in baselines().items()]
        fitted: list[Outcome] = []
        for name, family in chosen.items():
            if not family:
                continue  # the paper's own: a baseline
            fit = fit_split(clips, seen, split, _with(config, family, seed), pixels=pixels, folder=folder)
            fitted.append(outcome(name, partial(_fused, fit.params), fit))
            done += 1
            if progress is not None:
                progress(done, total)
        found += fitted
        if len(fitted) > 1:
            best = min(fitted, key=lambda one: one.stopping["nll"])
            found.append(best._replace(rule=CHOSEN, fit=None))
    return found


def fit_split(
    clips: Sequence[ClipPasses],
    seen: Sequence[Observations],
    split: Split,
    config: FitConfig,
    *,
    pixels: int = 16384,
    folder: Path | None = None,
) -> Fit:
    """Fit one family to the clips of a split; `seen` is what `observations` made of each, the rest as for `ablate`.

    Fits that need whole frames (the gate, photometric and geometric objectives) look at four of each clip, the others
    at `pixels` of all.
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
    """Return a rule's metrics and its reliability curve, means over clips, each brought to its truth by one scale.

    A metric that no clip allows, such as that of dynamic pixels where nothing moves, is left out.
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
        row = {"abs_rel": depth_errors(depth, truth, scale=1.0).abs_rel}
        for name, part in (("abs_rel_static", ~moves), ("abs_rel_dynamic", moves)):
            if part.any() and clip.true_dynamic.any():
                row[name] = depth_errors(depth[part], truth[part], scale=1.0).abs_rel
        row |= {name: getattr(claimed, name) for name in ("nll", "nll_calibrated", "ece", "ause")}
        scores.append(row)
        curves.append(np.stack(reliability_curve(depth - truth, precision[known], 1.0)))
    present = {name: [row[name] for row in scores if name in row] for name in METRICS}
    return {name: float(np.mean(values)) for name, values in present.items() if values}, np.mean(curves, axis=0)


def table(outcomes: Sequence[Outcome]) -> dict[str, dict[str, tuple[float, float]]]:
    """Return mean and standard deviation over the seeds of every rule's metrics."""
    rows: dict[str, dict[str, tuple[float, float]]] = {}
    for rule in dict.fromkeys(outcome.rule for outcome in outcomes):
        own = [outcome.metrics for outcome in outcomes if outcome.rule == rule]
        present = {name: [m[name] for m in own if name in m] for name in METRICS}
        rows[rule] = {name: _spread(values) for name, values in present.items() if values}
    return rows


def gains(outcomes: Sequence[Outcome], against: str = PAPER) -> dict[str, dict[str, tuple[float, float, int]]]:
    """Return every rule's metrics minus another's on the same clips: mean, standard deviation, seeds that are lower."""
    base = {outcome.seed: outcome.metrics for outcome in outcomes if outcome.rule == against}
    rows: dict[str, dict[str, tuple[float, float, int]]] = {}
    for rule in dict.fromkeys(outcome.rule for outcome in outcomes if outcome.rule != against):
        own = {outcome.seed: outcome.metrics for outcome in outcomes if outcome.rule == rule}
        rows[rule] = {}
        for name in METRICS:
            apart = [m[name] - base[seed][name] for seed, m in own.items() if name in m and name in base[seed]]
            if apart:
                rows[rule][name] = (*_spread(apart), sum(value < 0 for value in apart))
    return rows


def markdown(rows: Mapping[str, Mapping[str, tuple[float, float]]]) -> str:
    """Return the table in Markdown, mean ± standard deviation."""
    names = [name for name in METRICS if any(name in row for row in rows.values())]
    lines = ["| rule | " + " | ".join(METRICS[name] for name in names) + " |", "|---" * (len(names) + 1) + "|"]
    for rule, row in rows.items():
        cells = [f"{row[name][0]:.4f} ± {row[name][1]:.4f}" if name in row else "-" for name in names]
        lines.append(f"| {rule} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _with(config: FitConfig, family: tuple[str, ...], seed: int) -> FitConfig:
    return dataclasses.replace(config, family=family, seed=seed)


def _spread(values: Sequence[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
