"""CSV files of strangers: bounded in size, with a line number for each row. Does not import jax."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

from vggtjax.errors import InputError, reading


class CsvRows(NamedTuple):
    """The names in the first line of a CSV file, and each further row by these names, with its line."""

    columns: tuple[str, ...]
    rows: list[tuple[int, dict[str, str]]]  # lines count from 1; a value that a short row lacks is None


def read_csv(path: Path, *, most_bytes: int, error: type[InputError] = InputError) -> CsvRows:
    """Read a CSV file with names in the first line; raises `error` for an unreadable, a larger or another file."""
    try:
        with reading(path, error), path.open(encoding="utf-8-sig", newline="") as file:
            if (size := path.stat().st_size) > most_bytes:
                raise error(f"{path} is {size} bytes; expected at most {most_bytes}")
            reader = csv.DictReader(file)
            return CsvRows(tuple(reader.fieldnames or ()), [(reader.line_num, row) for row in reader])
    except (UnicodeDecodeError, csv.Error) as problem:
        raise error(f"{path} is no CSV file: {problem}") from None
