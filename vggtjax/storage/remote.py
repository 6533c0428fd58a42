"""Files at URLs, through fsspec: listed, downloaded within bounds, uploaded whole. Does not import jax."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from secrets import token_hex
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any, Literal, NamedTuple
from urllib.parse import unquote, urlsplit

from vggtjax.errors import InputError, OutputError, VggtjaxError, check_extra, one_line

MOST_BYTES = 2**36  # of one download
_MOST_FILES = 100_000  # of one download
_DEEPEST = 8  # folders in folders of one download
_AT_ONCE = 8  # files that are copied at the same time
_CONNECT, _SILENCE = 30, 120  # seconds that a web server has for the connection, and for the next bytes
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")
_WEB = ("http", "https")
_MEMORY = "memory"  # of one process: for tests


# How files are written: whole or not at all, as on a disk, or never. fsspec knows more schemes: those that wrap others
# (a reference, a cache, an archive) could name what a list must not name.
SCHEMES: Mapping[str, Literal["objects", "files", "read"]] = {
    **dict.fromkeys(("s3", "s3a", "gs", "gcs", "az", "abfs"), "objects"),
    **dict.fromkeys((*_WEB, "hf"), "read"),
    **dict.fromkeys(("sftp", "ssh", "hdfs"), "files"),
    _MEMORY: "objects",
}


class Entry(NamedTuple):
    """A file or folder in a folder at a URL."""

    url: str
    name: str
    is_folder: bool


def is_url(text: object) -> bool:
    """Return whether a text names a place by a scheme, such as s3://; `file://` is a path, see `local_path`."""
    return isinstance(text, str) and _URL.match(text) is not None and _scheme(text) not in ("file", "local")


def local_path(text: str) -> str:
    """Return the path that a `file://` URL names, and any other text as it is."""
    return unquote(urlsplit(text).path) if _URL.match(text) and _scheme(text) in ("file", "local") else text


def shown(url: str) -> str:
    """Return a URL for messages: without user, password and query, which may hold a key; a path as it is."""
    if not is_url(url):
        return url
    scheme, separator, rest = re.split(r"[?#]", url, maxsplit=1)[0].partition("://")
    place, slash, path = rest.partition("/")
    return one_line(f"{scheme}{separator}{place.rpartition('@')[2]}{slash}{path}", 200)


def url_name(url: str, error: type[InputError] = InputError) -> str:
    """Return the last name of a URL's path, as a file on this machine would be called.

    Raises `error` for a name that no file can have.
    """
    path = url.partition("://")[2]
    if _scheme(url) in _WEB:
        path = re.split(r"[?#]", path, maxsplit=1)[0]
    name = _file_name(url, path.rstrip("/").rpartition("/")[2])
    if name is None:
        raise error(f"{shown(url)} ends in no name of a file; expected one such as clip.mp4")
    return name


def check_url(url: str, *, written: bool = False, error: type[InputError] = InputError) -> None:
    """Raise `error` for a URL of an unknown scheme, a chain of them, or one that cannot be written if it must be.

    Opens nothing, but imports what fsspec needs for the scheme.
    """
    kind = SCHEMES.get(_scheme(url))
    if kind is None or "::" in url or not url.partition("://")[2].strip("/") or not url.isprintable():
        known = ", ".join(f"{name}://" for name in SCHEMES if name != _MEMORY)
        raise error(f"{shown(url)} is no URL that can be read; expected a path, or one of {known}")
    if written and kind == "read":
        raise error(f"{shown(url)} can be read, not written; expected a folder, or a URL such as s3://bucket/results")
    with _opened(url, error):
        pass


def is_in_process(url: str) -> bool:
    """Return whether a URL names the memory of this process, which no other process sees."""
    return _scheme(url) == _MEMORY


def list_url(url: str, error: type[InputError] = InputError) -> list[Entry]:
    """Return the files and folders in a folder at a URL, in no order. Raises `error` where it cannot be read."""
    check_url(url, error=error)
    with _opened(url, error) as (system, path):
        return [
            Entry(f"{url.rstrip('/')}/{name}{'/' if is_folder else ''}", name, is_folder)
            for name, is_folder in _entries(system, url, path)
        ]


def exists(url: str) -> bool:
    """Return whether there is a file at a URL; raises InputError where that cannot be told."""
    with _opened(url, InputError) as (system, path):
        system.invalidate_cache()
        try:
            return system.info(path)["type"] == "file"
        except FileNotFoundError:
            return False


def read_url(url: str, most_bytes: int) -> bytes | None:
    """Return the bytes of a small file, None where there is none. Raises InputError for a larger or unreadable one."""
    with _opened(url, InputError) as (system, path):
        system.invalidate_cache()
        try:
            with system.open(path, "rb") as file:
                content = file.read(most_bytes + 1)
        except FileNotFoundError:
            return None
    if len(content) > most_bytes:
        raise InputError(f"{shown(url)} has more than {most_bytes} bytes; expected at most so many")
    return content


def download(url: str, folder: Path, *, most_bytes: int = MOST_BYTES, error: type[InputError] = InputError) -> Path:
    """Copy a file at a URL, or a folder with everything in it, into `folder`; return its path there.

    Raises `error` for what cannot be read, or is larger than `most_bytes` in all.
    """
    check_url(url, error=error)
    target = folder / url_name(url, error)
    count = _counter(most_bytes, error(f"{shown(url)} has more than {most_bytes} bytes; expected at most so many"))
    with _opened(url, error) as (system, path):
        files = [(path, target)]
        if _is_folder(system, url, path):
            files = [(f"{path.rstrip('/')}/{name}", target / local) for name, local in _walk(system, url, path, error)]
        if not files:
            raise FileNotFoundError

        def copy(file: tuple[str, Path]) -> None:
            source, place = file
            place.parent.mkdir(parents=True, exist_ok=True)
            system.get_file(source, str(place), callback=count)

        with ThreadPoolExecutor(_AT_ONCE) as pool:
            list(pool.map(copy, files))  # the first error cancels what has not begun
    return target


