"""Weights from the Hugging Face hub, through the hub's cache and with the user's token: one commit, verified files."""

from __future__ import annotations

import re
from pathlib import Path

from converters.files import SUFFIXES, choose_file, weight_files
from converters.hub_record import HubFile, HubRecord, read_record, verified, write_record
from vggtjax.errors import CheckpointError, MissingExtraError, VggtjaxError, one_line

COMMIT = re.compile("[0-9a-f]{40}")
_DIGEST = re.compile("[0-9a-f]{40}|[0-9a-f]{64}")


def download(hub_id: str, file: str | None = None, revision: str | None = None) -> tuple[Path, str]:
    """Return a file of weights (for shards, their index) in the hub's cache, and its commit; download it unless cached.

    Without `revision`, a commit of 40 hexadecimal digits, the default branch is resolved to its commit once; later
    calls take the same commit. Every file is verified against the digest that the hub declared then, which the record
    of the repository keeps (`hub_record`): sha256, and git's id of the index of shards. A cached file needs no network.
    Without `file`, `choose_file` chooses the file.

    Raises CheckpointError for a missing, gated or unreachable repository, one without weights, and a file with another
    digest; OutputError if the record cannot be written; MissingExtraError without huggingface_hub.
    """
    try:
        from huggingface_hub import errors
    except ImportError as error:
        raise MissingExtraError(f"downloading '{hub_id}'", "hub") from error

    try:
        return _download(hub_id, file, revision)
    except VggtjaxError:
        raise
    except errors.GatedRepoError as error:
        raise CheckpointError(
            f"the hub's '{hub_id}' is gated; request access on its page, then log in with 'hf auth login'"
        ) from error
    except errors.RevisionNotFoundError as error:
        raise CheckpointError(f"the hub's '{hub_id}' has no commit {revision}; its page lists them") from error
    except errors.RepositoryNotFoundError as error:
        raise CheckpointError(
            f"'{hub_id}' is neither an existing path nor a visible repository on the hub; check the spelling, "
            "or log in with 'hf auth login' if the repository is private"
        ) from error
    except (errors.HTTPError, OSError, ValueError) as error:  # pyright: ignore[reportPrivateImportUsage]
        reason = one_line(str(error).strip().split("\n")[0]).rstrip(".") or type(error).__name__
        wanted = f"{hub_id}/{file}" if file else hub_id
        raise CheckpointError(
            f"'{wanted}' is not in the hub's cache and cannot be downloaded ({reason}); check the network and try again"
        ) from error


def _download(hub_id: str, file: str | None, revision: str | None) -> tuple[Path, str]:
    from huggingface_hub import errors, hf_hub_download

    record = read_record(hub_id)
    commit = revision or record.commit
    files = record.files.get(commit or "")
    if commit is None or files is None:
        try:
            commit, files = _declared(hub_id, revision)
        except (errors.HTTPError, OSError) as error:  # pyright: ignore[reportPrivateImportUsage]: of httpx or httpx2
            return _cached(hub_id, file, revision, error)  # the hub is unreachable, or the repository is gated
    if file is not None and file not in files:
        listed = ", ".join(sorted(files)) or "none"
        raise CheckpointError(f"the hub's '{hub_id}' has no file {file}; its files of weights are {listed}")
    name = file or choose_file(list(files), f"the hub's '{hub_id}'")
    files = dict(files)

    def fetch(name: str) -> Path:
        if name not in files:
            raise CheckpointError(f"the hub's '{hub_id}' has no file {name}, which its index names; choose another")
        path = Path(hf_hub_download(hub_id, name, revision=commit))
        files[name] = verified(path, files[name], hub_id)
        return path

    path = fetch(name)
    for shard in weight_files(path)[1:]:
        fetch(shard.name)
    if (new := HubRecord(record.commit if revision else commit, {**record.files, commit: files})) != record:
        write_record(hub_id, new)
    return path, commit


def _declared(hub_id: str, revision: str | None) -> tuple[str, dict[str, HubFile]]:
    """Ask the hub for a commit, that of the default branch without `revision`, and the digests of its weights."""
    from huggingface_hub import HfApi

    info = HfApi().model_info(hub_id, revision=revision, files_metadata=True)
    commit = info.sha or ""
    if not COMMIT.fullmatch(commit) or commit != (revision or commit):
        expected = revision or "a commit of 40 hexadecimal digits"
        raise CheckpointError(f"the hub answers for '{hub_id}' with {commit[:40]!r}; expected {expected}: try again")
    weights = [file for file in info.siblings or [] if file.rfilename.endswith(SUFFIXES) and "/" not in file.rfilename]
    digests = {file.rfilename: (file.lfs.sha256 if file.lfs else file.blob_id) or "" for file in weights}
    if unknown := [name for name, digest in digests.items() if not _DIGEST.fullmatch(digest)]:
        raise CheckpointError(
            f"the hub declares no digest of {unknown[0]} of '{hub_id}'; choose a repository that does"
        )
    return commit, {name: HubFile(digest) for name, digest in digests.items()}


def _cached(hub_id: str, file: str | None, revision: str | None, error: Exception) -> tuple[Path, str]:
    """Return what another program left in the hub's cache, of which no digest is known here; else raise `error`."""
    from huggingface_hub import errors, hf_hub_download, snapshot_download

    find = {"revision": revision, "local_files_only": True}
    try:
        folder = Path(snapshot_download(hub_id, allow_patterns=[], **find))
    except errors.LocalEntryNotFoundError:
        raise error from None
    names = [entry.name for entry in folder.iterdir()]
    if file is not None and file not in names:
        listed = ", ".join(name for name in sorted(names) if name.endswith(SUFFIXES)) or "none"
        raise CheckpointError(
            f"the hub is unreachable, and its cache of '{hub_id}' holds no {file}, only {listed}; check the network"
        )
    path = Path(hf_hub_download(hub_id, file or choose_file(names, f"the hub's '{hub_id}'"), **find))
    for shard in weight_files(path)[1:]:
        hf_hub_download(hub_id, shard.name, **find)
    return path, folder.name
