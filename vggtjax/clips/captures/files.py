"""Files of a capture or a data set: by name, from lists, and read within bounds. Does not import jax."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath

from vggtjax.clips.media.order import in_order
from vggtjax.errors import InputError, one_line, reading

_MOST_BYTES = 2**28  # of a file


def files(folder: Path, ending: str) -> dict[str, Path]:
    """Return files by their names without `ending`, in natural order; none if the folder is missing."""
    paths = [path for path in folder.glob(f"*{ending}") if path.is_file() and not path.name.startswith(".")]
    return {path.name.removesuffix(ending): path for path in in_order(paths)}


def folder_name(path: Path) -> str:
    """Return the name by which a folder was named: a link's own; that of the folder itself for "." and ".."."""
    return path.name if path.name not in ("", "..") else path.resolve().name


def inside(folder: Path, name: str, source: Path) -> Path:
    """Return the path of a name from the file `source`; raises InputError for a path outside `folder`."""
    path = PureWindowsPath(name)  # with slashes, backslashes and drives
    if not path.parts or path.anchor or ".." in path.parts or "\0" in name:
        raise InputError(f"{source} names the file {one_line(name, 80)!r}; expected a path inside {folder}")
    return folder.joinpath(*path.parts)


def read_bytes(path: Path) -> bytes:
    """Return the content of a file; raises InputError for an unreadable or very large file."""
    with reading(path):
        if (size := path.stat().st_size) > _MOST_BYTES:
            raise InputError(f"{path} has {size} bytes; expected at most {_MOST_BYTES}")
        return path.read_bytes()


def read_text(path: Path) -> str:
    """Return the content of a text file; raises InputError as `read_bytes`, and for bytes that are not UTF-8."""
    try:
        return read_bytes(path).decode("utf-8-sig")  # Windows puts a mark of its byte order first
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file; expected UTF-8") from None
