"""PyTorch weights by path or hub id."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from converters.files import INDEX, SUFFIXES, choose_file
from converters.foreign import refuse_foreign
from converters.hub import COMMIT, download
from vggtjax.errors import CheckpointError, reading

_HUB_ID = re.compile(
    r"([A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95})"  # owner and name
    r"(?:/([A-Za-z0-9][\w.-]{0,200}))?"  # a file
    r"(?:@(.*))?",  # a commit
    re.ASCII,
)


class Weights(NamedTuple):
    """A file of weights (for shards, their index), the model's name, and its commit on the hub (empty: elsewhere)."""

    path: Path
    name: str
    revision: str = ""


def locate(source: str | Path) -> Weights:
    """Return the file of weights of a path or hub id (OWNER/NAME[/FILE][@COMMIT]), which is downloaded unless cached.

    Raises CheckpointError if the file is missing, a folder or hub repository holds no weights or several ones, or a
    downloaded file is not what the hub declared, and MissingExtraError if the source is a hub id and huggingface_hub is
    not installed.
    """
    path = Path(source).expanduser()
    with reading(path, CheckpointError):
        if path.is_dir():
            names = [entry.name for entry in path.iterdir() if entry.is_file()]
            return Weights(path / choose_file(names, f"the folder {path}"), path.resolve().name)
        if path.is_file():
            return Weights(path, path.name.removesuffix(INDEX).removesuffix(path.suffix))
    is_path = len(path.parts) > 1 and path.parent.is_dir()  # a mistyped one
    if isinstance(source, str) and not is_path and (match := _HUB_ID.fullmatch(source)):
        hub_id, file, revision = match.groups()
        if (not hub_id.endswith(SUFFIXES)) if file is None else file.endswith(SUFFIXES):
            if revision is not None and not COMMIT.fullmatch(revision):
                raise CheckpointError(
                    f"the revision {revision!r} of '{hub_id}' is not a commit; expected its 40 hexadecimal digits, "
                    "which its page on the hub shows under History"
                )
            name = source.partition("@")[0]
            refuse_foreign(name)
            path, commit = download(hub_id, file, revision)
            return Weights(path, name, commit)
    if source == "demo":
        raise CheckpointError("demo is the embedded model, which needs no conversion; give it to --model as it is")
    raise CheckpointError(
        f"there are no weights at {source}; expected a file (.safetensors, .pt, .pth), the index or folder of sharded "
        ".safetensors, 'demo', or a hub id such as 'facebook/VGGT-1B' ('/FILE' appended if it holds several)"
    )
