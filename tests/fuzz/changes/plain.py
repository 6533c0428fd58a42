"""Changes of plain bytes, whatever they mean."""

from __future__ import annotations

import struct
from collections.abc import Callable
from random import Random

INTEGERS = (0, 1, -1, 2, 255, 2**15, 2**16 - 1, 2**24, 2**31 - 1, -(2**31), 2**32 - 1, 2**53, 2**62, 2**63 - 1)
FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e-300, 1e300, 3.5)


def flipped(content: bytes, random: Random) -> bytes:
    data = bytearray(content or b"\0")
    for _ in range(random.choice((1, 1, 2, 8, 64))):
        data[random.randrange(len(data))] = random.randrange(256)
    return bytes(data)


def cut(content: bytes, random: Random) -> bytes:
    return content[: random.randrange(len(content) + 1)]


def spliced(content: bytes, random: Random) -> bytes:
    start, end = sorted(random.randrange(len(content) + 1) for _ in range(2))
    piece = random.choice((b"", content[start:end] * 2, bytes(random.randrange(1, 5000)), random.randbytes(32)))
    return content[:start] + piece + content[end:]


def change_word(content: bytes, random: Random) -> bytes:
    """Put an extreme number in place of a word, most often near the start, where counts and sizes stand."""
    size = random.choice((1, 2, 4, 4, 8))
    if len(content) < size:
        return content + b"\0"
    at = random.randrange(min(len(content) - size + 1, random.choice((64, 512, len(content)))))
    order = random.choice(("little", "big"))
    if size == 8 and random.random() < 0.4:
        word = struct.pack("<d" if order == "little" else ">d", random.choice(FLOATS))
    else:
        word = (random.choice(INTEGERS) % 256**size).to_bytes(size, order)
    return content[:at] + word + content[at + size :]


_BYTES: tuple[Callable[[bytes, Random], bytes], ...] = (flipped, flipped, cut, spliced, change_word)


def change_bytes(content: bytes, random: Random) -> bytes:
    """Flip, cut, splice or overwrite some bytes."""
    return random.choice(_BYTES)(content, random)
