"""Layouts of videos and of pictures in containers: their records, by format."""

from __future__ import annotations

import struct
from random import Random

from tests.fuzz.changes.headers import change_fields
from tests.fuzz.changes.records import Layout, Record, change_records, sized

_BOXES = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"dinf", b"mvex", b"moof", b"traf")
_BOXES += (b"iprp", b"ipco", b"jp2h")
_SKIPPED = {b"stsd": 8, b"meta": 4, b"iinf": 6}  # bytes before the boxes of a box


def _in_box(name: bytes) -> tuple[int, Layout] | None:
    if name == b"jp2c":
        return 2, _SEGMENTS
    return (_SKIPPED.get(name, 0), BOXES) if name in _BOXES or name in _SKIPPED else None


BOXES = sized(4, ">I", size_first=True, counted=8, inner=_in_box)  # MP4, QuickTime, AVIF, JPEG 2000
RIFF = sized(4, "<I", even=True, inner=lambda name: (4, RIFF) if name in (b"RIFF", b"LIST") else None)
_SEGMENT = sized(2, ">H", counted=2)  # of a JPEG 2000 codestream: size, coding, quantisation, tile
_HEADER = bytes.fromhex("3026b2758e66cf11a6d900aa0062ce6c")
_SKIPPED_OBJECTS = {_HEADER: 6, bytes.fromhex("b503bf5f2ea9cf118ee300c00c205365"): 22}  # the latter: of extensions
ASF = sized(
    16, "<Q", counted=24, inner=lambda guid: (_SKIPPED_OBJECTS[guid], ASF) if guid in _SKIPPED_OBJECTS else None
)
_TAGS = sized(2, ">H")  # of a set of metadata in MXF


def _cut_segment(content: bytes, at: int) -> Record | None:
    is_data = content[at] != 0xFF or content[at + 1] == 0x93  # what follows the start of data is no segment
    return None if is_data else _SEGMENT.cut(content, at)


_SEGMENTS = Layout(_cut_segment, _SEGMENT.join)


