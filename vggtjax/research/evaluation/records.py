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

from vggtjax.errors import InputError, OutputError, ResultError, one_line
from vggtjax.options import METHODS
from vggtjax.storage.arrays import read_arrays, write_arrays
from vggtjax.storage.json_values import Natural, read_json
from vggtjax.storage.writing import remove_leftovers, writing

FOLDER = "sequences"
BOTH_OVER_ONE = "both passes over one"
_MARK = "evaluation.json"  # marks a folder of records
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
    frames: Natural = 0  # that are scored
    left_out: dict[str, dict[str, Any]] = field(default_factory=dict)  # by what they lack: counts, the first names
    seconds: dict[str, float] = field(default_factory=dict)  # of the stages of its group of methods


class Records:
    """The records in an output folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / FOLDER

    def exists(self) -> bool:
        """Return whether the folder has records of an evaluation."""
        return (self.folder / _MARK).is_file()

    def begin(self) -> None:
        """Make the folder, with a file that marks it as a folder of records; remove what killed runs left in it."""
        try:
            if not self.folder.exists():
                with writing(self.folder) as folder:  # a run that is killed here leaves no folder without a mark
                    folder.mkdir()
                    _mark(folder / _MARK)
            elif not self.exists():
                with writing(self.folder / _MARK) as path:
                    _mark(path)
        except OutputError:
            if not self.exists():  # else another run has made it meanwhile
                raise
        for folder in (self.folder, *self.folder.iterdir()):  # a kept record is not written again, nor is its folder
            if folder.is_dir() and not folder.is_symlink():
                remove_leftovers(folder)

    def kept(self, name: str, method: str, settings: Mapping[str, Any]) -> Record | None:
        """Return the record of an earlier successful run with equal settings; None if there is no such record."""
        try:
            record = read_json(self._path(name, method, "json"), Record, "record")
            self.curves(record)
        except InputError:  # missing, cut off, or of another version
            return None
        good = record.status == "ok" and record.name == name
        return record if good and record.settings == json.loads(json.dumps(settings)) else None

    def keep(self, record: Record, curves: Mapping[str, np.ndarray]) -> None:
        """Write a record; its JSON file is removed first and written last, so a JSON file means a whole record."""
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


def _mark(path: Path) -> None:
    path.write_text('{"format": "records of vggtjax evaluate"}\n', encoding="utf-8")


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
    """Return the means of every method over its successful sequences with ground truth for the metric.

    Sequences weigh the same, as in the protocols; video depth weighs them by valid pixels. `sequences` and `failed` are
    the numbers of successful and failed sequences.
    """
    means: dict[str, dict[str, float]] = {}
    for method in dict.fromkeys(record.method for record in records):
        own = [record for record in records if record.method == method]
        good = [record for record in own if record.status == "ok"]
        means[method] = {"sequences": len(good), "failed": len(own) - len(good)}
        metrics = dict.fromkeys(metric for record in good for metric in record.metrics if metric not in _WEIGHTS)
        for metric in metrics:
            weights = [r.metrics.get("depth_pixels", 1.0) if metric in _VIDEO_DEPTH else 1.0 for r in good]
            means[method][metric] = _mean(good, metric, weights)
        for metric, pooled in _POOLED.items():
            if metric in metrics:
                means[method][pooled] = _mean(
                    good, metric, [record.metrics.get("mask_frames", record.frames) for record in good]
                )
    return means


_WEIGHTS = ("depth_pixels", "mask_frames")
_VIDEO_DEPTH = ("abs_rel", "rmse", "delta1", "delta2", "delta3")
_SECOND = ("dynamic mask", "second pass")  # stages
_POOLED = {"j_mean": "j_pooled", "f_mean": "f_pooled"}  # metric -> its mean over the frames of all sequences


def _mean(records: Sequence[Record], metric: str, weights: Sequence[float]) -> float:
    values = [(r.metrics[metric], weight) for r, weight in zip(records, weights, strict=True) if metric in r.metrics]
    return math.fsum(v * w for v, w in values) / math.fsum(w for _, w in values)


def costs(records: Sequence[Record]) -> dict[str, dict[str, float]]:
    """Return the mean seconds of each stage by method; stages that methods share count for each that needs them.

    `both passes over one` is the time of image features and both passes over the time of features and first pass.
    """
    means: dict[str, dict[str, float]] = {}
    for method in dict.fromkeys(record.method for record in records):
        own = [record.seconds for record in records if record.method == method and record.seconds]
        row = METHODS.get(method)
        needless = _SECOND if row is not None and not row.needs_second_pass else ()
        stages = dict.fromkeys(stage for seconds in own for stage in seconds if stage not in needless)
        mean = {stage: float(np.mean([seconds.get(stage, 0.0) for seconds in own])) for stage in stages}
        one = mean.get("image features", 0.0) + mean.get("first pass", 0.0)
        if one and "second pass" in mean:
            mean[BOTH_OVER_ONE] = (one + mean["second pass"]) / one
        if mean:
            means[method] = mean
    return means
