"""Archives of apps, unpacked for as long as they are in use. Does not import jax."""

from __future__ import annotations

import lzma
import shutil
import struct
import tempfile
import weakref
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from weakref import WeakValueDictionary

from vggtjax.clips.captures.files import inside
from vggtjax.errors import InputError, one_line, reading

_MOST_FILES = 200_000
_SPARE_BYTES = 2**26  # that the files may have beyond twice the archive: pictures and depth do not shrink much more
_SEPARATORS = "\\:"
_BROKEN = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error),
    *(ValueError, EOFError, RuntimeError, NotImplementedError),
)


class Unpacked:
    """A temporary folder with the content of an archive; it is removed when nothing refers to this object any more."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="vggtjax-capture-"))
        weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    @contextmanager
    def named(self, path: Path) -> Iterator[None]:
        """Let errors of the body name the archive `path`, which the user knows, instead of the temporary folder."""
        try:
            yield
        except InputError as error:
            raise type(error)(str(error).replace(str(self.folder), str(path))) from None


_KNOWN: WeakValueDictionary[tuple[Path, int, int, tuple[str, ...]], Unpacked] = WeakValueDictionary()


def unpacked(path: Path, wanted: tuple[str, ...]) -> Unpacked:
    """Return the content of a zip in a temporary folder; an archive that is in use is not unpacked again.

    Args:
        path: the archive.
        wanted: names at its top, of files or folders, all there; others are left out.

    Raises InputError for a file that is not a whole zip or lacks one of the names, names outside the folder, and more
    bytes than an archive of its size can honestly hold.
    """
    with reading(path):
        stat = path.stat()
    key = (path.resolve(), stat.st_size, stat.st_mtime_ns, wanted)
    if (known := _KNOWN.get(key)) is not None:
        return known
    made = Unpacked()
    try:
        with reading(path), zipfile.ZipFile(path) as archive:
            for member in _members(path, archive, stat.st_size, wanted):
                target = inside(made.folder, member.filename, path)
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(member) as source, target.open("wb") as file:
                    shutil.copyfileobj(source, file)
    except InputError:
        raise
    except _BROKEN as error:
        raise InputError(
            f"{path} is not a whole zip, as Record3D writes it ({one_line(str(error), 150)}); export it again"
        ) from None
    _KNOWN[key] = made
    return made


def _members(path: Path, archive: zipfile.ZipFile, size: int, wanted: tuple[str, ...]) -> list[zipfile.ZipInfo]:
    members = [member for member in archive.infolist() if not member.filename.endswith("/")]
    total, most = sum(member.file_size for member in members), 2 * size + _SPARE_BYTES
    if len(members) > _MOST_FILES or total > most:
        raise InputError(f"{path} has {len(members)} files of {total} bytes; expected at most {_MOST_FILES} of {most}")
    for member in members:
        inside(path, member.filename, path)
        if any(letter in member.filename for letter in _SEPARATORS):
            raise InputError(
                f"{path} names the file {one_line(member.filename, 80)!r}; expected a path inside the archive"
            )
    tops = [PurePosixPath(member.filename).parts[0] for member in members]
    if missing := [name for name in wanted if name not in tops]:
        raise InputError(
            f"{path} has no {missing[0]} at its top; expected a file that Record3D wrote: zip the content of a folder, "
            "not the folder"
        )
    return [member for top, member in zip(tops, members, strict=True) if top in wanted]
