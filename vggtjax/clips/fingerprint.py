"""What tells whether the frames of a source have changed since a result was made of them. Does not import jax."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from vggtjax.clips.media.arrays import ArrayFrames
from vggtjax.clips.media.images import ImageFiles
from vggtjax.clips.media.sampling import Source

_SAMPLE = 4096  # bytes from the start and from the end of a file


def fingerprint(source: Source) -> str:
    """Return a digest of a source: of arrays whole, of files their names, sizes, first and last bytes.

    Folders and dates do not count, so a copy has the same. Raises OSError for a file that cannot be read.
    """
    digest = hashlib.sha256()
    if isinstance(source, ArrayFrames):
        for array in source.arrays:
            digest.update(f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()
    paths: tuple[Path, ...] = source.paths if isinstance(source, ImageFiles) else (Path(getattr(source, "path", "")),)
    for path in paths:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            digest.update(f"{path.name} {size}\n".encode("utf-8", "surrogateescape"))
            for start in (0, max(0, size - _SAMPLE)):
                file.seek(start)
                digest.update(file.read(_SAMPLE))
    return digest.hexdigest()
