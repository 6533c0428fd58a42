"""Folders of data sets: sequences in them, files by name, and names that other files give. Does not import jax."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PureWindowsPath

from vggtjax.clips.sources import natural_key
from vggtjax.errors import InputError

_MOST_BYTES = 2**28  # of a file that is read whole
_MOST_NAMED = 8  # in a message


def sequence_folders(root: Path, holds: Callable[[Path], bool], expected: str, levels: int = 1) -> dict[str, Path]:
    """Return the sequences that `root` is or has in it, by name, in natural order.

    Args:
        root: a sequence's folder, or a folder of such folders.
        holds: whether a folder is that of a sequence.
        expected: what such a folder has, for the message.
        levels: how many folders deep to look; names from below the first level have a slash in them.

    Raises InputError where there is none.
    """
    if holds(root):
        return {root.resolve().name: root}
    parents, found = [root], {}
    for _ in range(levels):
        children = [child for parent in parents for child in subfolders(parent)]
        found |= {child.relative_to(root).as_posix(): child for child in children if holds(child)}
        parents = [child for child in children if not holds(child)]
    if not found:
        raise InputError(f"{root} holds no sequence; expected {expected}, or folders of that kind")
    return dict(sorted(found.items(), key=lambda item: natural_key(item[1])))


def subfolders(folder: Path) -> list[Path]:
    """Return the folders in a folder in natural order, without hidden ones; none where it is not there."""
    try:
        children = [child for child in folder.iterdir() if child.is_dir() and not child.name.startswith(".")]
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise InputError(f"cannot look into {folder}: {error.strerror}; check its permissions") from error
    return sorted(children, key=natural_key)


def files(folder: Path, ending: str) -> dict[str, Path]:
    """Return the files whose names end so, by the rest of the name, in natural order; none where no folder is."""
    paths = [path for path in folder.glob(f"*{ending}") if path.is_file() and not path.name.startswith(".")]
    return {path.name.removesuffix(ending): path for path in sorted(paths, key=natural_key)}


def inside(folder: Path, name: str, source: Path) -> Path:
    """Return the path of a name that the file `source` gives; raises InputError for one that leaves `folder`."""
    path = PureWindowsPath(name)  # splits at both slashes and knows drives
    if not path.parts or path.anchor or ".." in path.parts or "\0" in name:
        raise InputError(f"{source} names the file {name!r}; expected a path inside {folder}")
    return folder.joinpath(*path.parts)


def read_bytes(path: Path) -> bytes:
    """Return a whole file; raises InputError for one that cannot be read or is absurdly large."""
    try:
        if (size := path.stat().st_size) > _MOST_BYTES:
            raise InputError(f"{path} has {size} bytes; expected at most {_MOST_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def read_text(path: Path) -> str:
    """Return a text file; raises what `read_bytes` raises, and InputError for bytes that are not UTF-8."""
    try:
        return read_bytes(path).decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file; expected UTF-8") from None


def listed(names: list[str]) -> str:
    """Return names for a message: the first few, and how many more."""
    shown = ", ".join(names[:_MOST_NAMED])
    return shown if len(names) <= _MOST_NAMED else f"{shown} and {len(names) - _MOST_NAMED} more"
