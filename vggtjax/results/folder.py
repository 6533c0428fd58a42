"""Replacing the files of an earlier result as a whole, however the process ends.

The new files are written in a hidden folder beside the old ones. Once they are whole, that folder is renamed to
`.replacing`, with new/, old/ and unmoved/ in it. Then the old files move to old/, the archive first; unmoved/ is
renamed to moved/; and the new files move into the folder, the archive last. While unmoved/ stands, all files in the
folder are old. If the process is killed, `.replacing` stays, and the next save finishes the moves. Until then
`find_archive` returns the archive in the folder or, if it is missing, the archive in new/.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

from vggtjax.errors import OutputError
from vggtjax.results.archive import ARCHIVE_NAME, saved_names
from vggtjax.results.saving import NAMES, OPTIONAL_FILES
from vggtjax.storage.writing import check_free, locked_folder, staging

_ALL = (*NAMES, *OPTIONAL_FILES, ARCHIVE_NAME)
ADDED = ("preview/turntable.mp4", "preview/viewer.html")  # by commands, to a result that is there
_REPLACING = ".replacing"
_WAIT = 60  # seconds for the moves of another process


def find_archive(folder: Path) -> Path:
    """Return the path of the archive in the folder of a result, also where its replacement was interrupted."""
    pending = folder / _REPLACING / "new" / ARCHIVE_NAME
    return pending if pending.is_file() and not (folder / ARCHIVE_NAME).is_file() else folder / ARCHIVE_NAME


def check_folder(folder: Path, names: Sequence[str] = NAMES) -> None:
    """Finish an interrupted replacement in `folder`, then check that a result with files of these names can be saved.

    Raises OutputError where the folder cannot be made or written, holds files of our names that are not part of an
    earlier result, or is locked by another process for a minute.
    """
    with locked_folder(folder, "a result", _WAIT) if folder.is_dir() else nullcontext():
        _finish(folder)
        ours = saved_names(folder / ARCHIVE_NAME)
        others = [name for name in (ARCHIVE_NAME, *names) if name not in ours]
        check_free(folder, others, replaced=False, what="result")


def check_no_part(files: Iterable[Path], result: Path, *, what: str, foreign: bool = False) -> None:
    """Raise OutputError where a file is part of a saved result, which is replaced as a whole or not at all.

    Args:
        files: those to check; a missing one is no part, nor is one that a command added to a result that was there.
        result: the folder of a result, or a file in it.
        what: what would happen to the file, and what to do, such as "no film replaces it; choose another name".
        foreign: the result is another program's; every file in its folder is a part.
    """
    folder = (result if result.is_dir() else result.parent).resolve()
    names = saved_names(find_archive(folder)) if result.exists() else ()
    for file in files if names or foreign else ():
        place = file.resolve()
        if not place.is_relative_to(folder) or not place.exists() or place == folder:
            continue
        name = place.relative_to(folder)
        if name.as_posix() not in ADDED and (foreign or name.parts[0] in names):
            raise OutputError(f"{file} is part of the result in {folder}, and {what}")


@contextmanager
def replacing(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Yield an empty folder, whose files (the archive, and files of these names) replace those of `folder` at the end.

    If anything fails, the earlier result is left untouched. Raises what `check_folder` raises, and ValueError for a new
    file of another name.
    """
    check_folder(folder, names)
    with staging(folder) as staged:
        for name in ("new", "old", "unmoved"):
            (staged / name).mkdir()
        yield staged / "new"
        if unknown := {path.name for path in (staged / "new").iterdir()} - {ARCHIVE_NAME, *names}:
            raise ValueError(f"{sorted(unknown)} would not be moved; add the name to GROUPS or OPTIONAL_FILES")
        with locked_folder(folder, "a result", _WAIT):
            _finish(folder)
            staged.rename(folder / _REPLACING)
            _swap(folder)


def _finish(folder: Path) -> None:
    """Do the remaining moves of an interrupted replacement, if there is one; the caller holds the folder's lock."""
    if os.path.lexists(folder / _REPLACING):
        with staging(folder):
            _swap(folder)


def _swap(folder: Path) -> None:
    """Do the remaining moves of a replacement; undo them if one fails."""
    new, old, unmoved = (folder / _REPLACING / name for name in ("new", "old", "unmoved"))
    moves = [(unmoved, unmoved.with_name("moved")), *((new / name, folder / name) for name in _ALL)]
    if os.path.lexists(unmoved):  # all files in the folder are old
        archive = old / ARCHIVE_NAME if os.path.lexists(old / ARCHIVE_NAME) else folder / ARCHIVE_NAME
        moves = [(folder / name, old / name) for name in saved_names(archive)] + moves
    moves = [(source, target) for source, target in moves if os.path.lexists(source)]
    try:
        for source, target in moves:
            source.rename(target)
    except BaseException:
        for source, target in reversed(moves):
            if os.path.lexists(target) and not os.path.lexists(source):
                target.rename(source)
        if os.path.lexists(unmoved) and not any(old.iterdir()):  # all moves are undone
            _remove(folder)
        raise
    _remove(folder)


def _remove(folder: Path) -> None:
    """Remove the folder of a replacement, renamed first: half of it would look like an interrupted replacement."""
    with staging(folder) as rubbish:
        (folder / _REPLACING).rename(rubbish / "replaced")
