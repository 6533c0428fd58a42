"""Weights from the Hugging Face hub, through the hub's cache and with the user's token."""

from __future__ import annotations

from pathlib import Path

from converters.files import SUFFIXES, choose_file, weight_files
from vggtjax.errors import CheckpointError, MissingExtraError, one_line


def download(hub_id: str, file: str | None = None) -> Path:
    """Return the file of weights of a hub repository in the hub's cache; download it unless cached.

    A cached file needs no network. Without `file`, `choose_file` chooses the file. Raises CheckpointError for a
    missing, gated or unreachable repository or one without weights; MissingExtraError without huggingface_hub.
    """
    try:
        from huggingface_hub import errors
    except ImportError as error:
        raise MissingExtraError(f"downloading '{hub_id}'", "hub") from error

    try:
        return _download(hub_id, file)
    except CheckpointError:
        raise
    except errors.GatedRepoError as error:
        raise CheckpointError(
            f"the hub's '{hub_id}' is gated; request access on its page, then log in with 'hf auth login'"
        ) from error
    except errors.RepositoryNotFoundError as error:
        raise CheckpointError(
            f"'{hub_id}' is neither an existing path nor a visible repository on the hub; check the spelling, "
            "or log in with 'hf auth login' if the repository is private"
        ) from error
    except (errors.HTTPError, OSError, ValueError) as error:  # pyright: ignore[reportPrivateImportUsage]
        reason = one_line(str(error).strip().split("\n")[0]).rstrip(".") or type(error).__name__
        raise CheckpointError(
            f"'{hub_id}' is not in the hub's cache and cannot be downloaded ({reason}); check the network and try again"
        ) from error


def _download(hub_id: str, file: str | None) -> Path:
    from huggingface_hub import HfApi, errors

    hub = HfApi()
    cached = False
    try:
        names = [file.rfilename for file in hub.model_info(hub_id).siblings or []]
    except (errors.HTTPError, OSError) as error:  # pyright: ignore[reportPrivateImportUsage]: of httpx or httpx2
        cached = True  # the hub is unreachable, or the repository is gated
        try:
            folder = Path(hub.snapshot_download(hub_id, allow_patterns=[], local_files_only=True))
        except errors.LocalEntryNotFoundError:
            raise error from None
        names = [entry.name for entry in folder.iterdir()]
    if file is not None and file not in names:
        listed = ", ".join(name for name in sorted(names) if name.endswith(SUFFIXES)) or "none"
        if cached:
            raise CheckpointError(
                f"the hub is unreachable, and its cache of '{hub_id}' holds no {file}, only {listed}; check the network"
            )
        raise CheckpointError(f"the hub's '{hub_id}' has no file {file}; its files of weights are {listed}")
    name = file or choose_file(names, f"the hub's '{hub_id}'")
    path = Path(hub.hf_hub_download(hub_id, name, local_files_only=cached))
    for shard in weight_files(path)[1:]:
        if Path(hub.hf_hub_download(hub_id, shard.name, local_files_only=cached)) != shard:
            raise CheckpointError(f"the hub's '{hub_id}' changed during the download; try again")
    return path
