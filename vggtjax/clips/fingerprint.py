"""What tells whether the frames of a source have changed since a result was made of them. Does not import jax."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

import numpy as np

from vggtjax.clips.media.arrays import ArrayFrames
from vggtjax.clips.media.images import ImageFiles
from vggtjax.clips.media.sampling import Source

_SAMPLE = 4096  # bytes from the start and from the end of a file


def fingerprint(source: Source) -> str | None:
    """Return a digest of a source: of arrays whole, of files their names, sizes, first and last bytes.

    Folders and dates do not count, so a copy has the same; of a capture the pictures alone do. None for a source
    without a path, and where a file cannot be read.
    """
    digest = hashlib.sha256()
    if isinstance(source, ArrayFrames):
        for array in source.arrays:
            digest.update(f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()
    paths: tuple[Path, ...] = source.paths if isinstance(source, ImageFiles) else (Path(getattr(source, "path", "")),)
    with suppress(OSError):  # as for no path, which is a folder
        for path in paths:
            with path.open("rb") as file:
                size = file.seek(0, 2)
                digest.update(f"{path.name} {size}\n".encode("utf-8", "surrogateescape"))
                for start in (0, max(0, size - _SAMPLE)):
                    file.seek(start)
                    digest.update(file.read(_SAMPLE))
        return digest.hexdigest()
    return None


def source_setting(source: Source) -> dict[str, str]:
    """Return the fingerprint of a source as a setting of its result; none where it has no fingerprint."""
    return {} if (known := fingerprint(source)) is None else {"source": known}
