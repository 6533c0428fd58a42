"""Writing files so that an interrupted run never leaves one that looks whole."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from vggtjax.errors import OutputError

_MOST_JSON_BYTES = 2**24


@contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it is synced and renamed to `path`, else removed.

    Raises OutputError where the folder cannot be written or the disk is full.
    """
    path = Path(path)
    with _explaining(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=f".partial{path.suffix}", dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            temporary.chmod(0o666 & ~_umask())
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def staging(folder: str | Path) -> Iterator[Path]:
    """Yield a new temporary folder inside `folder` (made if missing), removed at the end whatever happens.

    Write everything there, then rename into place: a rename within one folder cannot run out of space.
    Raises OutputError where the folder cannot be written or the disk is full.
    """
    folder = Path(folder)
    with _explaining(folder):
        folder.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=".partial-", dir=folder))
        try:
            temporary.chmod(0o777 & ~_umask())
            yield temporary
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def check_free(folder: Path, names: Sequence[str], *, replaced: bool, what: str) -> None:
    """Make sure that files of these names can be written in `folder`, before hours are spent on them.

    Args:
        folder: need not be there; it is not made.
        names: of the files.
        replaced: whether what is there is an earlier one of the same kind, and may go.
        what: that kind, for the message.

    Raises OutputError where the folder cannot be made or written, or holds such files that may not go.
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
    """Return whether a file is small JSON that says to be of this format."""
    try:
        if path.stat().st_size > _MOST_JSON_BYTES:
            return False
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(values, dict) and values.get("format") == name


@contextmanager
def _explaining(path: Path) -> Iterator[None]:
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"cannot write {path}: {reason}; choose a folder that is writable and has space") from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
