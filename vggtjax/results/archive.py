"""The archive of a result, reconstruction.npz: every field but the passes, in one compressed file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from vggtjax.errors import ResultError
from vggtjax.results.result import ARRAYS, OPTIONAL, STRINGS, TRACKS, Result, check_shapes
from vggtjax.results.saving import NAMES, OPTIONAL_FILES
from vggtjax.storage.arrays import Header, read_arrays, read_headers, write_arrays

ARCHIVE_NAME = "reconstruction.npz"
_FORMAT_VERSION = 1
_MOST_FILES = 100


def write_archive(path: Path, result: Result, files: Sequence[str] = ()) -> None:
    """Write the fields of a result; `files` are the files and folders beside the archive that are part of it."""
    arrays = {name: getattr(result, name) for name in ARRAYS if getattr(result, name) is not None}
    strings = {name: getattr(result, name) for name in STRINGS} | {"settings": json.dumps(result.settings)}
    arrays |= {name: np.array(value, np.str_) for name, value in strings.items()}
    arrays |= {"format_version": np.array(_FORMAT_VERSION), "files": np.array([ARCHIVE_NAME, *files], np.str_)}
    write_arrays(path, arrays)


def read_archive(path: Path) -> dict[str, Any]:
    """Read the fields of a result. Raises ResultError for anything but a whole archive of a known version."""
    _check_headers(read_headers(path))
    fields: dict[str, Any] = {"timestamps": None, "saliency": None, **read_arrays(path)}
    version = int(fields.pop("format_version"))
    fields.pop("files", None)
    if version != _FORMAT_VERSION:
        raise ResultError(f"it has format version {version}; expected {_FORMAT_VERSION}")
    for name in ("method", "model_name", "settings"):
        fields[name] = fields[name].item()
    fields["frame_names"] = tuple(fields["frame_names"].tolist())
    try:
        fields["settings"] = json.loads(fields["settings"])
    except (ValueError, RecursionError) as error:
        raise ResultError(f"its settings are not JSON: {error}") from error
    return fields


def is_result(path: Path) -> bool:
    """Return whether `path` looks like a reconstruction.npz of this library, of any version."""
    try:
        return {"format_version", "depth", "camera_from_world"} <= set(read_headers(path))
    except ResultError:
        return False


def source_fingerprint(path: Path) -> str | None:
    """Return the fingerprint of the source that a result was made of; None where the archive does not tell."""
    with suppress(ResultError, LookupError, ValueError, RecursionError, TypeError):
        return str(json.loads(read_arrays(path, ["settings"])["settings"].item())["source"])
    return None


def saved_names(path: Path) -> tuple[str, ...]:
    """Return the names of all files and folders of the result of an archive, which is the first; () if it is none."""
    if not is_result(path):
        return ()
    saved: list[str] = []
    with suppress(ResultError):
        header = read_headers(path).get("files")
        if (
            header is not None
            and len(header.shape) == 1
            and header.shape[0] <= _MOST_FILES
            and header.dtype.kind == "U"
        ):
            saved = read_arrays(path, ["files"])["files"].tolist()
    if ARCHIVE_NAME not in saved:  # earlier archives tell the optional files alone
        saved = [*NAMES, *saved]
    return (ARCHIVE_NAME, *(name for name in (*NAMES, *OPTIONAL_FILES) if name in saved))


def _check_headers(headers: Mapping[str, Header]) -> None:
    version = headers.get("format_version")
    if version is None or version != (np.dtype(np.int64), ()):
        raise ResultError("it has no format version")
    expected = {"format_version", "files", *ARRAYS, *STRINGS}
    optional = {"files"} | (OPTIONAL - TRACKS if TRACKS & set(headers) else OPTIONAL)
    wrong = sorted((expected - optional - set(headers)) | (set(headers) - expected))
    if wrong:
        raise ResultError(f"arrays are missing or unknown: {', '.join(wrong)}")
    for name, header in headers.items():
        if name in ARRAYS and header.dtype != ARRAYS[name][0]:
            raise ResultError(f"{name} has type {header.dtype}; expected {ARRAYS[name][0]}")
        if name in STRINGS and header.dtype.kind != "U":
            raise ResultError(f"{name} has type {header.dtype}; expected text")
    check_shapes({name: header.shape for name, header in headers.items() if name not in ("format_version", "files")})
