"""The metrics of a training run: averages per interval in metrics.csv, and their curves in metrics.png."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np

from vggtjax.errors import InputError
from vggtjax.storage.csv_file import read_csv
from vggtjax.storage.writing import writing

Row = dict[str, float]

COLUMNS = ("step", "stage", "seconds", "samples")  # of every row, before the metrics; "stage" is the phase
COMPARED = {  # error -> the error of a prediction without motion
    "rotation_error": "rotation_identity",
    "centre_error": "centre_identity",
}

_LABELS = {
    "rotation_error": "rotation error (degrees)",
    "rotation_identity": "identity",
    "centre_error": "centre error",
    "centre_identity": "identity",
}
_OPTIMISATION = ("learning_rate", "grad_norm")
_LOG = ("loss", "error", "probe", "grad_norm", "learning_rate")  # metrics whose names contain these get a log axis
_MOST_BYTES = 1 << 28


@dataclass
class Averages:
    """Means of metrics since the last row: plain numbers that a checkpoint keeps unchanged."""

    sums: dict[str, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    def add(self, metrics: Mapping[str, float], *, finite_only: bool = False) -> None:
        """Add one step's metrics; `finite_only` leaves out the infinite values of a skipped step."""
        for name, value in metrics.items():
            if finite_only and not math.isfinite(value):
                continue
            self.sums[name] = self.sums.get(name, 0.0) + float(value)
            self.counts[name] = self.counts.get(name, 0) + 1

    def take(self) -> Row:
        """Return the means and reset them."""
        row = {name: self.sums[name] / self.counts[name] for name in self.sums}
        self.sums, self.counts = {}, {}
        return row


def write_metrics(path: str | Path, rows: Sequence[Row]) -> None:
    """Write metrics.csv: the columns `COLUMNS`, then the metrics in order of appearance, of which a row may lack some.

    Raises OutputError where the file cannot be written.
    """
    with writing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _header(rows))
        writer.writeheader()
        writer.writerows(rows)


def read_metrics(path: str | Path) -> list[Row]:
    """Read metrics.csv. Raises InputError for an unreadable file or a file of another kind."""
    columns, table = read_csv(Path(path), most_bytes=_MOST_BYTES)
    if columns[: len(COLUMNS)] != COLUMNS:
        raise InputError(f"{path} does not begin with the columns {COLUMNS}; expected the metrics of a training run")
    rows: list[Row] = []
    for number, cells in table:
        try:
            row = {name: float(cell) for name, cell in cells.items() if cell}
            row |= {name: int(row[name]) for name in ("step", "stage", "samples")}
        except (ValueError, KeyError, OverflowError, TypeError):
            raise InputError(f"{path} has a line {number} that is not a row of numbers") from None
        rows.append(row)
    return rows


def plot(rows: Sequence[Row], picture: str | Path) -> None:
    """Draw the curves of a run's metrics as a PNG: losses, errors compared with no motion, other metrics.

    Raises OutputError where the picture cannot be written.
    """
    from matplotlib.figure import Figure

    steps = np.array([row["step"] for row in rows])
    panels = _panels([name for name in _header(rows) if name not in COLUMNS])
    columns = min(3, max(len(panels), 1))
    height = -(-max(len(panels), 1) // columns)
    figure = Figure(figsize=(5 * columns, 3.4 * height), layout="constrained")
    for index, (title, names) in enumerate(panels.items()):
        axes = figure.add_subplot(height, columns, index + 1)
        for name in names:
            values = np.array([row.get(name, math.nan) for row in rows])
            known = np.isfinite(values)
            axes.plot(
                steps[known],
                values[known],
                "--" if name in COMPARED.values() else "-",
                label=_LABELS.get(name, name),
                marker="." if known.sum() < 3 else None,
            )
        if axes.dataLim.ymin > 0 and any(part in names[0] for part in _LOG):
            axes.set_yscale("log")
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("step")
        axes.grid(visible=True, which="both", alpha=0.25)
        if len(names) > 1:
            axes.legend(fontsize=7)
    with writing(picture) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def _panels(names: Sequence[str]) -> dict[str, list[str]]:
    """Group metrics: losses, each error with its comparison, probes; every other metric is alone."""
    groups = {"losses": [name for name in names if "loss" in name]}
    for pair in COMPARED.items():
        groups[f"{_LABELS[pair[0]]}, compared with no motion"] = [name for name in pair if name in names]
    groups["probes"] = [name for name in names if name.startswith("probe_")]
    grouped = {name for group in groups.values() for name in group}
    alone = [name for name in names if name not in grouped | {*_OPTIMISATION}]
    groups |= {name.replace("_", " "): [name] for name in (*alone, *_OPTIMISATION) if name in names}
    return {title: group for title, group in groups.items() if group}


def _header(rows: Sequence[Row]) -> list[str]:
    """Return `COLUMNS`, then the names of the rows' metrics in order of appearance."""
    return list(dict.fromkeys(chain(COLUMNS, *rows)))
