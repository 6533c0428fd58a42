"""Changes of the headers of pixmaps and of OpenEXR files."""

from __future__ import annotations

import re
import struct
from random import Random

from tests.fuzz.changes.plain import INTEGERS, change_word
from tests.fuzz.changes.records import Layout, Record, change_records


def change_pixmap(content: bytes, random: Random) -> bytes:
    """Change the kind, a side or the largest value of a PPM or PGM file."""
    words = list(re.finditer(rb"\S+", content[:60]))[:4]
    word = random.choice(words)
    numbers = (b"0", b"-1", b"1", b"29", b"255", b"256", b"65535", b"65536", b"99999999999", b"9" * 400, b"x", b"1.5")
    new = random.choice((b"P1", b"P2", b"P3", b"P4", b"P5", b"P7", b"Pf", b"PF") if word is words[0] else numbers)
    comment = random.choice((b"", b"", b"", b"# comment\n", b"#" * 5000 + b"\n", b" " * 5000))
    return content[: word.start()] + comment * (word is not words[0]) + new + content[word.end() :]


def _cut_attribute(content: bytes, at: int) -> Record | None:
    if content[at] == 0:
        return None
    place = content.index(b"\0", content.index(b"\0", at) + 1) + 1  # after its name and its type
    (length,) = struct.unpack_from("<i", content, place)
    return Record(content[at:place], content[place + 4 : place + 4 + length], place + 4 + length)


_ATTRIBUTES = Layout(_cut_attribute, lambda head, body: head + struct.pack("<i", len(body)) + body)


def change_exr(content: bytes, random: Random) -> bytes:
    """Change an attribute, and let the offsets of the rows follow; or change an offset or the head of some rows."""
    end = 8
    while (record := _cut_attribute(content, end)) is not None:
        end = record.end
    start = end + 1
    count = (struct.unpack_from("<Q", content, start)[0] - start) // 8
    offsets = list(struct.unpack_from(f"<{count}Q", content, start))
    table_end = start + 8 * count
    header, rest = content[8:end], content[table_end:]
    change = random.randrange(8)
    if change == 0:
        place = random.randrange(count)
        offsets[place] = random.choice((*INTEGERS, *offsets, offsets[place] + 1, len(content))) % 2**64
    elif change < 3:  # the rows' number, their size, or their values
        at = random.choice(offsets) - table_end
        rest = rest[:at] + change_word(rest[at : at + 8], random) + rest[at + 8 :]
    else:
        header = change_records(header, random, layout=_ATTRIBUTES)
        offsets = [(offset + len(header) - (end - 8)) % 2**64 for offset in offsets]
    return content[:8] + header + b"\0" + struct.pack(f"<{count}Q", *offsets) + rest
