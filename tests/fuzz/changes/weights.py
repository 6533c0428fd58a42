"""Changes of safetensors files and of pickles."""

from __future__ import annotations

import json
import pickletools
import struct
from itertools import pairwise
from random import Random

from tests.fuzz.changes.plain import FLOATS, change_bytes
from tests.fuzz.changes.text import NAMES, WORDS, change_json, mutated_json


def change_safetensors(content: bytes, random: Random) -> bytes:
    length = int.from_bytes(content[:8], "little")
    try:
        header, data = json.loads(content[8 : 8 + length]), content[8 + length :]
    except ValueError:
        return change_bytes(content, random)
    tensors = [name for name in header if name != "__metadata__"]
    change = random.randrange(8)
    if change < 2 and isinstance(metadata := header.get("__metadata__"), dict) and metadata:
        key = random.choice(list(metadata))
        text = change_json(str(metadata[key]).encode(), random).decode("utf-8", "replace")
        metadata[key] = text if random.random() < 0.7 else random.choice(WORDS)
    elif change == 2 and tensors:
        kinds = ("F32", "F64", "BF16", "I8", "U64", "F8_E4M3", "BOOL", "x", 5)
        header[random.choice(tensors)]["dtype"] = random.choice(kinds)
    elif change == 3 and tensors:
        tensor = header[random.choice(tensors)]
        turned = tensor["shape"][::-1]
        tensor["shape"] = random.choice(([2**40], [0], [], [-1], [1] * 200, [2**62, 2**62], turned, [1, *turned]))
    elif change == 4 and tensors:
        tensor = header[random.choice(tensors)]
        start, end = tensor["data_offsets"]
        places = ([start, end + 4], [end, start], [0, 2**62], [start, start], [start + 4, end + 4])
        tensor["data_offsets"] = random.choice(places)
    elif change == 5 and tensors:
        name = random.choice((*NAMES, "x", "")).encode("utf-8", "replace").decode()
        header[name] = header.pop(random.choice(tensors))
    elif change == 6 and len(data) >= 4:
        at = random.randrange(len(data) // 4) * 4
        data = data[:at] + struct.pack("<f", random.choice(FLOATS[:5])) + data[at + 4 :]
    else:
        text = mutated_json(header, random).encode("utf-8", "replace")
        return len(text).to_bytes(8, "little") + text + data
    text = json.dumps(header).encode("utf-8", "replace")
    return len(text).to_bytes(8, "little") + text + data


_OPCODES = (  # of pickles: numbers, names that run code, containers, ends
    *(b"K\x00", b"J\xff\xff\xff\x7f", b"\x8a\x08" + b"\xff" * 7 + b"\x7f", b"L" + b"9" * 400 + b"L\n"),
    *(b"cos\nsystem\n", b"cbuiltins\neval\n", b"ctorch._utils\n_rebuild_tensor_v2\n", b"ccollections\nOrderedDict\n"),
    *(b")", b"]", b"}", b"(", b"t", b"R", b"b", b"0", b"2", b"N", b"\x88", b".", b"s", b"u", b"Q", b"h\x00", b"\x81"),
    *(b"G" + struct.pack(">d", value) for value in FLOATS[:3]),
    *(b"X" + struct.pack("<I", len(name)) + name for name in (b"storage", b"cpu", b"", b"x" * 99)),
)


def change_pickle(content: bytes, random: Random) -> bytes:
    try:
        places = [place for _, _, place in pickletools.genops(content) if place is not None]
    except Exception:  # any, of a stream that is mutated already
        return change_bytes(content, random)
    start, end = random.choice(list(pairwise([*places, len(content)])))
    piece = random.choice((b"", content[start:end] * 2, *_OPCODES, *_OPCODES))
    return content[: random.choice((start, end))] + piece + content[end:]
