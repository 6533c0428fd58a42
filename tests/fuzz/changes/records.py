"""Changes of files that are records in a row, such as the boxes of MP4 and the chunks of RIFF: lengths follow."""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from random import Random
from typing import NamedTuple

from tests.fuzz.changes.plain import change_bytes, change_word, cut, flipped, spliced

_WEIGHT = 30  # of a record that holds records; others have 1


class Record(NamedTuple):
    """A record: its head without its length, its body, and where it ends."""

    head: bytes
    body: bytes
    end: int


class Layout(NamedTuple):
    """How records are cut and put together, and which of them hold records."""

    cut: Callable[[bytes, int], Record | None]  # content and place; an error or None where no record begins
    join: Callable[[bytes, bytes], bytes]  # head and body
    inner: Callable[[bytes], tuple[int, Layout] | None] = lambda _: None  # head -> bytes before its records, and theirs


def sized(
    head: int,
    size: str,
    *,
    size_first: bool = False,
    counted: int = 0,
    even: bool = False,
    inner: Callable[[bytes], tuple[int, Layout] | None] = lambda _: None,
) -> Layout:
    """Return the layout of records of a head, a length and a body.

    Args:
        head: bytes of the head.
        size: format of the length, as `struct` has it.
        size_first: whether the length stands before the head.
        counted: bytes of head and length that the length counts, too.
        even: whether a body of odd length is followed by a byte.
        inner: head -> bytes before the records that it holds, and their layout.
    """
    width = struct.calcsize(size)

    def cut(content: bytes, at: int) -> Record:
        start = at + head + width
        (length,) = struct.unpack_from(size, content, at if size_first else at + head)
        length -= counted
        length = length if 0 <= length <= len(content) - start else len(content) - start
        place = at + width if size_first else at
        end = start + length
        return Record(content[place : place + head], content[start:end], end + length % 2 * even)

    def join(name: bytes, body: bytes) -> bytes:
        length = struct.pack(size, (len(body) + counted) % 256**width)
        return (length + name if size_first else name + length) + body + b"\0" * (len(body) % 2 * even)

    return Layout(cut, join, inner)


_BOXES = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"dinf", b"mvex", b"moof", b"traf")
_BOXES += (b"iprp", b"ipco", b"jp2h")
_SKIPPED = {b"stsd": 8, b"meta": 4, b"iinf": 6}  # bytes before the boxes of a box


def _in_box(name: bytes) -> tuple[int, Layout] | None:
    return (_SKIPPED.get(name, 0), BOXES) if name in _BOXES or name in _SKIPPED else None


BOXES = sized(4, ">I", size_first=True, counted=8, inner=_in_box)  # MP4, QuickTime, AVIF, JPEG 2000
RIFF = sized(4, "<I", even=True, inner=lambda name: (4, RIFF) if name in (b"RIFF", b"LIST") else None)


def change_records(content: bytes, random: Random, *, layout: Layout) -> bytes:
    """Change one record at any depth: leave it out, double or move it, change its head or its body."""
    records, places = [], [0]
    with suppress(LookupError, ValueError, struct.error):
        while (at := places[-1]) < len(content) and (record := layout.cut(content, at)) and record.end > at:
            records.append(record)
            places.append(record.end)
    if not records:
        return change_bytes(content, random)
    pieces = [content[start:end] for start, end in pairwise(places)]
    tail = content[places[-1] :]
    held = [layout.inner(record.head) for record in records]
    place = random.choices(range(len(records)), [_WEIGHT if inner else 1 for inner in held])[0]
    (head, body, _), inner = records[place], held[place]
    change = random.randrange(20)
    if inner is not None and change < 14:
        before, below = inner
        body = body[:before] + change_records(body[before:], random, layout=below)
        pieces[place] = layout.join(head, body)
    elif change < 12:
        how = random.choice((change_word, change_word, change_word, change_bytes, cut, spliced))
        pieces[place] = layout.join(head, how(body, random))
    elif change < 14:
        pieces[place] = layout.join(flipped(head, random), body)
    elif change < 16:
        pieces[place] = b""
    elif change < 18:
        pieces[place] *= 2
    elif change == 18 or not tail:
        pieces.insert(random.randrange(len(pieces)), pieces.pop(place))
    else:
        tail = change_bytes(tail, random)
    return b"".join(pieces) + tail
