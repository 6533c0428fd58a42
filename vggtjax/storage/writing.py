"""Writing files and folders so that an interrupted run never leaves a partial one under the final name."""

from __future__ import annotations

import errno
import os
import re
import shutil
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from secrets import token_hex
from typing import Any

from filelock import FileLock, Timeout

from vggtjax.errors import InputError, OutputError
from vggtjax.storage.json_values import read_json

_MARK = ".vggtjax-partial-"  # of temporary folders
_LEFTOVER = re.compile(re.escape(_MARK) + r"[0-9a-f]{16}(\.lock)?")
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}  # of file systems without locks
_OLD = 24 * 3600  # seconds; no writer takes this long
_TRIES = 8


@contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path for a file or folder; on success it is synced and renamed to `path`, else removed.

    Raises OutputError if the folder cannot be written or the disk is full.
    """
    path = Path(path)
    with write_errors(path), _staged(path.parent) as staged:
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
    with write_errors(Path(folder)), _staged(Path(folder)) as staged:
        yield staged


@contextmanager
def locked_folder(folder: str | Path, what: str, wait: float = 0) -> Iterator[None]:
    """Hold the lock of a folder (made if missing), so that only one run at a time writes `what` into the folder.

    The operating system releases the lock of a killed process. A file system without locks is written without a lock,
    with a warning. Raises OutputError where another run holds the lock for `wait` seconds, or where the folder cannot
    be written.
    """
    path = Path(folder) / ".vggtjax.lock"
    with write_errors(path.parent):
        try:
            lock = _acquire(path, wait)
        except Timeout:
            message = f"another run is writing {what} into {folder}; wait for it or choose another folder"
            raise OutputError(message) from None
    if lock is None:
        warnings.warn("the file system has no locks; start only one run for each output folder", stacklevel=1)  # once
    try:
        yield
    finally:
        _release(lock)


def check_free(folder: Path, names: Sequence[str], *, replaced: bool, what: str) -> None:
    """Check that files of these names can be written in `folder`, before hours of computation.

    Of a missing folder the nearest parent is tried. `replaced` tells whether existing files belong to an earlier
    output of this kind (`what`), and may be replaced. Raises OutputError if the folder cannot be made or written, or
    holds files that may not be replaced.
    """
    taken = [name for name in names if os.path.lexists(folder / name)]
    if taken and not replaced:
        raise OutputError(
            f"{folder / taken[0]} exists and is not part of an earlier {what}, so it is not replaced; "
            "choose another folder or move it away"
        )
    with write_errors(folder):
        with suppress(FileNotFoundError):
            os.stat(folder)  # noqa: PTH116 - raises for a name that is too long, where lexists says False
        parent = next(parent for parent in (folder, *folder.absolute().parents) if os.path.lexists(parent))
        with _staged(parent):
            pass


def check_file(path: Path, *, overwrite: bool, sources: Iterable[Path] = ()) -> None:
    """Check that a file may be written, before the work: one of the sources never, another one that exists on request.

    Raises OutputError where it may not.
    """
    if any(_is_same(path, source) for source in sources):
        raise OutputError(f"{path} is the source, which is never replaced; choose another name")
    if os.path.lexists(path) and not overwrite:
        raise OutputError(f"{path} exists and is not replaced; choose another name, or give --overwrite")


def _is_same(path: Path, source: Path) -> bool:
    try:
        return path.samefile(source)
    except (OSError, ValueError):  # a missing file, or words that are no path
        return False


def says_format(path: Path, name: str) -> bool:
    """Return whether a file is JSON whose "format" is `name`."""
    try:
        return read_json(path, dict[str, Any], "file").get("format") == name
    except InputError:
        return False


@contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Turn an OSError of the body into an OutputError, which names `path` and the reason."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        blocked = _blocked(path) if isinstance(error, FileExistsError | NotADirectoryError) else ""
        reason = blocked or error.strerror or error
        raise OutputError(f"cannot write {path}: {reason}; choose a folder that is writable and has space") from error


def _blocked(path: Path) -> str:
    """Return in words that the path, or a parent of it, exists and is no folder; nothing where all are folders."""
    for part in (path, *path.parents):
        if os.path.lexists(part) and not part.is_dir():
            if part.is_symlink() and not part.exists():
                return f"{part} is a link to {part.readlink()}, which does not exist"
            return f"{part} is {'a file' if part.is_file() else 'not a folder'}"
    return ""


@contextmanager
def _staged(folder: Path) -> Iterator[Path]:
    """Yield a new temporary folder. Other writers see its lock file beside it, and do not remove the folder."""
    lock, staged = None, folder
    for _ in range(_TRIES):  # another writer may remove our lock file, as a leftover, before we lock it: try again
        staged = folder / f"{_MARK}{token_hex(8)}"
        with suppress(Timeout):
            lock = _acquire(folder / f"{staged.name}.lock")
            break
    try:
        _remove_leftovers(folder)
        staged.mkdir()
        yield staged
    finally:
        try:
            shutil.rmtree(staged, ignore_errors=True)
        finally:
            _release(lock)


def remove_leftovers(folder: Path) -> None:
    """Remove what killed writers left in a folder: their locks are free, or they have no lock and are old."""
    for path in [Path(entry) for entry in os.scandir(folder) if _LEFTOVER.fullmatch(entry.name)]:
        with suppress(OSError):  # files of another user, or of a writer that ends now
            if path.suffix == ".lock":
                if (lock := _acquire(path)) is not None:
                    shutil.rmtree(path.with_suffix(""), ignore_errors=True)
                    _release(lock)
            elif time.time() - path.lstat().st_mtime > _OLD and not path.with_suffix(".lock").exists():
                shutil.rmtree(path)


_remove_leftovers = lru_cache(remove_leftovers)  # once: a scan of 20,000 files takes as long as writing 50


def _acquire(path: Path, wait: float = 0) -> FileLock | None:
    """Return the lock of a file, made with its folder if missing; None if the file system has no locks.

    Raises Timeout, an OSError, if another writer holds the lock for `wait` seconds.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path, timeout=wait, thread_local=False, fallback_to_soft=False)
    try:
        lock.acquire()
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        path.unlink(missing_ok=True)
        return None
    return lock


def _release(lock: FileLock | None) -> None:
    if lock is None:
        return
    try:
        with suppress(OSError):  # it is gone, or open on Windows
            Path(lock.lock_file).unlink()  # before the release: afterwards another process may hold it
    finally:  # also where Ctrl-C comes meanwhile
        lock.release()
