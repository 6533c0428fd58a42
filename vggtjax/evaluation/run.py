"""Evaluate methods, or results of other programs, on sequences; what is finished is kept and not done again."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from vggtjax.errors import InputError, VggtjaxError
from vggtjax.evaluation.datasets.sequence import LabelledSequence
from vggtjax.evaluation.metrics.masks import Empty
from vggtjax.evaluation.metrics.video_depth import Align
from vggtjax.evaluation.protocol import TruthAtPixels, score
from vggtjax.evaluation.records import Record, Records
from vggtjax.evaluation.sources import ResultSource
from vggtjax.progress import OnStage, Progress
from vggtjax.results.reconstruction import Reconstruction

_LOOKED_AT = 3  # frames whose ground truth goes into the fingerprint of a sequence
_STEPS = 100  # of a progress bar, for each method


@dataclass(frozen=True)
class Scoring:
    """How results are scored; see `score` and `TruthAtPixels`."""

    depth_align: Align = "scale"
    max_depth: float | None = None
    empty: Empty = "davis"


def evaluate(
    sequences: Mapping[str, Callable[[], LabelledSequence]],
    source: ResultSource,
    records: Records,
    settings: Mapping[str, Any],
    scoring: Scoring,
    *,
    on_stage: OnStage,
) -> list[Record]:
    """Score results on sequences.

    Args:
        sequences: of a data set, by name; they are opened when it is their turn.
        source: where results come from.
        records: where finished ones are looked for, and kept.
        settings: everything else that the numbers depend on. Records are kept with them and with fingerprints of the
            sequence and of the result; those that were made with others are not taken for finished.
        scoring: how results are scored.
        on_stage: called with the name of each stage, returns a context in which it runs.

    Returns:
        A record for each sequence and name of a result, in this order; one that failed says why.
    """
    found: list[Record] = []
    names = source.names
    for number, (title, opener) in enumerate(sequences.items()):
        with on_stage(f"{number + 1}/{len(sequences)} {title}") as progress:
            try:
                sequence = opener()
                data = fingerprint(sequence)
                facts = {
                    name: {**settings, "data": data, "result": source.fingerprint(name, sequence)} for name in names
                }
            except (VggtjaxError, MemoryError) as error:
                for name in names:
                    found.append(_failed(title, name, settings, error))
                    records.keep(found[-1], {})
                continue
            kept = {name: records.kept(title, name, facts[name]) for name in names}
            truth = _Truths(sequence, scoring.max_depth)
            missing = [[name for name in group if kept[name] is None] for group in source.groups]
            steps = _Steps(progress, sum(map(len, missing)))
            for group in missing:
                for record in _evaluated(group, sequence, source, truth, facts, records, scoring, steps):
                    kept[record.method] = record
            found += [record for record in kept.values() if record is not None]
    return found


def fingerprint(sequence: LabelledSequence) -> str:
    """Return a sum of what a sequence is: its pictures by size and date, its cameras, and some of its depth and masks.

    Raises InputError where a picture is not there, or what the ground truth is read from.
    """
    digest = hashlib.sha256()
    for path in sequence.pictures:
        try:
            stat = path.stat()
        except OSError as error:
            raise InputError(f"{path} cannot be looked at: {error.strerror or error}") from error
        digest.update(f"{path} {stat.st_size} {stat.st_mtime_ns}\n".encode("utf-8", "surrogateescape"))
    for array in (sequence.world_from_camera, sequence.intrinsics, sequence.timestamps):
        digest.update(b"-" if array is None else np.ascontiguousarray(array, np.float64).tobytes())
    frames = np.unique(np.linspace(0, len(sequence) - 1, _LOOKED_AT).round().astype(int)).tolist()
    for read in (sequence.depth, sequence.mask):
        if read is not None:
            for frame in frames:
                digest.update(np.ascontiguousarray(read(frame)).tobytes())
    return digest.hexdigest()


class _Truths:
    """The ground truth of one sequence at the pixels of results, read once for all that are placed alike."""

    def __init__(self, sequence: LabelledSequence, max_depth: float | None) -> None:
        self._sequence, self._max_depth = sequence, max_depth
        self._last: TruthAtPixels | None = None

    def at(self, result: Reconstruction) -> TruthAtPixels:
        if self._last is None or not self._last.fits(result):
            self._last = TruthAtPixels(self._sequence, result, max_depth=self._max_depth)
        return self._last


class _Steps:
    """Progress over the results of a sequence that are to be scored."""

    def __init__(self, progress: Progress | None, names: int) -> None:
        self._progress, self._total, self._done = progress, _STEPS * names, 0

    def within(self, done: int, total: int) -> None:
        if self._progress is not None:
            self._progress(self._done + _STEPS * done // max(total, 1), self._total)

    def next(self) -> None:
        self.within(1, 1)
        self._done += _STEPS


def _evaluated(
    names: Sequence[str],
    sequence: LabelledSequence,
    source: ResultSource,
    truths: _Truths,
    facts: Mapping[str, Mapping[str, Any]],
    records: Records,
    scoring: Scoring,
    steps: _Steps,
) -> Iterator[Record]:
    if not names:
        return
    seconds: dict[str, float] = {}

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield None
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - started

    try:
        made = source.results(names, sequence, timed)
    except (VggtjaxError, MemoryError) as error:
        made, failure = {}, error
    else:
        failure = None
    for name in names:
        curves: dict[str, np.ndarray] = {}
        try:
            if failure is not None:
                raise failure
            scores = score(
                made[name],
                truths.at(made[name]),
                depth_align=scoring.depth_align,
                empty=scoring.empty,
                progress=steps.within,
            )
        except (VggtjaxError, MemoryError) as error:
            record = _failed(sequence.name, name, facts[name], error, sequence)
        else:
            record = Record(
                name=sequence.name,
                method=name,
                status="failed" if scores.problems else "ok",
                settings=dict(facts[name]),
                metrics=scores.metrics,
                notes=(*sequence.notes, *scores.notes),
                reason="; ".join(scores.problems),
                frames=len(sequence),
                seconds=seconds,
            )
            curves = scores.curves
        records.keep(record, curves)
        steps.next()
        yield record


def _failed(
    title: str, name: str, settings: Mapping[str, Any], error: BaseException, sequence: LabelledSequence | None = None
) -> Record:
    return Record(
        name=title,
        method=name,
        status="failed",
        settings=dict(settings),
        notes=() if sequence is None else sequence.notes,
        reason=str(error) or "out of memory",
        frames=0 if sequence is None else len(sequence),
    )
