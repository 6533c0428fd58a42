"""Where the results of a batch go: a folder, or a folder at a URL, with a folder for every clip. Does not import jax.

The result of a clip appears whole or not at all; another process may write there, too.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from vggtjax.clips.fingerprint import fingerprint
from vggtjax.clips.sources import ClipSource, open_source
from vggtjax.errors import InputError, VggtjaxError, one_line
from vggtjax.pipeline.batch.shards import SETTLING, Shard, running
from vggtjax.results.archive import ARCHIVE_NAME, is_result, source_fingerprint
from vggtjax.results.disk import announce
from vggtjax.storage.json_values import parse_json, read_json
from vggtjax.storage.remote import check_url, exists, is_url, list_url, local_path, read_url, shown, upload, write_url
from vggtjax.storage.writing import check_free, locked_folder, remove_leftovers, staging, writing

SETTINGS_NAME, PAGE_NAME = "batch.json", "index.html"
_AT_ONCE = 16  # questions to a server
_MOST_SETTINGS_BYTES = 2**20
_MOST_NAMED = 8  # settings in a message


def destination(out: str | Path) -> Destination:
    """Return the place that a path or URL names. Raises InputError for a URL that cannot be written."""
    if isinstance(out, str) and is_url(out):
        check_url(out, written=True)
        return RemoteFolder(out.rstrip("/"))
    return LocalFolder(Path(local_path(out) if isinstance(out, str) else out))


@dataclass(frozen=True)
class LocalFolder:
    """A folder of this machine, or of a file system that machines share."""

    path: Path

    @contextmanager
    def held(self, shard: Shard | None, settings: dict[str, Any] | None = None) -> Iterator[None]:
        """Hold the batch in this folder, or a shard of it, and begin it with settings, if they are given.

        Raises OutputError where another run holds it, or where the folder cannot be written.
        """
        with ExitStack() as whole:
            whole.enter_context(locked_folder(self.path, "a batch", wait=0 if shard is None else SETTLING))
            check_free(self.path, (PAGE_NAME,), replaced=(self.path / SETTINGS_NAME).is_file(), what="batch")
            if settings is not None:
                self.begin(settings)
            with running(self.path, shard):
                if shard is not None:
                    whole.close()  # for the other shards
                try:
                    yield
                finally:
                    remove_leftovers(self.path)  # of workers that were killed

    def begin(self, settings: dict[str, Any]) -> None:
        """Write the settings of the batch. Raises InputError if the folder has results of other settings."""
        path = self.path / SETTINGS_NAME
        if path.is_file():
            what, most = "settings of a batch", _MOST_SETTINGS_BYTES
            _check_settings(str(path), read_json(path, dict[str, Any], what, most_bytes=most), settings)
        else:
            with writing(path) as temporary:
                temporary.write_bytes(_settings_text(settings))

    def has(self, name: str) -> bool:
        """Return whether the result of a clip is there, whole."""
        return is_result(self.path / name / ARCHIVE_NAME)

    def finished(self, names: Iterable[str]) -> set[str]:
        """Return the clips whose results are there."""
        return {name for name in names if self.has(name)}

    def source_of(self, name: str) -> str | None:
        """Return the fingerprint of the source that a clip's result was made of; None where it is unknown."""
        return source_fingerprint(self.path / name / ARCHIVE_NAME)

    def check_space(self, name: str, needed: float) -> None:
        """Raise OutputError where there is no space for so many bytes; log how much a large result takes."""
        announce(self.path / name, needed)

    def write(self, name: str, save: Callable[[Path], None]) -> None:
        """Let `save` write a result into a folder, which becomes that of the clip."""
        folder = self.path / name
        with nullcontext(folder) if folder.exists() else writing(folder) as place:
            save(place)


@dataclass(frozen=True)
class RemoteFolder:
    """A folder at a URL. The archive of a result is uploaded last: a result without it is none."""

    url: str

    @contextmanager
    def held(self, shard: Shard | None, settings: dict[str, Any] | None = None) -> Iterator[None]:
        """Begin the batch with settings, if they are given. Nothing is locked: two runs may do the same clip twice."""
        if settings is not None:
            self.begin(settings)
        yield

    def begin(self, settings: dict[str, Any]) -> None:
        """Write the settings of the batch. Raises InputError if the folder has results of other settings."""
        url, most = f"{self.url}/{SETTINGS_NAME}", _MOST_SETTINGS_BYTES
        if (earlier := read_url(url, most)) is None:
            write_url(url, _settings_text(settings))
        else:
            _check_settings(shown(url), parse_json(earlier, dict[str, Any], shown(url), most_bytes=most), settings)

    def has(self, name: str) -> bool:
        """Return whether the result of a clip is there, whole."""
        return exists(f"{self.url}/{name}/{ARCHIVE_NAME}")

    def finished(self, names: Iterable[str]) -> set[str]:
        """Return the clips whose results are there."""
        begun = {entry.name for entry in list_url(self.url) if entry.is_folder}
        asked = [name for name in names if name in begun]
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            return {name for name, there in zip(asked, pool.map(self.has, asked), strict=True) if there}

    def source_of(self, name: str) -> None:
        """Return None: results at a URL are kept by their names, as reading each would take long."""

    def check_space(self, name: str, needed: float) -> None:
        """Raise OutputError where there is no space for so many bytes; log how much a large result takes."""
        announce(tempfile.gettempdir(), needed)

    def write(self, name: str, save: Callable[[Path], None]) -> None:
        """Let `save` write a result into a folder, which becomes that of the clip."""
        with staging(tempfile.gettempdir()) as staged:
            folder = staged / "result"
            folder.mkdir(mode=0o700)
            save(folder)
            upload(folder, f"{self.url}/{name}", last=ARCHIVE_NAME)


Destination: TypeAlias = LocalFolder | RemoteFolder


def has_changed(place: Destination, name: str, source: ClipSource) -> bool:
    """Return whether the source of a clip is known to be another one than that of its result."""
    of_result = place.source_of(name)
    with suppress(VggtjaxError, OSError):  # a source that is gone or at a URL: its result is kept
        return of_result is not None and fingerprint(open_source(source, undistort=None)) not in (None, of_result)
    return False


def _settings_text(settings: dict[str, Any]) -> bytes:
    return (json.dumps(settings, indent=2, sort_keys=True) + "\n").encode()


def _check_settings(place: str, earlier: dict[str, Any], settings: dict[str, Any]) -> None:
    names = [name for name in settings | earlier if earlier.get(name) != settings.get(name)]
    if names:
        others = "; ".join(
            f"{one_line(name, 40)} {_short(earlier.get(name))}, now {_short(settings.get(name))}"
            for name in names[:_MOST_NAMED]
        )
        raise InputError(
            f"{place} has other settings than this run ({others}); use the earlier settings to resume, or choose "
            "another folder"
        )


def _short(value: Any) -> str:
    return one_line(repr(value), 80)
