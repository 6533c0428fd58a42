"""What tells whether files have changed, without reading them again. Does not import jax."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple


def file_digest(paths: Iterable[Path]) -> str:
    """Return a digest of the names, sizes and dates of files; raises OSError for one that is missing."""
    digest = hashlib.sha256()
    for path in paths:
        stat = path.stat()
        digest.update(f"{path} {stat.st_size} {stat.st_mtime_ns}\n".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


class FileFacts(NamedTuple):
    """Facts that change when the content of a file changes."""

    path: Path
    size: int
    modified: int  # nanoseconds
    inode: int


def file_facts(path: Path) -> FileFacts | None:
    """Return the facts of a file; None where it is not there."""
    try:
        stat = path.stat()
        return FileFacts(path.resolve(), stat.st_size, stat.st_mtime_ns, stat.st_ino)
    except OSError:
        return None


@lru_cache(maxsize=64)
def content_digest(facts: FileFacts) -> str:
    """Return the sha256 of a file, computed once and kept: hashing 5 GB takes seconds."""
    from vggtjax.storage.kept_text import kept_text  # which imports jax

    def digest() -> str:
        with facts.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    return kept_text(f"sha256 {facts}", digest)
