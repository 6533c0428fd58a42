"""Changes of PNG and JPEG files, and of the headers of pixmaps and of OpenEXR files."""

from __future__ import annotations

import re
import struct
import zlib
from random import Random

from tests.fuzz.changes.plain import INTEGERS, change_bytes, change_word, flipped
from tests.fuzz.changes.records import Layout, Record, change_records
from tests.shared.dataset_files import png_chunk


def change_png(content: bytes, random: Random) -> bytes:
    chunks, at = [], 8
    while at + 12 <= len(content):
        length = int.from_bytes(content[at : at + 4], "big")
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    if not chunks or len(chunks[0][1]) != 13:
        return change_bytes(content, random)
    place = random.randrange(len(chunks))
    name, body = chunks[place]
    width, height, *kind = struct.unpack(">IIBBBBB", chunks[0][1])
    change = random.randrange(8)
    if change == 0:
        sides = (0, 1, width, height, 5000, 16383, 2**16, 2**31 - 1, 2**32 - 1)
        chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", random.choice(sides), random.choice(sides), *kind))
    elif change == 1:
        kind[random.randrange(5)] = random.choice((0, 1, 2, 3, 4, 6, 8, 16, 99))
        chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", width, height, *kind))
    elif change == 2:
        del chunks[place]
    elif change == 3:
        chunks.insert(place, chunks[place])
    elif change == 4:
        bodies = {
            b"tRNS": random.randbytes(random.randrange(9)),
            b"PLTE": random.randbytes(random.choice((0, 1, 3, 768, 900))),
            b"zTXt": b"x\0\0" + zlib.compress(bytes(2**22), 9),
            b"iCCP": b"x\0\0" + zlib.compress(bytes(2**20), 9),
            b"eXIf": b"II*\0\x08\0\0\0\x01\0\x12\x01" + random.randbytes(10) + bytes(4),
            b"acTL": struct.pack(">II", random.choice((0, 1, 2**31)), 0),
            b"gAMA": bytes(random.randrange(6)),
        }
        added = random.choice(sorted(bodies))
        chunks.insert(random.randrange(1, len(chunks)), (added, bodies[added]))
    elif change == 5 and name == b"IDAT":
        try:
            rows = bytearray(zlib.decompress(body))
        except zlib.error:
            rows = bytearray(body or b"\0")
        rows[random.randrange(len(rows))] = random.randrange(256)
        kept = rows[: random.choice((len(rows), len(rows) // 2, 1))]
        chunks[place] = (name, zlib.compress(bytes(kept)))
    else:
        chunks[place] = (name, change_bytes(body, random))
    return content[:8] + b"".join(png_chunk(name, body) for name, body in chunks)


def change_jpeg(content: bytes, random: Random) -> bytes:
    """Change a segment: the frame's sizes, an EXIF block, a table; or leave it out."""
    segments, at = [], 2
    while at + 4 <= len(content) and content[at] == 0xFF and content[at + 1] != 0xDA:
        length = int.from_bytes(content[at + 2 : at + 4], "big")
        segments.append((at, at + 2 + length))
        at += 2 + length
    if not segments:
        return change_bytes(content, random)
    start, end = random.choice(segments)
    segment = content[start:end]
    if segment[1] in (0xC0, 0xC2) and random.random() < 0.6:
        sides = struct.pack(">HH", *(random.choice((0, 1, 100, 20_000, 65_535)) for _ in range(2)))
        segment = segment[:5] + sides + segment[9:]
    else:
        exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01" + random.randbytes(10) + bytes(4)
        added = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + segment
        segment = random.choice((b"", segment * 2, added, segment[:4] + flipped(segment[4:], random)))
    return content[:start] + segment + content[end:]


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
