"""Means and spreads of ladder rows over seeds, and everything as markdown tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.blind_guesses import Comparison
from vggtjax.evaluation.ladder import LadderRow

METRICS = {  # fields of LadderRow, and their names in tables and plots
    "abs_rel": "AbsRel",
    "abs_rel_static": "AbsRel static",
    "abs_rel_dynamic": "AbsRel dynamic",
    "delta1": "delta1",
    "rotation_error": "rotation (deg)",
    "centre_error": "centres",
    "centre_error_ratio": "centres / depth",
    "point_distance": "points",
    "point_distance_first": "points, first camera",
    "mask_jaccard": "mask J",
}
# also relative to the plain pass
AGAINST_FIRST = ("abs_rel", "rotation_error", "centre_error", "point_distance_first")

_GUESSES = {
    "mean_depth_map": "mean depth map",
    "no_rotation": "no rotation",
    "mean_rate": "mean rate of training scenes",
    "best_rate": "best constant rate (oracle)",
    "no_motion": "no motion",
    "line": "best line (oracle)",
}


@dataclass(frozen=True)
class Spread:
    """A mean over seeds, of means over clips, and the sample standard deviation between seeds."""

    mean: float
    deviation: float | None  # None for a single seed
    seeds: int

    def __str__(self) -> str:
        return f"{self.mean:.4f}" + ("" if self.deviation is None else f" ± {self.deviation:.4f}")


@dataclass(frozen=True)
class Summary:
    """One setting of the ladder over all clips of all seeds."""

    method: str
    mask_source: str | None
    mask_pairs: int | None
    suppress: str | None
    clips: int
    failed: int  # clips with a failed metric
    scores: dict[str, Spread]
    ratios: dict[str, Spread]  # mean error relative to the plain pass on the same clips


def spread(values: Sequence[float]) -> Spread:
    """Return mean and sample standard deviation of one number per seed."""
    return Spread(float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None, len(values))


def summarise(by_seed: Sequence[Sequence[LadderRow]]) -> list[Summary]:
    """Summarise the ladder's rows of several seeds, setting by setting, in the order of the first seed."""
    first = [[row for row in rows if row.mask_source is None] for rows in by_seed]
    found = []
    for setting in dict.fromkeys(_setting(row) for rows in by_seed for row in rows):
        chosen = [[row for row in rows if _setting(row) == setting] for rows in by_seed]
        chosen = [(rows, plain) for rows, plain in zip(chosen, first, strict=True) if rows]
        scores = {name: [_mean(rows, name) for rows, _ in chosen] for name in METRICS}
        ratios = {name: [_ratio(rows, plain, name) for rows, plain in chosen] for name in AGAINST_FIRST}
        found.append(
            Summary(
                *setting,
                clips=sum(len(rows) for rows, _ in chosen),
                failed=sum(bool(row.failure) for rows, _ in chosen for row in rows),
                scores=_spreads(scores),
                ratios=_spreads(ratios),
            )
        )
    return found


def saliency_auc(by_seed: Sequence[Sequence[LadderRow]]) -> Spread | None:
    """Return the first pass's saliency AUC, clip by clip and seed by seed; None where no clip has one."""
    plain = [[row for row in rows if row.mask_source is None] for rows in by_seed]
    means = [_mean(rows, "saliency_auc") for rows in plain]
    return spread(there) if (there := [mean for mean in means if mean is not None]) else None


def comparison_table(comparisons: Sequence[Comparison]) -> str:
    """Return a markdown table of a model against the blind guesses."""
    rows = [
        [
            METRICS[c.metric],
            _GUESSES[c.guess],
            _number(c.model_error),
            _number(c.guess_error),
            _number(c.ratio),
            f"{c.threshold}",
            "pass" if c.passed else "FAIL",
            f"{100 * c.better:.0f} %",
            f"{c.clips}" + (f", {c.failed} failed" if c.failed else ""),
        ]
        for c in comparisons
    ]
    header = ["metric", "guess", "model", "its error", "ratio", "threshold", "", "model better", "clips"]
    return markdown_table(header, rows)


def ladder_table(summaries: Sequence[Summary]) -> str:
    """Return a markdown table of the ladder: mean ± standard deviation between seeds."""
    rows = [
        [
            s.method,
            *("-" if value is None else str(value) for value in (s.mask_source, s.mask_pairs, s.suppress)),
            *(str(s.scores.get(name, "-")) for name in METRICS),
            *(str(s.ratios.get(name, "-")) for name in AGAINST_FIRST),
            f"{s.clips}" + (f", {s.failed} failed" if s.failed else ""),
        ]
        for s in summaries
    ]
    against = [f"{METRICS[name]} / vggt" for name in AGAINST_FIRST]
    return markdown_table(["method", "mask", "pairs", "suppress", *METRICS.values(), *against, "clips"], rows)


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a markdown table with padded columns."""
    lines = [list(header), *map(list, rows)]
    widths = [max(3, *(len(line[column]) for line in lines)) for column in range(len(header))]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in lines
    )


def _setting(row: LadderRow) -> tuple[str, str | None, int | None, str | None]:
    return row.method, row.mask_source, row.mask_pairs, row.suppress


def _mean(rows: Sequence[LadderRow], name: str) -> float | None:
    values = [value for row in rows if (value := getattr(row, name)) is not None]
    return float(np.mean(values)) if values else None


def _ratio(rows: Sequence[LadderRow], plain: Sequence[LadderRow], name: str) -> float | None:
    """Return the mean error of rows relative to the plain pass, on the clips where both have one."""
    first = {row.clip: getattr(row, name) for row in plain}
    pairs = [(getattr(row, name), first.get(row.clip)) for row in rows]
    there = [(ours, theirs) for ours, theirs in pairs if ours is not None and theirs is not None]
    below = sum(theirs for _, theirs in there)
    return float(sum(ours for ours, _ in there) / below) if below > 0 else None


def _spreads(values: dict[str, list[float | None]]) -> dict[str, Spread]:
    there = {name: [value for value in column if value is not None] for name, column in values.items()}
    return {name: spread(column) for name, column in there.items() if column}


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
