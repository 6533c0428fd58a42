"""Folders of data sets: their sequences, files by name, and names from lists. Does not import jax."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PureWindowsPath

from vggtjax.clips.sources import natural_key
from vggtjax.errors import InputError, reading

_MOST_BYTES = 2**28  # of a file
_MOST_NAMES = 8  # of a message


def sequence_folders(root: Path, holds: Callable[[Path], bool], expected: str, levels: int = 1) -> dict[str, Path]:
    """Return the sequences at or below `root` by name, in natural order.

    Args:
        root: a sequence's folder, or a folder of such folders.
        holds: returns whether a folder is a sequence.
        expected: content of such a folder, for the message.
        levels: depth of folders below `root`; names below the first level have a slash.

    Raises InputError if there is no sequence.
    """
    if holds(root):
        return {root.resolve().name: root}
    parents, folders = [root], {}
    for _ in range(levels):
        children = [child for parent in parents for child in subfolders(parent)]
        folders |= {child.relative_to(root).as_posix(): child for child in children if holds(child)}
        parents = [child for child in children if not holds(child)]
    if not folders:
        raise InputError(f"{root} holds no sequence; expected {expected}, or folders of that kind")
    return dict(sorted(folders.items(), key=lambda item: natural_key(item[1])))


def subfolders(folder: Path) -> list[Path]:
    """Return the folders in a folder in natural order, without hidden ones; none if the folder is missing."""
    try:
        children = [child for child in folder.iterdir() if child.is_dir() and not child.name.startswith(".")]
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise InputError(f"cannot read {folder}: {error.strerror}; check its permissions") from error
    return sorted(children, key=natural_key)


def files(folder: Path, ending: str) -> dict[str, Path]:
    """Return files by their names without `ending`, in natural order; none if the folder is missing."""
    paths = [path for path in folder.glob(f"*{ending}") if path.is_file() and not path.name.startswith(".")]
    return {path.name.removesuffix(ending): path for path in sorted(paths, key=natural_key)}


def inside(folder: Path, name: str, source: Path) -> Path:
    """Return the path of a name from the file `source`; raises InputError for a path outside `folder`."""
    path = PureWindowsPath(name)  # with slashes, backslashes and drives
    if not path.parts or path.anchor or ".." in path.parts or "\0" in name:
        raise InputError(f"{source} names the file {name!r}; expected a path inside {folder}")
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
        return read_bytes(path).decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file; expected UTF-8") from None


def listed(names: list[str]) -> str:
    """Return names for a message: the first few, and the number of the others."""
    shown = ", ".join(names[:_MOST_NAMES])
    return shown if len(names) <= _MOST_NAMES else f"{shown} and {len(names) - _MOST_NAMES} more"
