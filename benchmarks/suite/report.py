"""Rows of measurements: as tables, as JSON, and compared with an earlier run."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.suite.measure import Measured
from benchmarks.suite.work import UNITS, Work, floor_by_kind, flop
from vggtjax.errors import InputError
from vggtjax.storage.markdown import markdown_table
from vggtjax.storage.writing import writing

_MOST_BYTES = 2**24  # read of a stored run
_WIDTH = 150  # of tables, in letters, where the terminal is narrower

Key = tuple[str | int | None, ...]


@dataclass(frozen=True)
class Row:
    """One workload at one shape; None for values on which it does not depend."""

    workload: str
    size: str | None
    frames: int | None
    height: int | None
    width: int | None
    dtype: str
    measured: Measured
    parts: Sequence[Work] = ()  # its work, if known
    rates: Sequence[Mapping[str, float]] = ()  # ceilings around every timed run

    @property
    def key(self) -> Key:
        """The values that rows of two runs must share to be compared."""
        return tuple(getattr(self, name) for name in _KEY)

    @property
    def floors(self) -> list[dict[str, float]]:
        """The floor of every timed run, in seconds by kind of work."""
        return [floor_by_kind(self.parts, rates) for rates in self.rates]

    @property
    def floor(self) -> dict[str, float]:
        """Seconds by kind of work: of each kind, the median of the runs."""
        kinds = dict.fromkeys(kind for floor in self.floors for kind in floor)
        return {kind: float(np.median([floor.get(kind, 0.0) for floor in self.floors])) for kind in kinds}

    @property
    def flop(self) -> float | None:
        return flop(self.parts) or None

    @property
    def floor_seconds(self) -> float | None:
        return float(np.median([sum(floor.values()) for floor in self.floors])) or None if self.rates else None

    @property
    def flop_per_second(self) -> float | None:
        return _over(self.flop, self.measured.median)

    @property
    def share_of_floor(self) -> float | None:
        """Floor over seconds, the median of the runs: 1 if only the counted work takes time."""
        runs = zip(self.floors, self.measured.seconds, strict=True)
        shares = [sum(floor.values()) / seconds for floor, seconds in runs] if self.rates else []
        return float(np.median(shares)) if shares else None


_KEY = ("workload", "size", "frames", "height", "width", "dtype")


class Sheet(NamedTuple):
    """A table of text."""

    title: str
    headings: tuple[str, ...]
    rows: list[tuple[str, ...]]

    def show(self, console: Console) -> None:
        """Print the table without empty columns."""
        columns = [i for i in range(len(self.headings)) if any(row[i] for row in self.rows)]
        table = Table(title=self.title, title_justify="left", box=None, min_width=len(self.title))
        for i in columns:
            table.add_column(self.headings[i], justify="right" if i else "left", no_wrap=True)
        for row in self.rows:
            table.add_row(*(row[i] for i in columns))
        console.print(table)

    def markdown(self) -> str:
        """Return a table of Markdown."""
        return f"{self.title}\n\n{markdown_table(self.headings, self.rows, right=True)}"


def console() -> Console:
    """Return a console wide enough for the tables."""
    terminal = Console()
    return terminal if terminal.width >= _WIDTH else Console(width=_WIDTH)


def machine() -> dict[str, Any]:
    """Return the properties of the machine that figures depend on."""
    device = jax.local_devices()[0]
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "platform": device.platform,
        "device": device.device_kind,
        "jax": jax.__version__,
        "jaxlib": version("jaxlib"),
        "python": platform.python_version(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def describe(machine: dict[str, Any]) -> str:
    """Return a machine as one line."""
    device = " ".join(dict.fromkeys((machine["platform"], machine["device"])))
    return (
        f"{machine['cpu']}, {machine['cores']} cores; {device}; jax {machine['jax']}, "
        f"jaxlib {machine['jaxlib']}, Python {machine['python']}; {machine['date']}"
    )


def ceiling_sheet(title: str, measurements: Mapping[str, Sequence[float]]) -> Sheet:
    """Return a table of the machine's best and median rates over all measurements."""
    rows = [
        (kind, f"{max(rates) / 1e9:.4g}", f"{np.median(rates) / 1e9:.4g}", f"G{UNITS[kind]}/s", str(len(rates)))
        for kind, rates in measurements.items()
    ]
    return Sheet(f"{title}: ceilings", ("kind", "best", "median", "unit", "measurements"), rows)


