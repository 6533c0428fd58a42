"""Clips at URLs, copied to this machine for as long as they are needed. Does not import jax."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path
from threading import Lock
from typing import Any

from vggtjax.errors import ClipError
from vggtjax.storage.remote import download, is_url, local_path
from vggtjax.storage.writing import staging


class Fetched:
    """A hidden folder among the system's temporary files, which TMPDIR moves, with copies of clips.

    It is there from the first clip at a URL to the end of the context, and private to the user. What a killed process
    has left is removed by the next one.
    """

    def __init__(self) -> None:
        self._stack, self._lock = ExitStack(), Lock()
        self._folder: Path | None = None
        self._copies: dict[str, Path] = {}

    def __enter__(self) -> Fetched:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def local(self, name: str, source: Any) -> Any:
        """Return a source of frames as it is, or the path of a copy of what a URL names, until `drop(name)`.

        Raises ClipError for a URL that cannot be read.
        """
        if not is_url(source):
            return local_path(source) if isinstance(source, str) else source
        with self._lock:
            if self._folder is None:
                self._folder = self._stack.enter_context(staging(tempfile.gettempdir())) / "clips"
                self._folder.mkdir(mode=0o700)
        self._copies[name] = folder = Path(tempfile.mkdtemp(dir=self._folder))
        return str(download(source, folder, error=ClipError))

    def drop(self, name: str) -> None:
        """Remove the copy of a clip, if there is one."""
        if (folder := self._copies.pop(name, None)) is not None:
            shutil.rmtree(folder, ignore_errors=True)
