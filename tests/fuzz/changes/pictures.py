"""Changes of PNG and JPEG files."""

from __future__ import annotations

import struct
import zlib
from random import Random

from tests.fuzz.changes.plain import change_bytes, flipped


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


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
    return content[:8] + b"".join(_chunk(name, body) for name, body in chunks)


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
