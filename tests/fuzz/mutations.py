"""Structural mutations of files: lengths and checksums stay valid, so that a reader gets to the content that lies.

`mutated` recognises the format of a file by its content and changes one place of its structure: an entry of its JSON, a
cell of its table, a chunk, a box, a member. In one of five cases it changes plain bytes.
"""

from __future__ import annotations

import io
import json
import pickletools
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from random import Random
from typing import Any

import numpy as np

NAMES = (
    "../../../etc/passwd",
    "/etc/passwd",
    "C:\\x",
    "..",
    "a\nb",
    "\x1b[31mred",
    "\0",
    "x" * 5000,
    "\udcff",
    "é" * 300,
)
WORDS = (
    "nan",
    "inf",
    "-inf",
    "1e400",
    "-1",
    "0",
    "9" * 400,
    "1_000",
    "٣",
    "0x10",
    "1,5",
    "",
    "#",
    '"',
    "x" * 9000,
    "\0",
)
_RAW = (  # JSON text
    *("null", "true", "-1", "0", "1e308", "-1e400", "9" * 400, "-" + "9" * 400, "0." + "3" * 400, "NaN", "Infinity"),
    *("1e-400", "[]", "{}", '""', "[[]]", '{"": {"": null}}', "18446744073709551616", "0.5", "[1, 2, 3, 4, 5]"),
    *("[" * 70 + "]" * 70, "[" * 9000 + "]" * 9000, '{"a":' * 9000 + "1" + "}" * 9000, '"\\ud800"', '"\\u0000"'),
    *("[" + "0," * 20_000 + "0]", "[" + '"x",' * 20_000 + '"x"]', '{"a": 1, "a": 2}', '"' + "y" * 100_000 + '"'),
    *(json.dumps(name) for name in NAMES),
)
_INTEGERS = (0, 1, -1, 2, 255, 2**15, 2**16 - 1, 2**24, 2**31 - 1, -(2**31), 2**32 - 1, 2**53, 2**62, 2**63 - 1)
_FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e-300, 1e300, 3.5)
_BOMB_BYTES = (2**26 - 2**22, 2**28 + 2**25)  # of zeros: what an archive may declare, and what is refused


def mutated(content: bytes, random: Random) -> bytes:
    """Return the content of a file with one change, by the format that it starts as."""
    if random.random() < 0.2:
        return random.choice(_BYTES)(content, random)
    change = next((change for starts, change in _FORMATS if starts(content)), _binary)
    try:
        return change(content, random)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError, struct.error):
        return random.choice(_BYTES)(content, random)  # it is mutated already, and lacks what this change needs


# Plain bytes ---------------------------------------------------------------------------------------------------------


def _flipped(content: bytes, random: Random) -> bytes:
    data = bytearray(content or b"\0")
    for _ in range(random.choice((1, 1, 2, 8, 64))):
        data[random.randrange(len(data))] = random.randrange(256)
    return bytes(data)


def _cut(content: bytes, random: Random) -> bytes:
    return content[: random.randrange(len(content) + 1)]


def _spliced(content: bytes, random: Random) -> bytes:
    start, end = sorted(random.randrange(len(content) + 1) for _ in range(2))
    piece = random.choice((b"", content[start:end] * 2, bytes(random.randrange(1, 5000)), random.randbytes(32)))
    return content[:start] + piece + content[end:]


def _binary(content: bytes, random: Random) -> bytes:
    """Put an extreme number in place of a word, most often near the start, where counts and sizes stand."""
    size = random.choice((1, 2, 4, 4, 8))
    if len(content) < size:
        return content + b"\0"
    at = random.randrange(min(len(content) - size + 1, random.choice((64, 512, len(content)))))
    order = random.choice(("little", "big"))
    if size == 8 and random.random() < 0.4:
        word = struct.pack("<d" if order == "little" else ">d", random.choice(_FLOATS))
    else:
        word = (random.choice(_INTEGERS) % 256**size).to_bytes(size, order)
    return content[:at] + word + content[at + size :]


