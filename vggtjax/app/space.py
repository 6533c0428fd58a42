"""The folder of uploads and its bounded size, also while several arrive at once."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from vggtjax.app.limits import Limits
from vggtjax.errors import InputError

_KEPT_UPLOADS = 3  # full uploads, beside those of waiting jobs, which jobs keep by a second link
_FORM = 2**20  # bytes around the files of an upload
_FILE = 4096  # least bytes of a file on disk


class Space:
    """Uploads lie in folders of `folder`, and those that still arrive in `folder` itself."""

    def __init__(self, folder: Path, limits: Limits) -> None:
        self._folder, self._limits = folder, limits
        self._lock = threading.Lock()
        self._coming: list[int] = []

    def reserve(self, coming: int) -> None:
        """Remove the oldest uploads until `coming` bytes fit beside the others; `release` them once they arrived.

        Raises InputError for too many bytes, or where others that still arrive need the space.
        """
        limit = self._limits.upload_bytes
        if coming > limit + _FORM:
            raise InputError(f"the upload has {coming / 1e6:.1f} MB; send at most {self._limits.max_upload_mb} MB")
        with self._lock:
            files = list(_files(self._folder))
            # What arrived already of an upload counts twice: as a file and as reserved.
            used = sum(size for _, size, _ in files) + sum(self._coming) + coming
            finished = sorted(file for file in files if file[2].parent != self._folder)
            for _, size, path in finished:
                if used <= _KEPT_UPLOADS * limit:
                    break
                path.unlink(missing_ok=True)
                with suppress(OSError):  # not empty
                    path.parent.rmdir()
                used -= size
            if used > _KEPT_UPLOADS * limit:
                raise InputError("too many uploads arrive at once; try again in a minute")
            self._coming.append(coming)

    def release(self, coming: int) -> None:
        """Forget a reservation; after the last one, remove what broken uploads left."""
        with self._lock:
            self._coming.remove(coming)
            if not self._coming:
                for path in self._folder.iterdir():
                    if path.is_file():
                        path.unlink(missing_ok=True)

    @contextmanager
    def reserved(self, coming: int) -> Iterator[None]:
        self.reserve(coming)
        try:
            yield
        finally:
            self.release(coming)


def _files(folder: Path) -> Iterator[tuple[float, int, Path]]:
    """Yield time, bytes on disk and path of each file."""
    for path in folder.rglob("*"):
        with suppress(FileNotFoundError):  # removed or renamed meanwhile
            if path.is_file():
                state = path.stat()
                yield state.st_mtime, max(state.st_size, _FILE), path
