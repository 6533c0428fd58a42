"""Evaluate methods, or results of other programs, on sequences; records of an earlier run are not computed again."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vggtjax.errors import VggtjaxError, one_line, reading
from vggtjax.evaluation.datasets.sequence import LabelledSequence
from vggtjax.evaluation.metrics.masks import Empty
from vggtjax.evaluation.metrics.video_depth import Align
from vggtjax.evaluation.protocol import score
from vggtjax.evaluation.records import Record, Records, shown_name
from vggtjax.evaluation.sources import ResultSource
from vggtjax.evaluation.truth_at_pixels import TruthAtPixels
from vggtjax.progress import OnStage, Progress, no_progress
from vggtjax.reconstruction import Reconstruction

_SAMPLES = 3  # frames whose depth and mask are in the fingerprint of a sequence
_MOST_LETTERS = 1000  # of a reason or a note
_STEPS = 100  # of a progress bar for each result

logger = logging.getLogger(__name__)


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
    """Score results on sequences; results of an earlier run with the same settings are not computed again.

    Args:
        sequences: openers of a data set's sequences by name; each is called when its turn comes.
        source: where the results come from.
        records: where the records of earlier runs are, and new ones are written.
        settings: everything that the numbers depend on but the sequence and the result; fingerprints of these two are
            added to the settings of each record.
        scoring: how results are scored.
        on_stage: called with the number and name of each sequence.

    Returns:
        A record for each sequence and name of a result, in this order. Where opening, computing or
        scoring raises any exception, the records have the status "failed" and a reason.
    """
    evaluation = _Evaluation(source, records, settings, scoring)
    scored: list[Record] = []
    for number, (name, opener) in enumerate(sequences.items()):
        title = shown_name(name)
        with on_stage(f"{number + 1}/{len(sequences)} {title}") as progress:
            scored += evaluation.records_of(title, opener, progress)
    return scored


@dataclass(frozen=True)
class _Evaluation:
    source: ResultSource
    store: Records
    settings: Mapping[str, Any]
    scoring: Scoring

    def records_of(self, title: str, opener: Callable[[], LabelledSequence], progress: Progress | None) -> list[Record]:
        """Return the records of a sequence, computed or kept, in the order of the source's names."""
        names = self.source.names
        drafts = {name: Record(title, name, "failed", dict(self.settings)) for name in names}
        try:
            sequence = opener()
            facts = {"notes": _lines(sequence.notes), "frames": len(sequence)}
            data = fingerprint(sequence)
            for name in names:
                settings = {**self.settings, "data": data, "result": self.source.fingerprint(name, sequence)}
                drafts[name] = Record(title, name, "failed", settings, **facts)
        except Exception as error:
            failures = [replace(draft, reason=_reason(error)) for draft in drafts.values()]
            for failure in failures:
                self.store.keep(failure, {})
            return failures
        records = {name: self.store.kept(title, name, drafts[name].settings) for name in names}
        groups = [[drafts[name] for name in group if records[name] is None] for group in self.source.groups]
        truths = _Truths(sequence, self.scoring.max_depth)
        steps = _Steps(progress, sum(map(len, groups)))
        for group in filter(None, groups):
            records |= {record.method: record for record in self._scored(group, sequence, truths, steps)}
        return [record for record in records.values() if record is not None]

    def _scored(
        self, drafts: Sequence[Record], sequence: LabelledSequence, truths: _Truths, steps: _Steps
    ) -> Iterator[Record]:
        """Compute the results of a group, score them, and write their records."""
        seconds: dict[str, float] = {}

        @contextmanager
        def timed(name: str) -> Iterator[None]:
            started = time.perf_counter()
            yield None
            seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - started

        results: Mapping[str, Reconstruction] = {}
        problem = None
        try:
            results = self.source.results([draft.method for draft in drafts], sequence, timed)
        except Exception as error:
            problem = error
        for draft in drafts:
            curves: dict[str, np.ndarray] = {}
            try:
                if problem is not None:
                    raise problem
                result = results[draft.method]
                align, empty = self.scoring.depth_align, self.scoring.empty
                scores = score(result, truths.at(result), depth_align=align, empty=empty, progress=steps.within)
            except Exception as error:
                record = replace(draft, reason=_reason(error))
            else:
                record = replace(
                    draft,
                    status="failed" if scores.problems else "ok",
                    metrics=scores.metrics,
                    notes=draft.notes + _lines(scores.notes),
                    reason=one_line("; ".join(scores.problems), _MOST_LETTERS),
                    seconds=seconds,
                )
                curves = scores.curves
            self.store.keep(record, curves)
            steps.next()
            yield record


def _reason(error: Exception) -> str:
    """Return why a sequence failed, as one line."""
    if isinstance(error, VggtjaxError | MemoryError):
        return one_line(str(error) or "out of memory", _MOST_LETTERS)
    logger.error("a sequence failed by an error of the program; report it with these lines", exc_info=error)
    return one_line(f"{type(error).__name__}: {error}", _MOST_LETTERS)


def _lines(notes: Sequence[str]) -> tuple[str, ...]:
    return tuple(one_line(note, _MOST_LETTERS) for note in notes)


def fingerprint(sequence: LabelledSequence) -> str:
    """Return a digest of a sequence: names, sizes and dates of its pictures, its cameras, three depth maps and masks.

    Raises InputError where a picture or a file of the ground truth is missing.
    """
    digest = hashlib.sha256()
    for path in sequence.pictures:
        with reading(path):
            stat = path.stat()
        digest.update(f"{path} {stat.st_size} {stat.st_mtime_ns}\n".encode("utf-8", "surrogateescape"))
    for array in (sequence.world_from_camera, sequence.intrinsics, sequence.timestamps):
        digest.update(b"-" if array is None else np.ascontiguousarray(array, np.float64).tobytes())
    frames = np.unique(np.linspace(0, len(sequence) - 1, _SAMPLES).round().astype(int)).tolist()
    for read in (sequence.depth, sequence.mask):
        if read is not None:
            for frame in frames:
                digest.update(np.ascontiguousarray(read(frame)).tobytes())
    return digest.hexdigest()


class _Truths:
    """The ground truth of one sequence at the pixels of results, read once for all results with the same placement."""

    def __init__(self, sequence: LabelledSequence, max_depth: float | None) -> None:
        self._sequence, self._max_depth = sequence, max_depth
        self._last: TruthAtPixels | None = None

    def at(self, result: Reconstruction) -> TruthAtPixels:
        if self._last is None or not self._last.fits(result):
            self._last = TruthAtPixels(self._sequence, result, max_depth=self._max_depth)
        return self._last


class _Steps:
    """Progress over the results of a sequence."""

    def __init__(self, progress: Progress | None, names: int) -> None:
        self._progress, self._total, self._done = progress, _STEPS * names, 0

    def within(self, done: int, total: int | None) -> None:
        (self._progress or no_progress)(self._done + _STEPS * done // (total or 1), self._total)

    def next(self) -> None:
        self.within(1, 1)
        self._done += _STEPS
