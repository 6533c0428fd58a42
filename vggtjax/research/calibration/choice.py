"""A table of cues for a checkpoint: a greedy choice on half of the clips, confirmed by the other half."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import reduce
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Int8

from vggtjax.config import Cue, Gram, MotionConfig
from vggtjax.errors import InputError
from vggtjax.method.cues import normalise
from vggtjax.progress import Progress, no_progress
from vggtjax.research.calibration.matching import matching_pairs
from vggtjax.research.calibration.sweep import DYNAMIC, GRAMS, KINDS, STATIC, Sweep, token_auc

MAX_TERMS = 5  # as many as VGGT4D's table has
MIN_GAIN = 0.001
_MOST_NEIGHBOURS = 3


class Rating(NamedTuple):
    """Area under the ROC curve on either half of the clips, in [0, 1]."""

    calibration: float
    held_out: float


class Step(NamedTuple):
    """A cue, and the rating of the product of it and the cues before it."""

    cue: Cue
    rating: Rating


class Choice(NamedTuple):
    """A chosen table and its ratings."""

    motion: MotionConfig
    gram: Gram
    steps: tuple[Step, ...]  # one per cue of the table
    refused: Step | None  # the next cue, not worth it on the held-out half
    table: Rating  # of the sweep's own table


def choose(
    sweep: Sweep,
    *,
    gram: Gram = "cosine",
    max_terms: int = MAX_TERMS,
    min_gain: float = MIN_GAIN,
    floor: float = 0.0,
    progress: Progress | None = None,
) -> Choice:
    """Choose cues whose product separates moving from static tokens.

    The first, third, ... clips are the calibration half; the others are held out. Each step adds the map, plain or
    inverted, with the largest area under the ROC curve of the product (as in `GramCues.saliency`) on the calibration
    half, up to `max_terms` of them, while it grows. The held-out half decides how many are kept: those with the largest
    area on it, where each cue has to bring at least `min_gain` on average. A cue that brings little stays if the cues
    after it bring more. The rating on that half is slightly optimistic. Candidates are all maps of one pair, and the
    means over two or three neighbouring pairs. The pairs that match are chosen by `matching_pairs` on all clips.

    Args:
        sweep: result of `sweep`.
        gram: similarity of the table.
        max_terms: largest number of cues.
        min_gain: smallest gain in area on the held-out half for a further cue, on average.
        floor: added to every map, in [0, 1]: see `MotionConfig`.
        progress: called with the number of tried candidates and the largest possible number.

    Raises InputError for a half without moving or without static tokens.
    """
    calibration, held_out = halves(sweep)
    _check_truth("calibration", calibration)
    _check_truth("held-out", held_out)
    pool = candidates(sweep.depth)
    path: list[Step] = []
    while len(path) < max_terms:
        chosen = [step.cue for step in path]
        best_cue, best = None, path[-1].rating.calibration if path else -1.0
        saliency = _product(calibration, gram, chosen, floor)
        for tried, cue in enumerate(pool, 1):
            for inverted in (False, True):
                candidate = dataclasses.replace(cue, inverted=inverted)
                value = _product_auc(saliency * _term(calibration, gram, candidate, floor), calibration.truth)
                if value > best and cue.name not in [other.name for other in chosen]:
                    best_cue, best = candidate, value
            (progress or no_progress)(len(path) * len(pool) + tried, max_terms * len(pool))
        if best_cue is None:
            break
        confirmed = _product_auc(_product(held_out, gram, [*chosen, best_cue], floor), held_out.truth)
        path.append(Step(best_cue, Rating(best, confirmed)))
    worth = [step.rating.held_out - min_gain * count for count, step in enumerate(path)]
    kept = 1 + int(np.argmax(worth))  # of equal ones the fewest cues
    steps, refused = path[:kept], path[kept] if kept < len(path) else None
    cues = tuple(step.cue for step in steps)
    chosen = {"cues": cues, "reference_depth": sweep.depth, "floor": floor}
    motion = dataclasses.replace(sweep.table, **chosen, matching=matching_pairs(sweep.came_back))
    table = Rating(*(token_auc(half.table_saliency[GRAMS.index(gram)], half.truth) for half in (calibration, held_out)))
    return Choice(motion, gram, tuple(steps), refused, table)


def halves(sweep: Sweep) -> tuple[Sweep, Sweep]:
    """Return the calibration half (the first, third, ... clips) and the held-out half."""

    def part(start: int) -> Sweep:
        every_second = slice(start, None, 2)
        return sweep._replace(
            maps=sweep.maps[:, :, :, every_second],
            truth=sweep.truth[every_second],
            table_saliency=sweep.table_saliency[:, every_second],
            came_back=sweep.came_back[:, every_second],
        )

    return part(0), part(1)


def candidates(depth: int) -> tuple[Cue, ...]:
    """Return the candidates, not inverted: every map of one pair, then means over neighbouring pairs."""
    cues = []
    for count, kind in product(range(1, _MOST_NEIGHBOURS + 1), KINDS):
        if count > 1 and kind.statistic != "mean":  # of the averaged Gram map, not an average of maps
            continue
        for first in range(depth - count + 1):
            layers = tuple(range(first, first + count))
            place = f"layer{first}" if count == 1 else f"layers{first}to{layers[-1]}"
            cues.append(dataclasses.replace(kind, name=f"{place}_{kind.name}", layers=layers))
    return tuple(cues)


def _check_truth(name: str, half: Sweep) -> None:
    for kind, value in (("dynamic", DYNAMIC), ("static", STATIC)):
        if not (half.truth == value).any():
            raise InputError(
                f"the {len(half.truth)} clips of the {name} half have no {kind} token; "
                "use clips with moving and static patches"
            )


def _term(sweep: Sweep, gram: Gram, cue: Cue, floor: float) -> Float32[np.ndarray, "N S P"]:
    plain = sweep.map(gram, cue)
    return np.float32(floor) + (1 - plain if cue.inverted else plain)


def _product(sweep: Sweep, gram: Gram, cues: Sequence[Cue], floor: float) -> Float32[np.ndarray, "N S P"]:
    """Return the product of maps, not normalised."""
    terms = (_term(sweep, gram, cue, floor) for cue in cues)
    return reduce(np.multiply, terms, np.ones(sweep.truth.shape, np.float32))


def _product_auc(product: Float32[np.ndarray, "N S P"], truth: Int8[np.ndarray, "N S P"]) -> float:
    return token_auc(np.asarray(normalise(jnp.asarray(product))), truth)
