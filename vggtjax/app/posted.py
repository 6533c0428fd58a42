"""What the page posts, read before its framework sees it: plain values, and names of uploads in place of paths."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePath
from typing import Annotated

import msgspec

from vggtjax.errors import InputError

MOST_BYTES = 2 * 2**20  # of 1000 pictures' entries, and more
_UPLOADED = re.compile(r"[0-9a-f]{64}/[^/\0]+")  # the folder of an upload is named by its contents


class _File(msgspec.Struct):
    path: str


class _Posted(msgspec.Struct):
    data: list[list[_File] | str | int | float | bool | None]
    fn_index: int
    session_hash: Annotated[str, msgspec.Meta(pattern="^[A-Za-z0-9]{1,64}$")]
    trigger_id: int | None = None


def cleaned(body: bytes, inputs: Mapping[int, int]) -> bytes:
    """Return the JSON of a request for one of the page's functions, with nothing but what those need.

    `inputs` has the number of values for each function. A file's entry, of which the path counts alone, becomes the
    name of an upload: `FOLDER/NAME`. Raises InputError for all else.
    """
    try:
        posted = msgspec.json.decode(body, type=_Posted)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError("this request is not one of the page's") from error
    if len(posted.data) != inputs.get(posted.fn_index):
        raise InputError("this request is not one of the page's")
    data = [[_name(file.path) for file in value] if isinstance(value, list) else value for value in posted.data]
    return msgspec.json.encode(msgspec.structs.replace(posted, data=data))


def _name(path: str) -> str:
    name = "/".join(PurePath(path).parts[-2:])
    if not _UPLOADED.fullmatch(name) or name.endswith("/.."):
        raise InputError("a file of this request is no upload; send it again")
    return name