_BYTES: tuple[Callable[[bytes, Random], bytes], ...] = (_flipped, _flipped, _cut, _spliced, _binary)


# JSON ----------------------------------------------------------------------------------------------------------------


def _json(content: bytes, random: Random) -> bytes:
    try:
        value = json.loads(content)
    except (ValueError, RecursionError):
        return random.choice(_BYTES)(content, random)
    return mutated_json(value, random).encode("utf-8", "surrogatepass")


def mutated_json(value: Any, random: Random) -> str:
    """Return the text of a value with one node changed: replaced, left out, doubled, renamed or wrapped."""
    value = {"": value}
    nodes = [
        (parent, key)
        for parent in _containers(value)
        for key in (parent if isinstance(parent, dict) else range(len(parent)))
    ]
    parent, key = random.choice(nodes)
    raw = random.choice(_RAW)
    choice = random.randrange(8)
    if choice == 0 and len(nodes) > 1 and parent is not value:
        del parent[key]
    elif choice == 1 and isinstance(parent, dict):
        parent[random.choice((*NAMES, "", "constructor", "x"))] = parent[key]
    elif choice == 2:
        parent[key] = [parent[key]]
    elif choice == 3 and isinstance(parent[key], list):
        parent[key] = parent[key] * random.choice((0, 2, 300))
    elif choice == 4:
        other, place = random.choice(nodes)
        if other is not value and parent is not value:
            parent[key], other[place] = json.loads(json.dumps(other[place])), json.loads(json.dumps(parent[key]))
    elif choice == 5 and isinstance(parent, dict) and key:
        parent[key] = "@double@"
        text = json.dumps(value[""])
        return text.replace('"@double@"', f"{raw}, {json.dumps(key)}: {raw}", 1)
    else:
        parent[key] = "@raw@"
        return json.dumps(value[""]).replace('"@raw@"', raw, 1)
    return json.dumps(value[""])


def _containers(value: Any) -> list[Any]:
    found, todo = [], [value]
    while todo:
        if isinstance(container := todo.pop(), dict | list):
            found.append(container)
            todo += container.values() if isinstance(container, dict) else container
    return found


# Text ----------------------------------------------------------------------------------------------------------------


def _text(content: bytes, random: Random) -> bytes:
    """Change lines or cells of a table, or a line of JSON values."""
    try:
        lines = content.decode().splitlines()
    except UnicodeDecodeError:
        return random.choice(_BYTES)(content, random)
    if not lines:
        return random.choice(WORDS).encode()
    number = random.randrange(len(lines))
    line = lines[number]
    if line.startswith("{") and random.random() < 0.7:
        lines[number] = _json(line.encode(), random).decode("utf-8", "surrogatepass")
        return "\n".join(lines).encode("utf-8", "surrogatepass")
    words = re.split(r"([,;\s]+)", line)
    place = random.randrange(len(words))
    change = random.randrange(10)
    if change < 4:
        words[place] = random.choice((*WORDS, *NAMES))
        lines[number] = "".join(words)
    elif change == 4:
        del lines[number]
    elif change == 5:
        lines[number] = "".join(words[:place])
    elif change == 6:
        lines[number] = line + random.choice((" ", ",")) + random.choice(WORDS) * random.choice((1, 1, 1000))
    elif change == 7:
        lines[number:number] = [line] * random.choice((1, 2000))
    elif change == 8:
        lines[number] = random.choice(("\ufeff", "# ", '"', "\r", "\u2028", "\x85")) + line
    else:
        lines = [line.replace(" ", random.choice((",", "\t", "  "))) for line in lines]
    return random.choice(("\n", "\n", "\r\n", "\r")).join(lines).encode("utf-8", "surrogateescape")


# Arrays and archives -------------------------------------------------------------------------------------------------

