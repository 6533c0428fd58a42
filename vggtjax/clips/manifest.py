"""A list of clips in a file: CSV, or JSON values a line. Does not import jax."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

from vggtjax.errors import ClipError, one_line, reading
from vggtjax.storage.json_values import parse_json

SUFFIXES = (".csv", ".jsonl")
_MOST_BYTES = 2**28  # about two million clips
_MOST_LETTERS = 4096  # of a path


@dataclass(frozen=True)
class _Row:
    source: str
    name: str | None = None


def is_manifest(path: Path) -> bool:
    """Return whether a path names a file with the suffix of a list of clips."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def read_manifest(path: Path) -> dict[str, Path]:
    """Return the paths of clips by name, in the order of the file.

    A CSV file has a column `source`, and `name` if wanted; a .jsonl file has an object with these keys a line. Other
    columns are not read. Relative paths start at the file's folder; a clip without a name has that of its source.

    Raises ClipError, with the line, for a file that is no such list, two clips of one name, and names that are not
    plain ones.
    """
    rows = _csv_rows(path) if path.suffix.lower() == ".csv" else _json_rows(path)
    found: dict[str, tuple[int, Path]] = {}
    for line, row in rows:
        if not row.source or len(row.source) > _MOST_LETTERS or "\0" in row.source:
            raise ClipError(f"{path} line {line} has the source {one_line(row.source, 60)!r}; expected a path")
        source = path.parent / row.source
        name = row.name or (source.name if source.is_dir() else source.stem)
        if name in ("", ".", "..") or name.startswith(".") or Path(name).name != name or not name.isprintable():
            raise ClipError(
                f"{path} line {line} names a clip {one_line(name, 60)!r}; expected a plain name: it becomes a folder"
            )
        if name in found:
            raise ClipError(f"{path} lines {found[name][0]} and {line} both name a clip {name!r}; rename one of them")
        found[name] = (line, source)
    if not found:
        raise ClipError(f"{path} lists no clips; expected a line for each, with its source")
    return {name: source for name, (_, source) in found.items()}


def _csv_rows(path: Path) -> list[tuple[int, _Row]]:
    try:
        with reading(path, ClipError), path.open(encoding="utf-8-sig", newline="") as file:
            _check_size(path)
            reader = csv.DictReader(file)
            if "source" not in (reader.fieldnames or ()):
                raise ClipError(f"{path} has no column source; expected columns source and, if wanted, name")
            return [(reader.line_num, _Row(row["source"] or "", row.get("name") or None)) for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ClipError(f"{path} is no CSV file: {error}") from None


def _json_rows(path: Path) -> list[tuple[int, _Row]]:
    with reading(path, ClipError):
        _check_size(path)
        lines = path.read_bytes().splitlines()
    found = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            values = parse_json(line, dict[str, object], f"{path} line {number}", error=ClipError)
            known = {key: value for key, value in values.items() if key in ("source", "name")}
            if not isinstance(known.get("source"), str) or not isinstance(known.get("name"), str | None):
                raise ClipError(f"{path} line {number} has no source; expected source and, if wanted, name, as text")
            found.append((number, _Row(**known)))  # type: ignore[arg-type]
    return found


def _check_size(path: Path) -> None:
    if (size := path.stat().st_size) > _MOST_BYTES:
        raise ClipError(f"{path} has {size} bytes; expected at most {_MOST_BYTES}: cut it into several lists")
