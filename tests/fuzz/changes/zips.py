"""Changes of zip archives, whose members are of any format, and of arrays in .npy files."""

from __future__ import annotations

import io
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from functools import lru_cache
from random import Random

import numpy as np

from tests.fuzz.changes.plain import FLOATS, INTEGERS, change_bytes
from tests.fuzz.changes.text import NAMES

_BOMB_BYTES = (2**26 - 2**22, 2**28 + 2**25)  # of zeros: what an archive may declare, and what is refused


@lru_cache(maxsize=4)
def _bomb(name: str, size: int) -> bytes:
    """Return a zip with an .npy file of zeros, without holding the zeros."""
    file = io.BytesIO()
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open(name, "w") as member,
    ):
        member.write(npy("|u1", False, (size,), b""))
        for _ in range(size // 2**22):
            member.write(bytes(2**22))
    return file.getvalue()


def change_zip(content: bytes, random: Random, *, mutated: Callable[[bytes, Random], bytes]) -> bytes:
    """Change a member by what `mutated` makes of its content, or the list of members, or how they are packed."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(info.file_size for info in archive.infolist()) > _BOMB_BYTES[0] // 4:  # a bomb already
                return change_bytes(content, random)
            members = [(info.filename, archive.read(info), info.compress_type) for info in archive.infolist()]
            if not members:
                return change_bytes(content, random)
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError):  # changed before: not read any more
        return change_bytes(content, random)
    at = random.randrange(len(members))
    name, data, method = members[at]
    change = random.randrange(20)
    if change < 11:
        members[at] = (name, mutated(data, random), method)
    elif change == 11:
        other = random.choice((*NAMES, "x.npy", name + "/", "")).encode("utf-8", "replace").decode()
        members[at] = (other, data, method)
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
        return _bomb(name, random.choice(_BOMB_BYTES))
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
    return content[:at] + (random.choice(INTEGERS) % 256**width).to_bytes(width, "little") + content[at + width :]


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