_MASTERS = (  # elements of Matroska that hold elements
    *(b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67", b"\x15\x49\xa9\x66", b"\x16\x54\xae\x6b", b"\xae", b"\xe0", b"\xe1"),
    *(b"\x1f\x43\xb6\x75", b"\xa0", b"\x1c\x53\xbb\x6b", b"\xbb", b"\xb7", b"\x11\x4d\x9b\x74", b"\x4d\xbb"),
    *(b"\x12\x54\xc3\x67", b"\x73\x73", b"\x63\xc0", b"\x67\xc8"),
)


def _cut_element(content: bytes, at: int) -> Record:
    """Cut an element; the head is its name and the number of bytes that its length takes."""
    name = content[at : at + 9 - content[at].bit_length()]
    place = at + len(name)
    width = 9 - content[place].bit_length()
    start, most = place + width, 2 ** (7 * width) - 1
    length = int.from_bytes(content[place:start], "big") & most
    end = len(content) if length == most else min(start + length, len(content))
    return Record(name + bytes([width]), content[start:end], end)


def _join_element(head: bytes, body: bytes) -> bytes:
    width = head[-1] if head[-1] <= 8 and len(body) < 2 ** (7 * head[-1]) - 1 else 8
    return head[:-1] + (2 ** (7 * width) + len(body)).to_bytes(width, "big") + body


EBML = Layout(_cut_element, _join_element, lambda head: (0, EBML) if head[:-1] in _MASTERS else None)


def _cut_klv(content: bytes, at: int) -> Record:
    """Cut a key, a length and a value; the head is the key and the number of bytes that the length takes."""
    start = at + 17
    length = content[at + 16]
    width = max(length - 0x80, 0)
    if width:
        start, length = start + width, int.from_bytes(content[start : start + width], "big")
    return Record(content[at : at + 16] + bytes([width]), content[start : start + length], start + length)


def _join_klv(head: bytes, body: bytes) -> bytes:
    width = min(head[16], 8) or (0 if len(body) < 0x80 else 3)
    length = (len(body) % 256 ** max(width, 1)).to_bytes(max(width, 1), "big")
    return head[:16] + bytes([0x80 + width] if width else b"") + length + body


KLV = Layout(  # MXF
    _cut_klv, _join_klv, lambda head: (0, _TAGS) if head[:6] == bytes.fromhex("060e2b340253") else None
)


def _cut_tag(content: bytes, at: int) -> Record:
    length = int.from_bytes(content[at + 1 : at + 4], "big")
    start = at + 11
    return Record(content[at : at + 1] + content[at + 4 : start], content[start : start + length], start + length + 4)


def _join_tag(head: bytes, body: bytes) -> bytes:
    return head[:1] + len(body).to_bytes(3, "big") + head[1:] + body + struct.pack(">I", len(body) + 11)


FLV = Layout(_cut_tag, _join_tag)
_PACKET = sized(4, ">H")  # of a program stream


def _cut_packet(content: bytes, at: int) -> Record | None:
    if content[at : at + 3] != b"\0\0\1":
        return None
    if content[at + 3] != 0xBA:
        return _PACKET.cut(content, at)
    end = at + (12 if content[at + 4] >> 4 == 2 else 14 + content[at + 13] % 8)
    return Record(content[at : at + 4], content[at + 4 : end], end)


PROGRAM = Layout(  # MPEG program streams, whose pack headers have no length
    _cut_packet, lambda head, body: head + body if head[3] == 0xBA else _PACKET.join(head, body)
)


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        value = byte << 24
        for _ in range(8):
            value = value << 1 ^ (0x104C11DB7 if value >> 31 else 0)
        table.append(value)
    return table


_CRC = _crc_table()


def _checksum(data: bytes | bytearray, start: int) -> int:
    """Return the CRC-32 whose first bit is the highest: of Ogg from 0 on, of MPEG from 2^32 - 1 on."""
    for byte in data:
        start = (start << 8 & 0xFFFFFFFF) ^ _CRC[start >> 24 ^ byte]
    return start


def _cut_transport(content: bytes, at: int) -> Record | None:
    end = at + 188
    return Record(content[at : at + 4], content[at + 4 : end], end) if end <= len(content) else None


def _join_transport(head: bytes, body: bytes) -> bytes:
    """Return a packet of 188 bytes; a table of programs or streams in it gets its checksum."""
    data = bytearray(body[:184].ljust(184, b"\xff"))
    is_table = int.from_bytes(head[1:3], "big") in (0x4000, 0x4011, 0x5000) and head[3] >> 4 & 3 == 1
    start = 1 + data[0]
    if is_table and start < 180:
        end = start + 3 + (int.from_bytes(data[start + 1 : start + 3], "big") & 0xFFF)
        if start + 4 < end <= 184:
            data[end - 4 : end] = struct.pack(">I", _checksum(data[start : end - 4], 0xFFFFFFFF))
    return head + data


TRANSPORT = Layout(_cut_transport, _join_transport)


def _cut_page(content: bytes, at: int) -> Record | None:
    start = at + 27 + content[at + 26]
    table = content[at + 27 : start]
    end = start + sum(table)
    is_page = content[at : at + 4] == b"OggS"
    return Record(content[at : at + 22] + table, content[start:end], end) if is_page else None


def _join_page(head: bytes, body: bytes) -> bytes:
    table = head[22:]
    if sum(table) != len(body):
        table = (b"\xff" * (len(body) // 255) + bytes([len(body) % 255]))[:255]
        body = body[: sum(table)]
    page = bytearray(head[:22] + bytes(4) + bytes([len(table)]) + table + body)
    page[22:26] = struct.pack("<I", _checksum(page, 0))
    return bytes(page)


OGG = Layout(_cut_page, _join_page)


def _cut_block(content: bytes, at: int) -> Record | None:
    start = at + 2
    if content[at] == 0x2C:  # a picture: its place, sizes and flags, its palette, the size of codes
        flags = content[at + 9]
        start = at + 11 + (3 << flags % 8 + 1 if flags & 0x80 else 0)
    elif content[at] != 0x21:
        return None
    pieces, end = [], start
    while length := content[end]:
        pieces.append(content[end + 1 : end + 1 + length])
        end += 1 + length
    return Record(content[at:start], b"".join(pieces), end + 1)


def _join_block(head: bytes, body: bytes) -> bytes:
    pieces = (body[start : start + 255] for start in range(0, len(body), 255))
    return head + b"".join(bytes([len(piece)]) + piece for piece in pieces) + b"\0"


_GIF = Layout(_cut_block, _join_block)
_SCREEN = ((6, 2), (8, 2), (10, 1), (11, 1))  # places and widths of the screen's sizes, flags, background


def change_gif(content: bytes, random: Random) -> bytes:
    if random.random() < 0.2:
        return change_fields(content, random, fields=_SCREEN)
    flags = content[10]
    return change_records(content, random, layout=_GIF, skip=13 + (3 << flags % 8 + 1 if flags & 0x80 else 0))
