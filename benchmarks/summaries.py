"""Means, spreads and changes of ladder rows over draws of scenes, and everything as markdown tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks.blind_guesses import Comparison
from vggtjax.research.evaluation.ladder import LadderRow
from vggtjax.storage.markdown import markdown_table

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
FIRST = "vggt"  # the plain pass
# compared with the plain pass
AGAINST_FIRST = ("abs_rel", "rotation_error", "centre_error", "point_distance", "point_distance_first")

_SETTING = ("method", "mask", "pairs", "suppress")  # columns
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

    def text(self, digits: int = 3) -> str:
        return f"{self.mean:.{digits}f}" + ("" if self.deviation is None else f" ± {self.deviation:.{digits}f}")


@dataclass(frozen=True)
class Change:
    """A metric of one setting against the plain pass, on the clips where both have one."""

    mean: float  # over all clips
    error: float | None  # standard error over clips; None for a single clip
    plain: float  # mean of the plain pass
    better: int  # draws whose mean is lower than the plain pass's
    best: int  # draws in which neither the plain pass nor a method with the same mask, pairs and suppression has less
    draws: int

    @property
    def share(self) -> float | None:
        """The mean as a share of the plain pass's; None where that is 0."""
        return self.mean / self.plain if self.plain > 0 else None

    def text(self, digits: int) -> str:
        spread = "" if self.error is None else f" ± {self.error:.{digits}f}"
        share = "" if self.share is None else f" ({100 * self.share:+z.1f} %)"
        return f"{self.mean:+z.{digits}f}{spread}{share}; {self.better}/{self.draws}, {self.best}/{self.draws}"


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
    changes: dict[str, Change]  # none for the plain pass


def spread(values: Sequence[float]) -> Spread:
    """Return mean and sample standard deviation of one number per seed."""
    return Spread(float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None)


def summarise(by_seed: Sequence[Sequence[LadderRow]], compared: Sequence[str] = AGAINST_FIRST) -> list[Summary]:
    """Summarise the ladder's rows of several seeds, setting by setting, in the order of the first seed.

    Args:
        by_seed: rows of each seed.
        compared: fields of `LadderRow` whose changes against the plain pass are wanted.
    """
    found = []
    for setting in dict.fromkeys(_setting(row) for rows in by_seed for row in rows):
        draws = [draw for rows in by_seed if (draw := _draw(rows, setting)).rows]
        scores = {name: [_mean(draw.rows, name) for draw in draws] for name in METRICS}
        ratios = {name: [_ratio(draw, name) for draw in draws] for name in compared}
        changes = {name: _change(draws, name) for name in compared if setting[0] != FIRST}
        found.append(
            Summary(
                *setting,
                clips=sum(len(draw.rows) for draw in draws),
                failed=sum(bool(row.failure) for draw in draws for row in draw.rows),
                scores=_spreads(scores),
                ratios=_spreads(ratios),
                changes={name: change for name, change in changes.items() if change},
            )
        )
    return found


def saliency_auc(by_seed: Sequence[Sequence[LadderRow]]) -> Spread | None:
    """Return the first pass's saliency AUC, clip by clip and seed by seed; None where no clip has one."""
    plain = [[row for row in rows if row.method == FIRST] for rows in by_seed]
    means = [_mean(rows, "saliency_auc") for rows in plain]
    return spread(there) if (there := [mean for mean in means if mean is not None]) else None


def comparison_table(comparisons: Sequence[Comparison]) -> str:
    """Return a markdown table of a model against the blind guesses."""
    rows = [
        [
            METRICS[c.metric],
            _GUESSES[c.guess],
            *(_number(value, _digits(c.metric)) for value in (c.model_error, c.guess_error)),
            _number(c.ratio, 2),
            f"{c.threshold}",
            "pass" if c.passed else "FAIL",
            f"{100 * c.better:.0f} %",
            f"{c.clips}" + (f", {c.failed} failed" if c.failed else ""),
        ]
        for c in comparisons
    ]
    header = ["metric", "guess", "model's error", "guess's error", "ratio", "threshold", "", "model better", "clips"]
    return markdown_table(header, rows)