_DESCR = (
    "<f4",
    "<f8",
    "<f2",
    ">f4",
    "|b1",
    "|u1",
    "<i8",
    "<U3",
    "|S2",
    "|O",
    "<c8",
    "<M8[ns]",
    "<f16",
    "|V8",
    "<U0",
    "x",
)


def npy(descr: str, by_columns: object, shape: object, values: bytes, version: int = 1) -> bytes:
    """Return an .npy file whose header has these fields, and the right length."""
    header = repr({"descr": descr, "fortran_order": by_columns, "shape": shape}).encode("latin1", "replace") + b"\n"
    length = struct.pack("<H" if version == 1 else "<I", len(header) % 2**16)
    return b"\x93NUMPY" + bytes([version, 0]) + length + header + values


def _npy(content: bytes, random: Random) -> bytes:
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception:  # any, of a header that is mutated already
        return random.choice(_BYTES)(content, random)
    descr, shape, values = array.dtype.str, array.shape, array.tobytes()
    big = random.choice((2**20, 2**31, 2**33, 2**62, 10**30, -1, 0))
    change = random.randrange(8)
    if change == 0:
        shape = random.choice(((), (big,), (big, *shape), shape[::-1], (1,) * 33, (*shape, 1), shape[1:], (0,), (2.5,)))
    elif change == 1 and shape:
        at = random.randrange(len(shape))
        shape = (*shape[:at], random.choice((big, shape[at] + 1, 0, "x", None, True)), *shape[at + 1 :])
    elif change == 2:
        descr = random.choice(_DESCR)
        itemsize = int(re.sub(r"\D", "", descr) or 1) or 1
        values = values[: len(values) // itemsize * itemsize]
        shape = (len(values) // itemsize,) if random.random() < 0.5 else shape
    elif change == 3 and array.dtype.kind == "f" and array.size:
        changed = array.copy().ravel()
        chosen = slice(None) if random.random() < 0.5 else random.randrange(array.size)
        with np.errstate(all="ignore"):
            changed[chosen] = random.choice(_FLOATS)
        values = changed.tobytes()
    elif change == 4 and array.ndim and array.size:  # honest: another number of rows
        array = random.choice((array[:0], array[:1], np.concatenate([array, array])))
        shape, values = array.shape, array.tobytes()
    elif change == 5:
        return npy(descr, random.choice((True, 0, None, "x")), shape, values, random.choice((1, 2, 3)))
    elif change == 6:
        values = random.choice(
            (values[:-1], values + b"\0", b"", values * 2, bytes(len(values)), b"\xff" * len(values))
        )
    else:
        shape = random.choice((f"({'9' * 400},)", [1], -1, {}, (("x",),)))
    return npy(descr, array.flags.fnc, shape, values)


@lru_cache(maxsize=len(_BOMB_BYTES))
def _bomb(size: int) -> tuple[bytes, int, int]:
    """Return an .npy file of zeros in deflated form, its checksum and its length, without holding the zeros."""
    start, block = npy("|u1", False, (size,), b""), bytes(2**22)
    packer, check = zlib.compressobj(1, zlib.DEFLATED, -15), zlib.crc32(start)
    packed = [packer.compress(start)]
    for _ in range(size // len(block)):
        packed.append(packer.compress(block))
        check = zlib.crc32(block, check)
    return b"".join([*packed, packer.flush()]), check, len(start) + size


def _bombed(name: str, size: int) -> bytes:
    """Return a zip with a bomb under a name."""
    packed, check, length = _bomb(size)
    word = name.encode()
    fields = struct.pack("<HHHHHIIIHH", 20, 0, zipfile.ZIP_DEFLATED, 0, 33, check, len(packed), length, len(word), 0)
    local = b"PK\x03\x04" + fields + word + packed
    directory = b"PK\x01\x02" + struct.pack("<H", 20) + fields + struct.pack("<HHHII", 0, 0, 0, 0, 0) + word
    end = b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(directory), len(local), 0)
    return local + directory + end


def _zip(content: bytes, random: Random) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(info.file_size for info in archive.infolist()) > _BOMB_BYTES[0] // 4:  # a bomb already
                return random.choice(_BYTES)(content, random)
            members = [(info.filename, archive.read(info), info.compress_type) for info in archive.infolist()]
            if not members:
                return random.choice(_BYTES)(content, random)
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError):  # changed before: not read any more
        return random.choice(_BYTES)(content, random)
    at = random.randrange(len(members))
    name, data, method = members[at]
    change = random.randrange(20)
    if change < 11:
        members[at] = (name, mutated(data, random), method)
    elif change == 11:
        members[at] = (
            random.choice((*NAMES, "x.npy", name + "/", "")).encode("utf-8", "replace").decode(),
            data,
            method,
        )
    elif change == 12:
        del members[at]
    elif change == 13:
        members.append((name, data, method))
    elif change == 14:
        methods = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
        members = [(name, data, random.choice(methods)) for name, data, _ in members]
    elif change == 15:
        members[at] = (name, random.choice((b"", data * 3, bytes(2**22))), zipfile.ZIP_DEFLATED)
    elif change == 16 and name.endswith(".npy") and random.random() < 0.2:
        return _bombed(name, random.choice(_BOMB_BYTES))
    elif change == 17:
        return _lying_directory(content, random)
    elif change == 18:
        return random.randbytes(random.randrange(100)) + content  # zipfile finds the directory from the end
    else:
        other = random.randrange(len(members))
        members[at], members[other] = (name, members[other][1], method), (members[other][0], data, members[other][2])
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a name that is there twice
        for name, data, method in members:
            info = zipfile.ZipInfo(name)
            info.compress_type = method
            archive.writestr(info, data)
    return file.getvalue()


def _lying_directory(content: bytes, random: Random) -> bytes:
    """Change a size, offset, flag, method or count in the directory of a zip."""
    places = [match.start() for match in re.finditer(b"PK\x01\x02", content)]
    at = random.choice(places) + random.choice((8, 10, 16, 20, 24, 28, 30, 32, 42))
    width = random.choice((2, 4))
    return content[:at] + (random.choice(_INTEGERS) % 256**width).to_bytes(width, "little") + content[at + width :]


# Weights -------------------------------------------------------------------------------------------------------------


def _safetensors(content: bytes, random: Random) -> bytes:
    length = int.from_bytes(content[:8], "little")
    try:
        header, data = json.loads(content[8 : 8 + length]), content[8 + length :]
    except ValueError:
        return random.choice(_BYTES)(content, random)
    tensors = [name for name in header if name != "__metadata__"]
    change = random.randrange(8)
    if change < 2 and isinstance(metadata := header.get("__metadata__"), dict) and metadata:
        key = random.choice(list(metadata))
        inner = str(metadata[key])
        metadata[key] = (
            _json(inner.encode(), random).decode("utf-8", "replace") if random.random() < 0.7 else random.choice(WORDS)
        )
    elif change == 2 and tensors:
        header[random.choice(tensors)]["dtype"] = random.choice(
            ("F32", "F64", "BF16", "I8", "U64", "F8_E4M3", "BOOL", "x", 5)
        )
    elif change == 3 and tensors:
        tensor = header[random.choice(tensors)]
        tensor["shape"] = random.choice(
            ([2**40], [0], [], [-1], [1] * 200, [2**62, 2**62], tensor["shape"][::-1], [1, *tensor["shape"]])
        )
    elif change == 4 and tensors:
        tensor = header[random.choice(tensors)]
        start, end = tensor["data_offsets"]
        tensor["data_offsets"] = random.choice(
            ([start, end + 4], [end, start], [0, 2**62], [start, start], [start + 4, end + 4])
        )
    elif change == 5 and tensors:
        header[random.choice((*NAMES, "x", "")).encode("utf-8", "replace").decode()] = header.pop(
            random.choice(tensors)
        )
    elif change == 6 and len(data) >= 4:
        at = random.randrange(len(data) // 4) * 4
        data = data[:at] + struct.pack("<f", random.choice(_FLOATS[:5])) + data[at + 4 :]
    else:
        text = mutated_json(header, random).encode("utf-8", "replace")
        return len(text).to_bytes(8, "little") + text + data
    text = json.dumps(header).encode("utf-8", "replace")
    return len(text).to_bytes(8, "little") + text + data


_OPCODES = (  # of pickles: numbers, names that run code, containers, ends
    *(
        b"K\x00",
        b"J\xff\xff\xff\x7f",
        b"J\xff\xff\xff\xff",
        b"\x8a\x08" + b"\xff" * 7 + b"\x7f",
        b"L" + b"9" * 400 + b"L\n",
    ),
    *(b"cos\nsystem\n", b"cbuiltins\neval\n", b"ctorch._utils\n_rebuild_tensor_v2\n", b"ccollections\nOrderedDict\n"),
    *(b")", b"]", b"}", b"(", b"t", b"R", b"b", b"0", b"2", b"N", b"\x88", b".", b"s", b"u", b"Q", b"h\x00", b"\x81"),
    *(b"G" + struct.pack(">d", value) for value in _FLOATS[:3]),
    *(b"X" + struct.pack("<I", len(name)) + name for name in (b"storage", b"cpu", b"", b"x" * 99)),
)


def _pickle(content: bytes, random: Random) -> bytes:
    try:
        places = [place for _, _, place in pickletools.genops(content) if place is not None]
    except Exception:  # any, of a stream that is mutated already
        return random.choice(_BYTES)(content, random)
    start, end = random.choice(list(pairwise([*places, len(content)])))
    piece = random.choice((b"", content[start:end] * 2, *_OPCODES, *_OPCODES))
    return content[: random.choice((start, end))] + piece + content[end:]


# Pictures and videos -------------------------------------------------------------------------------------------------


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def _png(content: bytes, random: Random) -> bytes:
    chunks, at = [], 8
    while at + 12 <= len(content):
        length = int.from_bytes(content[at : at + 4], "big")
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    if not chunks or len(chunks[0][1]) != 13:
        return random.choice(_BYTES)(content, random)
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
        chunks[place] = (name, random.choice(_BYTES)(body, random))
    return content[:8] + b"".join(_chunk(name, body) for name, body in chunks)


def _jpeg(content: bytes, random: Random) -> bytes:
    """Change a segment: the frame's sizes, an EXIF block, a table; or leave it out."""
    segments, at = [], 2
    while at + 4 <= len(content) and content[at] == 0xFF and content[at + 1] != 0xDA:
        length = int.from_bytes(content[at + 2 : at + 4], "big")
        segments.append((at, at + 2 + length))
        at += 2 + length
    if not segments:
        return random.choice(_BYTES)(content, random)
    start, end = random.choice(segments)
    segment = content[start:end]
    if segment[1] in (0xC0, 0xC2) and random.random() < 0.6:
        sides = struct.pack(">HH", *(random.choice((0, 1, 100, 20_000, 65_535)) for _ in range(2)))
        segment = segment[:5] + sides + segment[9:]
    else:
        exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01" + random.randbytes(10) + bytes(4)
        added = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + segment
        segment = random.choice((b"", segment * 2, added, segment[:4] + _flipped(segment[4:], random)))
    return content[:start] + segment + content[end:]


_INNER = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"dinf", b"stsd", b"mvex", b"moof", b"traf")


def _boxes(content: bytes, random: Random) -> bytes:
    """Change a box of an MP4 file or a QuickTime film, at any depth; the sizes of the boxes around it follow."""
    boxes, at = [], 0
    while at + 8 <= len(content):
        size = int.from_bytes(content[at : at + 4], "big")
        size = size if 8 <= size <= len(content) - at else len(content) - at
        boxes.append((content[at + 4 : at + 8], content[at + 8 : at + size]))
        at += size
    if not boxes:
        return random.choice(_BYTES)(content, random)
    weights = [30 if name in _INNER else 1 for name, _ in boxes]
    place = random.choices(range(len(boxes)), weights)[0]
    name, body = boxes[place]
    change = random.randrange(10)
    if name in _INNER and change < 7:
        skip = 8 if name == b"stsd" else 0
        boxes[place] = (name, body[:skip] + _boxes(body[skip:], random))
    elif change == 7:
        del boxes[place]
    elif change == 8:
        boxes.insert(place, boxes[place])
    else:
        boxes[place] = (name, random.choice((_binary, _binary, _cut, _spliced))(body, random))
    return b"".join(struct.pack(">I", len(body) + 8) + name + body for name, body in boxes)


def _riff(content: bytes, random: Random) -> bytes:
    """Change a chunk of an AVI or a WebP file; the size of the whole follows."""
    chunks, at = [], 12
    while at + 8 <= len(content):
        size = int.from_bytes(content[at + 4 : at + 8], "little")
        chunks.append((content[at : at + 4], content[at + 8 : at + 8 + size]))
        at += 8 + size + size % 2
    if not chunks:
        return random.choice(_BYTES)(content, random)
    place = random.randrange(len(chunks))
    name, body = chunks[place]
    changes = ([], [chunks[place]] * 2, [(name, _binary(body, random))], [(name, random.choice(_BYTES)(body, random))])
    chunks[place : place + 1] = random.choice((*changes, changes[2], changes[3]))
    whole = b"".join(name + struct.pack("<I", len(body)) + body + b"\0" * (len(body) % 2) for name, body in chunks)
    return content[:4] + struct.pack("<I", len(whole) + 4) + content[8:12] + whole


def _ebml(content: bytes, random: Random) -> bytes:
    """Change the length or the value of an element of a Matroska file."""
    ids = (b"\x18\x53\x80\x67", b"\x16\x54\xae\x6b", b"\xae", b"\xe0", b"\xb0", b"\xba", b"\x1f\x43\xb6\x75", b"\xa3")
    ids += (b"\x15\x49\xa9\x66", b"\x2a\xd7\xb1", b"\x44\x89", b"\x63\xa2", b"\x86", b"\x83", b"\xe7")
    start = random.choice([match.start() for name in ids for match in re.finditer(re.escape(name), content)] or [0])
    at = min(start + random.randrange(1, 9), len(content) - 1)
    value = random.choice((0, 1, 0x7F, 0x80, 0x81, 0xFF, random.randrange(256)))
    return content[:at] + bytes([value]) * random.choice((1, 1, 4)) + content[at + 1 :]


_FORMATS: tuple[tuple[Callable[[bytes], object], Callable[[bytes, Random], bytes]], ...] = (
    (lambda content: content[:6] == b"\x93NUMPY", _npy),
    (lambda content: content[:2] == b"PK", _zip),
    (lambda content: content[:4] == b"\x89PNG", _png),
    (lambda content: content[:2] == b"\xff\xd8", _jpeg),
    (lambda content: content[4:8] in (b"ftyp", b"moov", b"wide"), _boxes),
    (lambda content: content[:4] == b"\x1a\x45\xdf\xa3", _ebml),
    (lambda content: content[:4] == b"RIFF", _riff),
    (lambda content: content[8:9] == b"{" and content[2:8] == bytes(6), _safetensors),
    (lambda content: content[:2] in (b"\x80\x02", b"\x80\x03", b"\x80\x04"), _pickle),
    (lambda content: content[:1] in (b"{", b"[") and b"\n{" not in content, _json),
    (lambda content: b"\0" not in content[:200] and content[:200].decode("utf-8", "ignore").isascii(), _text),
)
