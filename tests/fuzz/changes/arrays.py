"""Changes of arrays in .npy files."""

from __future__ import annotations

import io
import re
import struct
from random import Random

import numpy as np

from tests.fuzz.changes.plain import FLOATS, change_bytes

_DESCR = ("<f4", "<f8", "<f2", ">f4", "|b1", "|u1", "<i8", "<U3", "|S2", "|O", "<c8", "<M8[ns]", "|V8", "<U0", "x")


def npy(descr: str, by_columns: object, shape: object, values: bytes, version: int = 1) -> bytes:
    """Return an .npy file whose header has these fields, and the right length."""
    header = repr({"descr": descr, "fortran_order": by_columns, "shape": shape}).encode("latin1", "replace") + b"\n"
    length = struct.pack("<H" if version == 1 else "<I", len(header) % 2**16)
    return b"\x93NUMPY" + bytes([version, 0]) + length + header + values


def change_npy(content: bytes, random: Random) -> bytes:
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception:  # any, of a header that is mutated already
        return change_bytes(content, random)
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
            changed[chosen] = random.choice(FLOATS)
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
