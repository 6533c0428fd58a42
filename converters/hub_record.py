"""What is known of hub repositories: the commit in use, and the digests that the hub declared for its files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from vggtjax.errors import CheckpointError
from vggtjax.storage.cache import cache_folder
from vggtjax.storage.file_digest import file_digest
from vggtjax.storage.json_values import read_json
from vggtjax.storage.writing import writing

Commit = Annotated[str, Meta(pattern="^[0-9a-f]{40}$")]
Digest = Annotated[str, Meta(pattern="^([0-9a-f]{40}|[0-9a-f]{64})$")]  # git's id of a small file, else sha256


@dataclass(frozen=True)
class HubFile:
    """A file of a commit: its declared digest, and the `file_digest` of the copy that was verified (empty: none)."""

    digest: Digest
    verified: str = ""


@dataclass(frozen=True)
class HubRecord:
    """A repository: the commit of those who name none (None: not yet resolved), and files by commit and name."""

    commit: Commit | None = None
    files: dict[Commit, dict[str, HubFile]] = field(default_factory=dict)


def record_path(hub_id: str) -> Path:
    """Return the place of a repository's record, in the cache folder of this library."""
    return cache_folder() / "hub" / f"{hub_id}.json"


def read_record(hub_id: str) -> HubRecord:
    """Return a repository's record, an empty one if there is none; raises CheckpointError for a damaged one."""
    path = record_path(hub_id)
    if not path.exists():
        return HubRecord()
    try:
        return read_json(path, HubRecord, "the hub record", error=CheckpointError)
    except CheckpointError as error:
        raise CheckpointError(f"{error}; delete this file, and the hub is asked again") from None


def write_record(hub_id: str, record: HubRecord) -> None:
    """Replace a repository's record; raises OutputError where the cache folder cannot be written."""
    with writing(record_path(hub_id)) as temporary:
        temporary.write_text(json.dumps(dataclasses.asdict(record), indent=1) + "\n", encoding="utf-8")


def verified(path: Path, file: HubFile, hub_id: str) -> HubFile:
    """Return the file with its copy at `path` verified; a verified copy is not read again unless size or date changed.

    Raises CheckpointError if the copy has another digest than the hub declared.
    """
    seen = file_digest([path])
    if seen == file.verified:
        return file
    with path.open("rb") as opened:
        found = hashlib.file_digest(opened, "sha256").hexdigest() if len(file.digest) == 64 else _git_id(path)
    if found != file.digest:
        raise CheckpointError(
            f"{path.name} of the hub's '{hub_id}' has the digest {found[:16]}..., not the recorded {file.digest[:16]}"
            f"...; do not use it: delete {path.resolve()} and download it again"
        )
    return dataclasses.replace(file, verified=seen)


def _git_id(path: Path) -> str:
    """Return git's id of a file, which the hub declares for what is not in its large storage: indices of shards."""
    content = path.read_bytes()
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()
