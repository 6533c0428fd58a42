"""Changes of zip archives, whose members are of any format."""

from __future__ import annotations

import io
import re
import warnings
import zipfile
import zlib
from collections.abc import Callable
from functools import lru_cache
from random import Random

from tests.fuzz.changes.arrays import npy
from tests.fuzz.changes.plain import INTEGERS, change_bytes
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
