"""Evaluate methods, or results of other programs, on sequences; what is finished is kept and not done again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, NamedTuple

from vggtjax.errors import VggtjaxError
from vggtjax.evaluation.datasets.sequence import Sequence as Clip
from vggtjax.evaluation.protocol import TruthAtPixels, score
from vggtjax.evaluation.records import Record, Records
from vggtjax.evaluation.video_depth import Align
from vggtjax.results.reconstruction import Reconstruction

OnStage = Callable[[str], AbstractContextManager[Any]]
Reconstructor = Callable[[Clip, Sequence[str], OnStage], Mapping[str, Reconstruction]]  # by method


class Scoring(NamedTuple):
    """How a result is scored; see `score`."""

    depth_align: Align = "scale"
    max_depth: float | None = None


DEFAULT = Scoring()


def evaluate(
    sequences: Sequence[Clip],
    methods: Sequence[str],
    reconstruct: Reconstructor,
    records: Records,
    settings: Mapping[str, Any],
    *,
    scoring: Scoring = DEFAULT,
    on_stage: OnStage,
) -> list[Record]:
    """Score methods on sequences.

    Args:
        sequences: of a data set.
        methods: names that `reconstruct` knows.
        reconstruct: returns the results of some methods on a sequence.
        records: where finished ones are looked for, and kept.
        settings: everything that the numbers depend on; records made with others are not taken for finished.
        scoring: how results are scored.
        on_stage: called with the name of each stage, returns a context in which it runs.

    Returns:
        A record for each sequence and method, in this order; one that failed says why.
    """
    found: list[Record] = []
    for number, sequence in enumerate(sequences):
        kept = {method: records.kept(sequence.name, method, settings) for method in methods}
        missing = [method for method in methods if kept[method] is None]
        if missing:
            with on_stage(f"{number + 1}/{len(sequences)} {sequence.name}") as progress:
                new = list(_evaluated(sequence, missing, reconstruct, records, settings, scoring, progress))
            kept |= {record.method: record for record in new}
        found += [record for record in kept.values() if record is not None]
    return found


def _evaluated(
    sequence: Clip,
    methods: Sequence[str],
    reconstruct: Reconstructor,
    records: Records,
    settings: Mapping[str, Any],
    scoring: Scoring,
    progress: Callable[[int, int | None], object] | None,
) -> Iterator[Record]:
    seconds: dict[str, float] = {}

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield None
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - started

    common: dict[str, Any] = {"name": sequence.name, "settings": dict(settings), "frames": len(sequence)}
    try:
        results = reconstruct(sequence, methods, timed)
    except (VggtjaxError, MemoryError) as error:
        for method in methods:
            failed = Record(method=method, status="failed", reason=str(error) or "out of memory", **common)
            records.keep(failed, {})
            yield failed
        return
    truth: TruthAtPixels | None = None
    for number, method in enumerate(methods):
        try:
            truth = truth or TruthAtPixels(sequence, results[method])
            scores = score(results[method], truth, **scoring._asdict())
        except (VggtjaxError, MemoryError) as error:
            record, curves = Record(method=method, status="failed", reason=str(error) or "out of memory", **common), {}
        else:
            notes = (*sequence.notes, *scores.notes)
            record = Record(method=method, status="ok", metrics=scores.metrics, notes=notes, seconds=seconds, **common)
            curves = scores.curves
        records.keep(record, curves)
        if progress is not None:
            progress(number + 1, len(methods))
        yield record
