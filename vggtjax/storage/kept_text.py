"""Short texts that take seconds to make, kept in the user's cache while compiled programs are."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import jax

from vggtjax.errors import InputError, OutputError, check_regular
from vggtjax.storage.cache import cache_folder, compiled_folder
from vggtjax.storage.versions import source_digest
from vggtjax.storage.writing import writing

MOST_TEXTS = 256  # the oldest are removed first
_DIGEST = 32  # bytes of the sha256 at the start of a kept file


def kept_text(name: str, make: Callable[[], str]) -> str:
    """Return text that depends on `name` and the sources of this package alone; keep it if compiled programs are."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    if folder is None or Path(folder) != compiled_folder():
        return make()
    key = hashlib.sha256(f"{source_digest()} {name}".encode()).hexdigest()[:32]
    path = cache_folder() / "texts" / f"{key}.bin"
    if (text := _read(path)) is not None:
        return text
    text = make()
    with suppress(OutputError):
        _keep(path, text.encode())
    return text


def _read(path: Path) -> str | None:
    """Return the text that `_keep` wrote; None for a missing file, and for a damaged file, which is removed."""
    with suppress(OSError, InputError):
        check_regular(path)
        content = path.read_bytes()
        if content[:_DIGEST] == hashlib.sha256(content[_DIGEST:]).digest():
            return content[_DIGEST:].decode()
        path.unlink()
    return None


def _keep(path: Path, content: bytes) -> None:
    with writing(path) as temporary:
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
    with suppress(FileNotFoundError):  # another process removes files, too
        newest = sorted(path.parent.glob("*.bin"), key=lambda path: path.stat().st_mtime, reverse=True)
        for old in newest[MOST_TEXTS:]:
            old.unlink()
