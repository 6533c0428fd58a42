"""The records of an evaluation, one for each sequence and method: a JSON file of numbers, an npz of curves."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vggtjax.errors import InputError, ResultError, one_line
from vggtjax.storage.arrays import read_arrays, write_arrays
from vggtjax.storage.json_values import Natural, read_json
from vggtjax.storage.writing import writing

FOLDER = "sequences"
BOTH_OVER_ONE = "both passes over one"
_MARK = "evaluation.json"  # in that folder: it holds records
_MOST_LETTERS = 80  # of a name


@dataclass(frozen=True)
class Record:
    """The scores of one method on one sequence, with the settings that they depend on."""

    name: str  # of the sequence
    method: str
    status: Literal["ok", "failed"]
    settings: dict[str, Any]
    metrics: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # what the ground truth lacks, and why a metric is missing
    reason: str = ""  # of a failure
    frames: Natural = 0
    seconds: dict[str, float] = field(default_factory=dict)  # of the stages of its group of methods


class Records:
    """The records in an output folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / FOLDER

    def is_there(self) -> bool:
        """Return whether the folder holds records of an evaluation."""
        return (self.folder / _MARK).is_file()

    def begin(self) -> None:
        """Make the folder, with a mark that it is one of records."""
        with writing(self.folder / _MARK) as path:
            path.write_text('{"format": "records of vggtjax evaluate"}\n', encoding="utf-8")

    def kept(self, name: str, method: str, settings: Mapping[str, Any]) -> Record | None:
        """Return the record of an earlier run, if it succeeded with the very same settings; else None."""
        try:
            record = read_json(self._path(name, method, "json"), Record, "record")
            self.curves(record)
        except InputError:  # missing, cut off, or of another version
            return None
        good = record.status == "ok" and record.name == name
        return record if good and record.settings == json.loads(json.dumps(settings)) else None

    def keep(self, record: Record, curves: Mapping[str, np.ndarray]) -> None:
        """Write a record. Its JSON goes first and comes last: where a JSON file is, the record is whole."""
        path = self._path(record.name, record.method, "json")
        path.unlink(missing_ok=True)
        with writing(path.with_suffix(".npz")) as temporary:
            write_arrays(temporary, curves)
        with writing(path) as temporary:
            temporary.write_text(json.dumps(asdict(record), indent=2) + "\n", encoding="utf-8")

    def curves(self, record: Record) -> dict[str, np.ndarray]:
        """Return the curves of a record; raises ResultError where the file is broken."""
        path = self._path(record.name, record.method, "npz")
        try:
            return read_arrays(path)
        except ResultError as error:
            raise ResultError(f"{path} cannot be read: {error}; delete it and run again") from error

    def _path(self, name: str, method: str, suffix: str) -> Path:
        return self.folder / safe_name(name) / f"{safe_name(method)}.{suffix}"


def shown_name(name: str) -> str:
    """Return a printable name of one line: the name itself if it is one, else with a digest of its bytes."""
    line = one_line(name, _MOST_LETTERS)
    return name if name and line == name else f"{line}-{_digest(name)}"


def safe_name(name: str) -> str:
    """Return a file name: the name itself if only letters, digits, - and _ are in it, else with a digest."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", name)[:_MOST_LETTERS]
    return plain if plain and plain == name else f"{plain}-{_digest(name)}"


def _digest(name: str) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:8]


def summary(records: Sequence[Record]) -> dict[str, dict[str, float]]:
    """Return the means of every method over the sequences that it did not fail on.

    Sequences weigh the same, as the protocols have it, but for video depth, where they weigh as they have valid pixels.
    `sequences` counts them, `failed` the others. A metric's mean is over the sequences that have the ground truth.
    """
    means: dict[str, dict[str, float]] = {}
    for method in dict.fromkeys(record.method for record in records):
        own = [record for record in records if record.method == method]
        good = [record for record in own if record.status == "ok"]
        row: dict[str, float] = {"sequences": len(good), "failed": len(own) - len(good)}
        for metric in dict.fromkeys(metric for record in good for metric in record.metrics):
            if metric == "depth_pixels":
                continue
            values = [(record.metrics[metric], _weight(record, metric)) for record in good if metric in record.metrics]
            row[metric] = math.fsum(v * w for v, w in values) / math.fsum(w for _, w in values)
        for metric, pooled in (("j_mean", "j_pooled"), ("f_mean", "f_pooled")):  # over the frames of all sequences
            values = [(record.metrics[metric], record.frames) for record in good if metric in record.metrics]
            if values:
                row[pooled] = math.fsum(v * w for v, w in values) / sum(w for _, w in values)
        means[method] = row
    return means


VIDEO_DEPTH = ("abs_rel", "rmse", "delta1", "delta2", "delta3")


def _weight(record: Record, metric: str) -> float:
    return record.metrics.get("depth_pixels", 1.0) if metric in VIDEO_DEPTH else 1.0


def costs(records: Sequence[Record]) -> dict[str, dict[str, float]]:
    """Return the mean seconds of each stage by method; what methods share is in the time of each of them.

    `both passes over one` is the time of image features and both passes over that of features and the first one.
    """
    found: dict[str, dict[str, float]] = {}
    for method in dict.fromkeys(record.method for record in records):
        own = [record.seconds for record in records if record.method == method and record.seconds]
        stages = dict.fromkeys(stage for seconds in own for stage in seconds)
        row = {stage: float(np.mean([seconds.get(stage, 0.0) for seconds in own])) for stage in stages}
        one = row.get("image features", 0.0) + row.get("first pass", 0.0)
        if one and "second pass" in row:
            row[BOTH_OVER_ONE] = (one + row["second pass"]) / one
        if row:
            found[method] = row
    return found
