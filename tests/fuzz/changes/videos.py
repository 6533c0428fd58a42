"""Changes of videos, by container; WebP shares that of AVI."""

from __future__ import annotations

import re
import struct
from random import Random

from tests.fuzz.changes.plain import change_bytes, change_word, cut, spliced

_INNER = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"dinf", b"stsd", b"mvex", b"moof", b"traf")


def change_boxes(content: bytes, random: Random) -> bytes:
    """Change a box of an MP4 file or a QuickTime film, at any depth; the sizes of the boxes around it follow."""
    boxes, at = [], 0
    while at + 8 <= len(content):
        size = int.from_bytes(content[at : at + 4], "big")
        size = size if 8 <= size <= len(content) - at else len(content) - at
        boxes.append((content[at + 4 : at + 8], content[at + 8 : at + size]))
        at += size
    if not boxes:
        return change_bytes(content, random)
    weights = [30 if name in _INNER else 1 for name, _ in boxes]
    place = random.choices(range(len(boxes)), weights)[0]
    name, body = boxes[place]
    change = random.randrange(10)
    if name in _INNER and change < 7:
        skip = 8 if name == b"stsd" else 0
        boxes[place] = (name, body[:skip] + change_boxes(body[skip:], random))
    elif change == 7:
        del boxes[place]
    elif change == 8:
        boxes.insert(place, boxes[place])
    else:
        boxes[place] = (name, random.choice((change_word, change_word, cut, spliced))(body, random))
    return b"".join(struct.pack(">I", len(body) + 8) + name + body for name, body in boxes)


def change_riff(content: bytes, random: Random) -> bytes:
    """Change a chunk of an AVI or a WebP file; the size of the whole follows."""
    chunks, at = [], 12
    while at + 8 <= len(content):
        size = int.from_bytes(content[at + 4 : at + 8], "little")
        chunks.append((content[at : at + 4], content[at + 8 : at + 8 + size]))
        at += 8 + size + size % 2
    if not chunks:
        return change_bytes(content, random)
    place = random.randrange(len(chunks))
    name, body = chunks[place]
    changes = ([], [chunks[place]] * 2, [(name, change_word(body, random))], [(name, change_bytes(body, random))])
    chunks[place : place + 1] = random.choice((*changes, changes[2], changes[3]))
    whole = b"".join(name + struct.pack("<I", len(body)) + body + b"\0" * (len(body) % 2) for name, body in chunks)
    return content[:4] + struct.pack("<I", len(whole) + 4) + content[8:12] + whole


def change_ebml(content: bytes, random: Random) -> bytes:
    """Change the length or the value of an element of a Matroska file."""
    ids = (b"\x18\x53\x80\x67", b"\x16\x54\xae\x6b", b"\xae", b"\xe0", b"\xb0", b"\xba", b"\x1f\x43\xb6\x75", b"\xa3")
    ids += (b"\x15\x49\xa9\x66", b"\x2a\xd7\xb1", b"\x44\x89", b"\x63\xa2", b"\x86", b"\x83", b"\xe7")
    start = random.choice([match.start() for name in ids for match in re.finditer(re.escape(name), content)] or [0])
    at = min(start + random.randrange(1, 9), len(content) - 1)
    value = random.choice((0, 1, 0x7F, 0x80, 0x81, 0xFF, random.randrange(256)))
    return content[:at] + bytes([value]) * random.choice((1, 1, 4)) + content[at + 1 :]
