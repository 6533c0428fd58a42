"""Evaluate methods, or results of other programs, on sequences; records of an earlier run are not computed again."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vggtjax.clips.captures.capture import OtherShapeError
from vggtjax.errors import VggtjaxError, one_line, reading
from vggtjax.progress import OnStage, StageSeconds, no_progress
from vggtjax.research.evaluation.datasets.sequence import LabelledSequence, LeftOut, left_out
from vggtjax.research.evaluation.metrics.camera_pairs import Pairs
from vggtjax.research.evaluation.metrics.depth import Align
from vggtjax.research.evaluation.metrics.masks import Empty
from vggtjax.research.evaluation.protocol import score
from vggtjax.research.evaluation.records import Record, Records, shown_name
from vggtjax.research.evaluation.sources import ResultSource
from vggtjax.research.evaluation.truth_at_pixels import TruthAtPixels
from vggtjax.results.reconstruction import Reconstruction

_SAMPLES = 3  # frames whose depth and mask are in the fingerprint of a sequence
_MOST_LETTERS = 1000  # of a reason or a note

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Scoring:
    """How results are scored; see `score` and `TruthAtPixels`."""

    depth_align: Align = "scale"
    max_depth: float | None = None
    empty: Empty = "davis"
    pairs: Pairs = "vggt"
    strict: bool = False  # refuse a sequence of which a frame lacks something, rather than score the others


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
    scored: list[Record] = []
    for number, (key, opener) in enumerate(sequences.items(), start=1):
        title = shown_name(key)
        with on_stage(f"{number}/{len(sequences)} {title}") as progress:
            drafts = {name: Record(title, name, "failed", dict(settings)) for name in source.names}
            try:
                sequence = opener()
                facts = {"notes": _lines(sequence.notes), "frames": len(sequence)}
                facts["left_out"] = _left_out(sequence.left_out)
                data = fingerprint(sequence)
                for name in drafts:
                    own = {**settings, "data": data, "result": source.fingerprint(name, sequence)}
                    drafts[name] = Record(title, name, "failed", own, **facts)
            except Exception as error:
                failures = [replace(draft, reason=_reason(error)) for draft in drafts.values()]
                for failure in failures:
                    records.keep(failure, {})
                scored += failures
                continue
            kept = {name: records.kept(title, name, draft.settings) for name, draft in drafts.items()}
            missing = {name: drafts[name] for name, record in kept.items() if record is None}
            for record, curves in _computed(missing, sequence, source, scoring):
                records.keep(record, curves)
                kept[record.method] = record
                (progress or no_progress)(sum(each is not None for each in kept.values()), len(kept))
            scored += [record for record in kept.values() if record is not None]
    return scored


def _computed(
    drafts: Mapping[str, Record], sequence: LabelledSequence, source: ResultSource, scoring: Scoring
) -> Iterator[tuple[Record, dict[str, np.ndarray]]]:
    """Yield the scored results of a sequence with their curves, computed group by group."""
    truth = None
    for group in source.groups:
        names = [name for name in group if name in drafts]
        timed = StageSeconds()
        results: Mapping[str, Reconstruction] = {}
        problem = None
        try:
            results = source.results(names, sequence, timed.stage) if names else {}
        except Exception as error:
            problem = error
        for name in names:
            try:
                if problem is not None:
                    raise problem
                result = results[name]
                own, lacking = _matched(sequence, result)
                if truth is None or truth.sequence is not own or not truth.fits(result):  # results with one share it
                    truth = TruthAtPixels(own, result, max_depth=scoring.max_depth, strict=scoring.strict)
                scores = score(result, truth, depth_align=scoring.depth_align, empty=scoring.empty, pairs=scoring.pairs)
                lacking += tuple(truth.left_out.values())
                said = tuple(f"{name} of {sequence.name}: {each.sentence}" for each in lacking)
                sizes = tuple(f"{sequence.name}: {note}" for note in sequence.resized)
                problems = scores.problems
                if not scores.metrics and not problems:
                    problems = (f"nothing is left to score: {'; '.join((*said, *scores.notes))}",)
            except Exception as error:
                yield replace(drafts[name], reason=_reason(error)), {}
                continue
            record = replace(
                drafts[name],
                status="failed" if problems else "ok",
                metrics=scores.metrics,
                notes=drafts[name].notes + _lines((*sizes, *said, *scores.notes)),
                reason=one_line("; ".join(problems), _MOST_LETTERS),
                frames=len(own),
                left_out=drafts[name].left_out | _left_out(lacking),
                seconds=timed.seconds,
            )
            yield record, scores.curves


def _matched(sequence: LabelledSequence, result: Reconstruction) -> tuple[LabelledSequence, tuple[LeftOut, ...]]:
    """Return the frames of a sequence that a result has, by their names, and the frames that it lacks."""
    if len(result.depth) == len(sequence):
        return sequence, ()
    places = {name: place for place, name in enumerate(sequence.frame_names)}
    there = set(result.frame_names)
    lacking = [name for name in sequence.frame_names if name not in there]
    matched = sequence.of_frames([places[name] for name in result.frame_names])
    return matched, left_out("results", lacking, len(sequence), "have no result")


def _left_out(lacking: Sequence[LeftOut]) -> dict[str, dict[str, Any]]:
    return {each.what: each.to_json() for each in lacking}


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
                try:
                    values = read(frame)
                except OtherShapeError as error:  # that frame is left out, or refused, when it is scored
                    digest.update(str(error).encode())
                else:
                    digest.update(b"-" if values is None else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()
