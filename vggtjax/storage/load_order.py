"""Libraries that break others of the same process by the order in which they are loaded. Linux only."""

from __future__ import annotations

import ctypes
import io
import os
import select
import signal
import sys
from contextlib import suppress

from vggtjax.errors import LoadOrderError

# They export zlib's functions from a copy of their own. Loaded before the system's zlib, they tie half of it to that
# copy, and each PNG, archive or page that is compressed in the process then aborts or hangs it.
_EXPORT_ZLIB = ("pycolmap",)
_PATIENCE = 10.0  # seconds


def load_in_order() -> None:
    """Load the system's zlib, so that libraries which are loaded later cannot tie it to theirs.

    Raises LoadOrderError where one that is loaded already has done so.
    """
    if sys.platform != "linux":  # elsewhere libraries do not share symbols by name
        return
    with suppress(OSError):
        ctypes.CDLL("libz.so.1")
    first = next((name for name in _EXPORT_ZLIB if name in sys.modules), None)
    if first and not _compresses():
        raise LoadOrderError(
            f"{first} was imported before vggtjax, and in this order every PNG or archive that is written aborts the "
            f"process; put `import vggtjax` before `import {first}`"
        )


def _compresses() -> bool:
    """Return whether this process can write a PNG. A fork of it tries, as a failure aborts or hangs."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(2)  # a library's handler of the failure prints its stack
            from PIL import Image

            Image.new("L", (64, 64)).save(io.BytesIO(), "PNG")
            os.write(writer, b"1")
        finally:
            os._exit(0)
    os.close(writer)
    works = bool(select.select([reader], [], [], _PATIENCE)[0]) and os.read(reader, 1) == b"1"
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    os.close(reader)
    return works
