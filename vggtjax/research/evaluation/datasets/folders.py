"""Folders of data sets: their sequences, and names for messages. Does not import jax."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from vggtjax.clips.captures.files import files, folder_name
from vggtjax.clips.media.order import in_order
from vggtjax.errors import InputError

_MOST_NAMES = 8  # of a message


def sequence_folders(root: Path, holds: Callable[[Path], bool], expected: str, levels: int = 1) -> dict[str, Path]:
    """Return the sequences at or below `root` by name, in natural order.

    Args:
        root: a sequence's folder, or a folder of such folders.
        holds: returns whether a folder is a sequence.
        expected: a path in such a folder, for the message.
        levels: depth of folders below `root`; names below the first level have a slash.

    Raises InputError if there is no sequence.
    """
    if holds(root):
        return {folder_name(root): root}
    parents, folders = [root], {}
    for _ in range(levels):
        children = [child for parent in parents for child in subfolders(parent)]
        folders |= {child.relative_to(root).as_posix(): child for child in children if holds(child)}
        parents = [child for child in children if not holds(child)]
    if not folders:
        below = "/".join(("SCENE", "SEQUENCE")[-levels:])
        raise InputError(f"{root} holds no sequence; expected {root / expected} or {root / below / expected}")
    return dict(in_order(folders.items(), lambda item: item[1]))


def subfolders(folder: Path) -> list[Path]:
    """Return the folders in a folder in natural order, without hidden ones; none if the folder is missing."""
    try:
        children = [child for child in folder.iterdir() if child.is_dir() and not child.name.startswith(".")]
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise InputError(f"cannot read {folder}: {error.strerror}; check its permissions") from error
    return in_order(children)


def pictures_of(folder: Path, ending: str) -> list[Path]:
    """Return the pictures of a sequence in natural order; raises InputError where there are none."""
    if pictures := list(files(folder, ending).values()):
        return pictures
    raise InputError(f"the sequence has no pictures; expected {folder / f'*{ending}'}")


def listed(names: list[str]) -> str:
    """Return names for a message: the first few, and the number of the others."""
    shown = ", ".join(names[:_MOST_NAMES])
    return shown if len(names) <= _MOST_NAMES else f"{shown} and {len(names) - _MOST_NAMES} more"
