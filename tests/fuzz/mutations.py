"""Structural mutations of files: lengths and checksums stay valid, so that a reader gets to the content that lies.

`mutated` recognises the format of a file by its content and changes one place of its structure: an entry of its JSON, a
cell of its table, a chunk, a box, a member. In one of five cases it changes plain bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from random import Random

from tests.fuzz.changes.parquet import change_parquet
from tests.fuzz.changes.pictures import change_exr, change_jpeg, change_pixmap, change_png
from tests.fuzz.changes.plain import change_bytes, change_word
from tests.fuzz.changes.records import BOXES, RIFF, change_records
from tests.fuzz.changes.text import change_json, change_text
from tests.fuzz.changes.weights import change_pickle, change_safetensors
from tests.fuzz.changes.zips import change_npy, change_zip


def mutated(content: bytes, random: Random) -> bytes:
    """Return the content of a file with one change, by the format that it starts as."""
    if random.random() < 0.2:
        return change_bytes(content, random)
    change = next((change for starts, change in _FORMATS if starts(content)), change_word)
    try:
        return change(content, random)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError, struct.error):
        return change_bytes(content, random)  # it is mutated already, and lacks what this change needs


_FORMATS: tuple[tuple[Callable[[bytes], object], Callable[[bytes, Random], bytes]], ...] = (
    (lambda content: content[:6] == b"\x93NUMPY", change_npy),
    (lambda content: content[:4] == b"PAR1", change_parquet),
    (lambda content: content[:2] == b"PK", partial(change_zip, mutated=mutated)),
    (lambda content: content[:4] == b"\x89PNG", change_png),
    (lambda content: content[:2] == b"\xff\xd8", change_jpeg),
    (lambda content: content[4:8] in (b"ftyp", b"moov", b"wide", b"jP  "), partial(change_records, layout=BOXES)),
    (lambda content: content[:4] == b"RIFF", partial(change_records, layout=RIFF)),
    (lambda content: content[:4] == b"\x76\x2f\x31\x01", change_exr),
    (lambda content: content[:2] in (b"P5", b"P6") and content[2:3].isspace(), change_pixmap),
    (lambda content: content[8:9] == b"{" and content[2:8] == bytes(6), change_safetensors),
    (lambda content: content[:2] in (b"\x80\x02", b"\x80\x03", b"\x80\x04"), change_pickle),
    (lambda content: content[:1] in (b"{", b"[") and b"\n{" not in content, change_json),
    (lambda content: b"\0" not in content[:200] and content[:200].decode("utf-8", "ignore").isascii(), change_text),
)
