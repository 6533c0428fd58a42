"""Writing files and folders so that an interrupted run never leaves a partial one under the final name."""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from typing import Any

from filelock import FileLock, Timeout

from vggtjax.errors import InputError, OutputError
from vggtjax.storage.json_values import read_json

_LEFTOVER = re.compile(r"\.partial-\w+(\.lock)?|\..+\.partial(\.\w+)?")  # temporary names, of earlier versions too
_OLD = 24 * 3600  # seconds; no writer takes this long
_TRIES = 8


@contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path for a file or folder; on success it is synced and renamed to `path`, else removed.

    Raises OutputError if the folder cannot be written or the disk is full.
    """
    path = Path(path)
    with _explaining(path), _staged(path.parent) as staged:
        temporary = staged / path.name
        yield temporary
        if not temporary.is_dir():
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
        temporary.replace(path)


@contextmanager
def staging(folder: str | Path) -> Iterator[Path]:
    """Yield a new temporary folder inside `folder` (made if missing), and remove it at the end in every case.

    Write all files there, then rename them into place: a rename within one folder needs no space.
    Raises OutputError if the folder cannot be written or the disk is full.
    """
    with _explaining(Path(folder)), _staged(Path(folder)) as staged:
        yield staged


@contextmanager
def locked_folder(folder: str | Path, what: str) -> Iterator[None]:
    """Keep other runs, which lock the same folder (made if missing), from writing `what` there at the same time.

    The operating system releases the lock of a killed process. Raises OutputError where another run holds the lock, or
    where the folder cannot be written.
    """
    path = Path(folder) / ".vggtjax.lock"
    with _explaining(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = _acquire(path)
    if lock is None:
        raise OutputError(f"another run is writing {what} into {folder}; wait for it or choose another folder")
    try:
        yield
    finally:
        _release(lock)


def check_free(folder: Path, names: Sequence[str], *, replaced: bool, what: str) -> None:
    """Check that files of these names can be written in `folder`, before hours of computation.

    A missing folder is made for the check, and removed. `replaced` tells whether existing files belong to an earlier
    output of this kind (`what`), and may be replaced. Raises OutputError if the folder cannot be made or written, or
    holds files that may not be replaced.
    """
    taken = [name for name in names if os.path.lexists(folder / name)]
    if taken and not replaced:
        raise OutputError(
            f"{folder / taken[0]} exists and is not part of an earlier {what}, so it is not replaced; "
            "choose another folder or move it away"
        )
    new = [parent for parent in (folder, *folder.parents) if not os.path.lexists(parent)]
    with staging(folder):
        pass
    for parent in new:
        parent.rmdir()


def says_format(path: Path, name: str) -> bool:
    """Return whether a file is JSON whose "format" is `name`."""
    try:
        return read_json(path, dict[str, Any], "file").get("format") == name
    except InputError:
        return False


@contextmanager
def _explaining(path: Path) -> Iterator[None]:
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"cannot write {path}: {reason}; choose a folder that is writable and has space") from error


@contextmanager
def _staged(folder: Path) -> Iterator[Path]:
    """Yield a new temporary folder. Other writers see its lock file beside it, and do not remove the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(folder)
    lock, name = None, ""
    for _ in range(_TRIES):  # another writer may remove our lock file, as a leftover, before we lock it: try again
        name = f".partial-{token_hex(4)}"
        try:
            lock = _acquire(folder / f"{name}.lock")
        except OSError:  # a file system without locks: leftovers are removed by their age
            break
        if lock is not None:
            break
    staged = folder / name
    try:
        staged.mkdir()
        yield staged
    finally:
        shutil.rmtree(staged, ignore_errors=True)
        if lock is not None:
            _release(lock)


def _remove_leftovers(folder: Path) -> None:
    """Remove what killed writers left in a folder: their locks are free, or their files are old."""
    for path in [Path(entry) for entry in os.scandir(folder) if _LEFTOVER.fullmatch(entry.name)]:
        with suppress(OSError):  # files of another user, or of a writer that ends now
            if path.suffix == ".lock":
                if (lock := _acquire(path)) is not None:
                    shutil.rmtree(path.with_suffix(""), ignore_errors=True)
                    _release(lock)
            elif time.time() - path.lstat().st_mtime > _OLD and not path.with_name(f"{path.name}.lock").exists():
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _acquire(path: Path) -> FileLock | None:
    """Return the lock of a file that is made if missing; None if another writer holds the lock."""
    lock = FileLock(path, timeout=0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        return None
    return lock


def _release(lock: FileLock) -> None:
    with suppress(OSError):  # Windows cannot remove an open file
        Path(lock.lock_file).unlink(missing_ok=True)  # before the release: afterwards another process may hold it
    lock.release()
