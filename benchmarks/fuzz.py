"""Structural mutations of every file that strangers may give: python -m benchmarks fuzz.

The readers, their samples and the mutations are those of tests/fuzz.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from benchmarks.suite.report import write_json
from vggtjax.errors import InputError, one_line

if TYPE_CHECKING:
    from tests.fuzz.cases import Reader

_SILENCE = 60.0  # seconds without a word after which a process hangs where no signal reaches it


@dataclass
class Row:
    """What the cases of one reader came to."""

    reader: str
    cases: int = 0
    accepted: int = 0
    refused: int = 0
    found: dict[int, str] = field(default_factory=dict)  # seed -> what happened
    seconds: float = 0.0  # in the reader
    slowest: float = 0.0


def fuzz(
    *,
    minutes: float = 60.0,
    cases: int = 2000,
    reader: tuple[str, ...] = (),
    seed: int = 0,
    keep: Path | None = None,
    out: Path | None = None,
) -> None:
    """Read mutated files until each reader had its cases or the time is over; list what is no answer in a sentence.

    Each reader runs in a process of its own, with a limit of address space. A case is found, a defect, if anything but
    an exception of the library escapes, if its message is not one printable line below 500 letters, if it takes more
    than 10 s or more than twice the memory of the valid file, or if the process ends.

    Args:
        minutes: after which no further case begins.
        cases: of each reader.
        reader: names of readers, or how they begin; all by default.
        seed: of the first case; the others follow.
        keep: folder for the files of found cases, as tests/fuzz/corpus takes them.
        out: JSON file for the rows of the table.
    """
    from tests.fuzz.readers import READERS
    from tests.fuzz.test_readers import slug

    chosen = [known for known in READERS if not reader or known.name.startswith(reader)]
    if not chosen:
        listed = ", ".join(known.name for known in READERS)
        raise InputError(f"reader is {one_line(str(reader), 80)}; expected the beginning of one of {listed}")
    if cases < 1 or not minutes > 0:
        raise InputError(f"cases is {cases} and minutes is {minutes}; expected at least 1, and more than 0")
    end = time.monotonic() + 60 * minutes
    console, rows = Console(), []
    for one in chosen:
        row = Row(one.name)
        rows.append(row)
        place = None if keep is None else keep / slug(one.name)
        while row.cases < cases and time.monotonic() < end:
            _run(row, one, seed + row.cases, cases - row.cases, place, end)
        for number, words in row.found.items():
            console.print(f"{one.name} {number}: {words}", markup=False, soft_wrap=True)
        if out is not None:
            write_json(out, {"rows": [asdict(row) for row in rows]})
    table = Table("reader", "cases", "accepted", "refused", "found", "seconds", "slowest")
    for row in rows:
        numbers = (row.cases, row.accepted, row.refused, len(row.found), round(row.seconds), f"{row.slowest:.2f}")
        table.add_row(row.reader, *map(str, numbers))
    console.print(table)


def _run(row: Row, reader: Reader, first: int, count: int, keep: Path | None, end: float) -> None:
    """Run cases in one process, until they are done, it ends or the time is over; add them to the row."""
    from tests.fuzz.child import running

    current = None
    with running(reader, first, count, keep) as reports:
        for _ in range(2 * count):
            try:
                if not reports.poll(_SILENCE):
                    ended = f"hangs for {_SILENCE:.0f} s"
                    break
                seed, outcome = reports.recv()
            except EOFError:
                ended = "the process ends"
                break
            if outcome is None:
                current = seed
                if time.monotonic() > end:
                    return
                continue
            current = None
            row.cases += 1
            row.seconds += outcome.seconds
            row.slowest = max(row.slowest, outcome.seconds)
            if outcome.kind == "found":
                row.found[seed] = outcome.words
            else:
                setattr(row, outcome.kind, getattr(row, outcome.kind) + 1)
        else:
            return
    if current is None:
        raise InputError(f"the cases of {reader.name} did not begin: {ended}; is its valid sample read?")
    row.found[current] = ended
    row.cases += 1