def row_sheet(title: str, rows: Sequence[Row]) -> Sheet:
    """Return a table of rows."""
    headings = (
        "workload", "frames", "compile s", "median s", "temp MB", "output MB",
        "host MB", "device MB", "GFLOP/s", "floor s", "floor/run",
    )  # fmt: skip
    return Sheet(
        f"{title}; temp and output: memory by XLA's analysis; floor/run: the median run's",
        headings,
        [_cells(row) for row in rows],
    )


def _cells(row: Row) -> tuple[str, ...]:
    m = row.measured
    return (
        row.workload,
        str(row.frames or ""),
        number(m.compile_seconds),
        m.failure or number(m.median),
        *(number(_over(value, 1e6)) for value in (m.temp_bytes, m.output_bytes, m.host_bytes, m.device_bytes)),
        number(_over(row.flop_per_second, 1e9)),
        number(row.floor_seconds),
        "" if row.share_of_floor is None else f"{row.share_of_floor:.0%}",
    )


def comparison_sheet(rows: Sequence[Row], stored: dict[Key, float], path: Path) -> Sheet:
    """Return medians beside the stored ones; a ratio below 1 means faster than the stored run."""
    compared = []
    for row in rows:
        now, then = row.measured.median, stored.get(row.key)
        if now is not None and then is not None:
            pixels = f"{row.width} x {row.height}" if row.width else ""
            names = (row.workload, row.size or "", str(row.frames or ""), pixels)
            compared.append((*names, number(now), number(then), f"{now / then:.3f}"))
    title = f"against {path}: {len(compared)} of {len(rows)} rows are in both"
    return Sheet(title, ("workload", "size", "frames", "pixels", "median s", "stored s", "ratio"), compared)


def write_rows(path: Path, rows: Sequence[Row], **more: Any) -> None:
    """Write a run as JSON: the machine, the rows, and the values of `more`."""

    def plain(row: Row) -> dict[str, Any]:
        values = {name: value for name, value in asdict(row).items() if name not in ("measured", "parts")} | {
            "floor": row.floor
        }
        seconds = row.measured.seconds
        times = {"median": row.measured.median, "min": min(seconds, default=None), "max": max(seconds, default=None)}
        derived = {name: getattr(row, name) for name in ("flop", "floor_seconds", "flop_per_second", "share_of_floor")}
        return values | times | asdict(row.measured) | derived

    values = {"machine": machine(), **more, "rows": [plain(row) for row in rows]}
    with writing(path) as temporary:
        temporary.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def read_stored(path: Path) -> dict[Key, float]:
    """Return the medians of a run that `write_rows` wrote, by row.

    Raises InputError for an invalid file.
    """
    try:
        with path.open("rb") as file:
            rows = json.loads(file.read(_MOST_BYTES))["rows"]
        stored = {tuple(row[name] for name in _KEY): row["median"] for row in rows if row["median"] is not None}
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
    except (ValueError, TypeError, LookupError, RecursionError):
        raise InputError(f"{path} is not a run that --out wrote; expected its JSON, with machine and rows") from None
    if wrong := [value for value in stored.values() if not _is_time(value)]:
        raise InputError(f"{path} has a median of {str(wrong[0])[:40]!r}; expected seconds above 0")
    return stored


def number(value: float | None) -> str:
    """Return a number to three digits; nothing for None."""
    if value is None:
        return ""
    return f"{value:.0f}" if value >= 1000 else f"{value:.3g}"


def _is_time(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < math.inf


def _over(value: float | None, by: float | None) -> float | None:
    return None if value is None or not by else value / by


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
