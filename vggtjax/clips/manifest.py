"""Lists of clips in a file: CSV, JSON values a line, or parquet. Does not import jax."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from pathlib import Path, PurePath
from typing import Any, TypeAlias

from vggtjax.clips.captures.table import RECORD3D_SUFFIX
from vggtjax.clips.media.images import is_image_name
from vggtjax.clips.media.video import is_video_name
from vggtjax.errors import ClipError, check_extra, one_line, reading
from vggtjax.storage.csv_file import read_csv
from vggtjax.storage.json_values import parse_json
from vggtjax.storage.remote import is_url, local_path, url_name

MOST_BYTES = 2**28  # of a list: about two million clips
_MOST_LETTERS = 4096  # of a path
_MOST_LINE = 2**16  # bytes of a line of JSON
_MOST_TIMES, _SPARE = 64, 2**20  # of a parquet file's bytes its text may have, and so many bytes more
_BATCH = 512  # rows of a parquet file that are read at once: at most 8 MiB of a column's texts
_MOST_ROWS = 5_000_000


_Rows: TypeAlias = Iterator[tuple[int, str, str | None]]  # line or row, source, name if there is one


def is_manifest(name: str) -> bool:
    """Return whether a name has the suffix of a list of clips."""
    return PurePath(name).suffix.lower() in _READERS


def read_manifest(path: Path, url: str | None = None) -> dict[str, str]:
    """Return the sources of clips, paths or URLs, by name, in the order of the file.

    A CSV or parquet file has a column `source`, and `name` if wanted; a .jsonl file has an object with these keys a
    line. Other columns are not read. Relative paths start at the file's folder, or at that of `url`, where the file was
    downloaded from; a clip without a name has that of its source.

    Raises ClipError, with the line, for a file that is no such list, two clips of one name, names that are not plain
    ones, and, in a list from a URL, paths of this machine.
    """
    unit, read = ("row" if path.suffix.lower() == ".parquet" else "line"), _READERS[path.suffix.lower()]
    found: dict[str, tuple[int, str]] = {}
    for number, source, name in read(path):
        place = f"{path} {unit} {number}"
        if not source or len(source) > _MOST_LETTERS or "\0" in source:
            raise ClipError(f"{place} has the source {one_line(source, 60)!r}; expected a path or a URL")
        source = _source(source, path, url, place)
        name = name or source_name(source)
        if (
            name in ("", ".", "..")
            or len(name) > 255
            or name.startswith(".")
            or Path(name).name != name
            or not name.isprintable()
        ):
            raise ClipError(f"{place} names a clip {one_line(name, 60)!r}; expected a plain name: it becomes a folder")
        if name in found:
            raise ClipError(
                f"{path} {unit}s {found[name][0]} and {number} both name a clip {one_line(name, 60)!r}; "
                "rename one of them"
            )
        found[name] = (number, source)
    if not found:
        raise ClipError(f"{path} lists no clips; expected a line for each, with its source")
    return {name: source for name, (_, source) in found.items()}


def source_name(source: str) -> str:
    """Return how a clip is called after its source: as the folder, or the file without the suffix."""
    if is_url(source):
        name = Path(url_name(source, ClipError))
        is_file = is_video_name(name) or is_image_name(name) or name.suffix.lower() == RECORD3D_SUFFIX
        return name.stem if is_file else name.name
    path = Path(source)
    return path.name if os.path.isdir(path) else path.stem  # noqa: PTH112 - a path may be too long to ask for


def _source(source: str, path: Path, url: str | None, place: str) -> str:
    """Return the path or URL that a row names."""
    if is_url(source):
        return source
    if url is None:
        return str(path.parent / local_path(source))
    if "://" in source or source.startswith(("/", "\\")) or ".." in source.replace("\\", "/").split("/"):
        raise ClipError(
            f"{place} has the source {one_line(source, 60)!r}; a list from a URL names URLs, and paths below its own"
        )
    return f"{url.rpartition('/')[0]}/{source}"


def _csv_rows(path: Path) -> _Rows:
    table = read_csv(path, most_bytes=MOST_BYTES, error=ClipError)
    if "source" not in table.columns:
        raise ClipError(f"{path} has no column source; expected columns source and, if wanted, name")
    for line, row in table.rows:
        yield line, row["source"] or "", row.get("name")


def _json_rows(path: Path) -> _Rows:
    with reading(path, ClipError):
        _check_size(path)
        lines = path.read_bytes().splitlines()
    for number, line in enumerate(lines, start=1):
        if line.strip():
            place = f"{path} line {number}"
            values = parse_json(line, dict[str, object], place, most_bytes=_MOST_LINE, error=ClipError)
            source, name = values.get("source"), values.get("name")
            if not isinstance(source, str) or not isinstance(name, str | None):
                raise ClipError(f"{place} has no source; expected source and, if wanted, name, as text")
            yield number, source, name


def _parquet_rows(path: Path) -> _Rows:
    check_extra(f"{path}, a list of clips in parquet,", "cluster", "pyarrow")
    import pyarrow as pa
    from pyarrow import parquet

    with reading(path, ClipError):
        _check_size(path)
        try:
            types = {field.name: field.type for field in parquet.read_schema(path)}
            names = [name for name in ("source", "name") if name in types]
            with parquet.ParquetFile(path, read_dictionary=names) as file:
                is_text = all(str(types[name]) in ("string", "large_string") for name in names)
                if "source" not in names or not is_text:
                    raise ClipError(
                        f"{path} has no column source of text; expected source and, if wanted, name, as text"
                    )
                if file.metadata.num_rows > _MOST_ROWS:
                    raise ClipError(f"{path} has {file.metadata.num_rows} rows; expected at most {_MOST_ROWS}")
                _check_text_bytes(path, file.metadata, names)
                number = 0
                for rows in file.iter_batches(_BATCH, columns=names, use_threads=False):
                    texts = {name: _texts(path, rows.column(name)) for name in names}
                    for source, name in zip(texts["source"], texts.get("name", [None] * len(rows)), strict=True):
                        number += 1
                        yield number, source or "", name
        except (pa.ArrowException, KeyError, UnicodeDecodeError) as problem:
            raise ClipError(f"{path} is no parquet file: {one_line(str(problem))}") from problem


def _texts(path: Path, column: Any) -> list[str | None]:
    """Return the texts of a batch's column; one text may stand for all rows, so its length is checked before."""
    from pyarrow.compute import binary_length, max  # pyright: ignore[reportAttributeAccessIssue] - made on import

    longest = max(binary_length(column.dictionary)).as_py() or 0
    if longest > 4 * _MOST_LETTERS:
        raise ClipError(f"{path} has a text of {longest} bytes; expected paths and names")
    return column.dictionary_decode().to_pylist()


def _check_text_bytes(path: Path, metadata: Any, names: Collection[str]) -> None:
    """Raise ClipError where columns of a parquet file declare more bytes than a file of its size can honestly hold."""
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    columns = [group.column(number) for group in groups for number in range(group.num_columns)]
    total = sum(column.total_uncompressed_size for column in columns if column.path_in_schema in names)
    size = path.stat().st_size
    if not 0 <= total <= min(MOST_BYTES, _MOST_TIMES * size + _SPARE):
        raise ClipError(
            f"{path} has {size} bytes and says that its text takes {total}; expected at most {_MOST_TIMES} times as "
            "many: it is damaged, or made to fill the memory"
        )


def _check_size(path: Path) -> None:
    if (size := path.stat().st_size) > MOST_BYTES:
        raise ClipError(f"{path} is {size} bytes; expected at most {MOST_BYTES}: cut it into several lists")


_READERS = {".csv": _csv_rows, ".jsonl": _json_rows, ".parquet": _parquet_rows}