def upload(folder: Path, url: str, *, last: str) -> None:
    """Copy the files of a folder to a folder at a URL; the file `last` in the end, so that it tells that all is there.

    Raises OutputError where the URL cannot be written.
    """
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    with _opened(url, OutputError) as (system, path):

        def copy(name: str) -> None:
            _put(system, folder / name, f"{path.rstrip('/')}/{name}", url)

        with ThreadPoolExecutor(_AT_ONCE) as pool:
            list(pool.map(copy, [name for name in files if name != last]))
        copy(last)


def write_url(url: str, content: bytes) -> None:
    """Write a small file at a URL. Raises OutputError where it cannot be written."""
    with _opened(url, OutputError) as (system, path), TemporaryDirectory() as folder:
        (Path(folder) / "file").write_bytes(content)
        _put(system, Path(folder) / "file", path, url)


@contextmanager
def _opened(url: str, error: type[VggtjaxError]) -> Iterator[tuple[Any, str]]:
    """Yield the file system of a URL and the path in it; whatever it raises becomes `error`, without credentials."""
    check_extra("a clip or a folder at a URL", "remote", "fsspec")
    from fsspec.core import url_to_fs

    options = {}
    try:
        if _scheme(url) in _WEB:
            from aiohttp import ClientTimeout

            timeout = ClientTimeout(total=None, sock_connect=_CONNECT, sock_read=_SILENCE)  # any size, in its time
            options["client_kwargs"] = {"timeout": timeout}
        yield url_to_fs(url, **options)
    except VggtjaxError:
        raise
    except FileNotFoundError as problem:
        raise error(f"there is nothing at {shown(url)}; check the address") from problem
    except ImportError as problem:  # names the package
        raise error(f"{shown(url)} needs a package that is not installed: {problem}") from problem
    except Exception as problem:  # each library of a scheme has exceptions of its own
        reason = one_line(str(problem).replace(url, shown(url)), 200) or type(problem).__name__
        raise error(
            f"cannot reach {shown(url)} ({reason}); check the address, the network and the credentials"
        ) from problem


def _counter(most: int, error: InputError) -> Any:
    """Return what fsspec tells the sizes and bytes of all files of a download; it raises the error for more bytes."""
    from fsspec.callbacks import Callback

    class Counter(Callback):
        left, lock = most, Lock()

        def set_size(self, size: int | None) -> None:  # told before the first byte comes
            if (size or 0) > self.left:
                raise error

        def relative_update(self, inc: int = 1) -> None:
            with self.lock:
                self.left -= inc
            self.set_size(0)

    return Counter()


def _scheme(url: str) -> str:
    return url.partition("://")[0].lower()


def _is_folder(system: Any, url: str, path: str) -> bool:
    """Return whether a URL names a folder. Web servers do not tell: there names without a suffix are folders."""
    if _scheme(url) in _WEB:
        return url.endswith("/") or not PurePosixPath(url_name(url)).suffix
    return system.info(path)["type"] == "directory"


def _file_name(url: str, name: str) -> str | None:
    """Return how a file of a URL's file system is called on this machine; None for a name that no file can have."""
    plain = unquote(name) if _scheme(url) in _WEB else name
    blocked = plain in ("", ".", "..") or set(plain) & set("/\\") or not plain.isprintable()
    return None if blocked else plain


def _entries(system: Any, url: str, path: str) -> Iterator[tuple[str, bool]]:
    """Yield the name of what lies in a folder, and nothing beside the folder, and whether it is a folder."""
    base, is_web = path.rstrip("/") + "/", _scheme(url) in _WEB
    system.invalidate_cache()
    for entry in system.ls(path, detail=True):
        name = str(entry["name"])
        inside = name.removeprefix(base).rstrip("/")
        is_link = is_web and set(inside) & set("?#")  # such as one that sorts the page
        if name.startswith(base) and "/" not in inside and _file_name(url, inside) is not None and not is_link:
            yield inside, entry["type"] == "directory"


def _walk(system: Any, url: str, path: str, error: type[InputError]) -> Iterator[tuple[str, Path]]:
    """Yield the name of each file in a folder and in its folders, and how it is called on this machine."""
    waiting, count = [("", Path(), 0)], 0
    while waiting:
        folder, local, depth = waiting.pop()
        for name, is_folder in _entries(system, url, f"{path.rstrip('/')}/{folder}".rstrip("/")):
            count += 1
            if count > _MOST_FILES or depth > _DEEPEST:
                raise error(f"{shown(url)} has more than {_MOST_FILES} files or {_DEEPEST} levels; name a clip")
            place = local / (_file_name(url, name) or name)
            if is_folder:
                waiting.append((f"{folder}{name}/", place, depth + 1))
            else:
                yield f"{folder}{name}", place


def _put(system: Any, source: Path, path: str, url: str) -> None:
    """Copy a file, whole or not at all."""
    if SCHEMES[_scheme(url)] == "objects":
        system.put_file(str(source), path)
        return
    system.makedirs(path.rpartition("/")[0], exist_ok=True)
    temporary = f"{path}.{token_hex(8)}.partial"
    try:
        system.put_file(str(source), temporary)
        system.mv(temporary, path)
    except BaseException:
        with suppress(Exception):
            system.rm_file(temporary)
        raise
