"""Changes of parquet files: tables that are written again, and footers and pages of the right length."""

from __future__ import annotations

import io
from random import Random
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from tests.fuzz.changes.plain import change_bytes, change_word, flipped
from tests.fuzz.changes.text import NAMES, WORDS

_TYPES: tuple[Any, ...] = (pa.large_string(), pa.binary(), pa.int64(), pa.null(), pa.list_(pa.string()), pa.date32())


def change_parquet(content: bytes, random: Random) -> bytes:
    change = random.randrange(8)
    start = max(4, len(content) - 8 - int.from_bytes(content[-8:-4], "little"))
    if change < 2:
        footer = random.choice((change_word, change_bytes))(content[start:-8], random)
        return content[:start] + footer + len(footer).to_bytes(4, "little") + b"PAR1"
    if change == 2:
        return content[:4] + random.choice((change_word, flipped))(content[4:start], random) + content[start:]
    try:
        table = pq.read_table(io.BytesIO(content))
    except (pa.ArrowException, OSError):  # changed before
        return change_bytes(content, random)
    name = random.choice(table.column_names)
    column, at = table.column(name).to_pylist(), table.column_names.index(name)
    if change == 3:
        words = (*WORDS, *NAMES, "x" * 4096, "😀" * 4096, "x" * 900_000, None)
        column[random.randrange(len(column))] = random.choice(words)
        table = table.set_column(at, name, pa.array([_encodable(value) for value in column], pa.string()))
    elif change == 4:
        kind = random.choice(_TYPES)
        values = column if kind in _TYPES[:2] else [None] * len(column)
        table = table.set_column(at, name, pa.array(values, kind))
    elif change == 5:
        other = random.choice((*NAMES, "source", "name", "", "Source"))
        names = [other if one == name else one for one in table.column_names]
        table = table.rename_columns([_encodable(one) for one in names])
    elif change == 6:
        table = pa.concat_tables([table] * random.choice((2, 3000))) if random.random() < 0.7 else table.slice(0, 0)
    else:
        text = random.choice(("a", "x" * 16_000, "😀" * 4090, "x" * 60_000))
        table = table.set_column(at, name, pa.array([text] * len(table)))
        times = random.choice((1, 2000))
        table = pa.concat_tables([table] * (times if len(table) < 10 else 1))
    file = io.BytesIO()
    packed = random.choice(("none", "snappy", "gzip", "zstd", "lz4", "brotli"))
    rows = random.choice((1, 1000, 2**20)) if len(table) < 100 else 2**20
    pq.write_table(table, file, compression=packed, row_group_size=rows, use_dictionary=random.random() < 0.7)
    return file.getvalue()


def _encodable(text: str | None) -> str | None:
    return None if text is None else text.encode("utf-8", "replace").decode()