def ladder_table(summaries: Sequence[Summary]) -> str:
    """Return a markdown table of the ladder: mean ± standard deviation between draws."""
    rows = [
        [
            *_named(s),
            *(s.scores[name].text(_digits(name)) if name in s.scores else "-" for name in METRICS),
            f"{s.clips}" + (f", {s.failed} failed" if s.failed else ""),
        ]
        for s in summaries
    ]
    return markdown_table([*_SETTING, *METRICS.values(), "clips"], rows)


def changes_table(summaries: Sequence[Summary]) -> str:
    """Return a markdown table of what the methods change: mean ± standard error over clips, share, numbers of draws."""
    rows = [
        [
            *_named(s),
            *(s.changes[name].text(_digits(name) + 1) if name in s.changes else "-" for name in AGAINST_FIRST),
        ]
        for s in summaries
        if s.changes
    ]
    return markdown_table([*_SETTING, *(METRICS[name] for name in AGAINST_FIRST)], rows)


class _Draw(NamedTuple):
    """Rows of one draw of scenes."""

    rows: list[LadderRow]  # of one setting
    plain: list[LadderRow]  # of the plain pass
    rivals: list[list[LadderRow]]  # of every method with the setting's mask, pairs and suppression


def _draw(rows: Sequence[LadderRow], setting: tuple[str, str | None, int | None, str | None]) -> _Draw:
    alike = [row for row in rows if _setting(row)[1:] == setting[1:]]
    rivals = [[row for row in alike if row.method == method] for method in dict.fromkeys(row.method for row in alike)]
    own = [row for row in alike if row.method == setting[0]]
    return _Draw(own, [row for row in rows if row.method == FIRST], rivals)


def _setting(row: LadderRow) -> tuple[str, str | None, int | None, str | None]:
    return row.method, row.mask_source, row.mask_pairs, row.suppress


def _named(summary: Summary) -> list[str]:
    fields = summary.method, summary.mask_source, summary.mask_pairs, summary.suppress
    return ["-" if value is None else str(value) for value in fields]


def _mean(rows: Sequence[LadderRow], name: str) -> float | None:
    values = [value for row in rows if (value := getattr(row, name)) is not None]
    return float(np.mean(values)) if values else None


def _both(draw: _Draw, name: str) -> Float[np.ndarray, "N 2"]:
    """Return a metric of a setting and of the plain pass, on the clips where both have one."""
    first = {row.clip: getattr(row, name) for row in draw.plain}
    pairs = [(getattr(row, name), first.get(row.clip)) for row in draw.rows]
    return np.array([pair for pair in pairs if None not in pair], float).reshape(-1, 2)


def _ratio(draw: _Draw, name: str) -> float | None:
    """Return the mean error relative to the plain pass, on the clips where both have one."""
    ours, theirs = _both(draw, name).sum(axis=0)
    return float(ours / theirs) if theirs > 0 else None


def _change(draws: Sequence[_Draw], name: str) -> Change | None:
    every = np.concatenate([_both(draw, name) for draw in draws])
    if not len(every):
        return None
    better = sum(len(both := _both(draw, name)) > 0 and bool(np.diff(both.mean(axis=0)) > 0) for draw in draws)
    best = sum(_is_best(draw, name) for draw in draws)
    difference, plain = every[:, 0] - every[:, 1], float(every[:, 1].mean())
    mean = float(difference.mean())
    error = float(difference.std(ddof=1) / len(difference) ** 0.5) if len(difference) > 1 else None
    return Change(mean, error, plain, better, best, len(draws))


def _is_best(draw: _Draw, name: str) -> bool:
    """Return whether neither the plain pass nor a rival has a lower mean, on the clips where all have one."""
    values = [{row.clip: getattr(row, name) for row in rows} for rows in (draw.rows, draw.plain, *draw.rivals)]
    common = [clip for clip in values[0] if None not in [column.get(clip) for column in values]]
    own, *others = (sum(column[clip] for clip in common) for column in values)
    return bool(common) and own <= min(others)


def _spreads(values: dict[str, list[float | None]]) -> dict[str, Spread]:
    there = {name: [value for value in column if value is not None] for name, column in values.items()}
    return {name: spread(column) for name, column in there.items() if column}


def _digits(name: str) -> int:
    """Return a metric's decimals in tables; changes have one more."""
    return {"rotation_error": 2, "centre_error_ratio": 4}.get(name, 3)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
