"""The user's cache folder: converted weights, traced and compiled programs, passes for fits. Does not import jax."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

COMPILED_BYTES = 2 * 2**30  # of kept compiled programs; the least recently used go first
_DAMAGED = re.compile(r"Error (reading|writing) persistent compilation cache entry for '([^']+)'")
_SHORTEST = 0.05  # seconds; programs that compile faster are not kept


def cache_folder() -> Path:
    """Return the folder that VGGTJAX_CACHE names, else the user's cache of this library; the folder may be missing."""
    if folder := os.environ.get("VGGTJAX_CACHE"):
        return Path(folder).expanduser()
    import platformdirs

    return platformdirs.user_cache_path("vggtjax")


def compiled_folder() -> Path:
    """Return the folder of compiled programs."""
    return cache_folder() / "compiled"


def lowered_folder() -> Path:
    """Return the folder of traced programs, not yet compiled."""
    return cache_folder() / "lowered"


def keep_compilations() -> bool:
    """Tell jax to keep compiled programs in the user's cache, so that the next process need not compile them again.

    This sets jax's environment variables, unless the user set them, for the whole process: commands call it before they
    import jax; the library never does. Returns False, and changes nothing, if jax is already imported.
    """
    if "jax" in sys.modules:
        return False
    settings = {
        "JAX_COMPILATION_CACHE_DIR": str(compiled_folder()),
        "JAX_COMPILATION_CACHE_MAX_SIZE": str(COMPILED_BYTES),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": str(_SHORTEST),
    }
    for name, value in settings.items():
        os.environ.setdefault(name, value)
    warnings.showwarning = partial(_show_warning, warnings.showwarning, set())
    return True


def _show_warning(
    show: Callable[..., object], shown: set[str], message: Warning | str, *details: Any, **options: Any
) -> None:
    """Remove damaged entries of jax's cache instead of showing jax's warning: jax then compiles and keeps a new one.

    jax itself would read the damaged entry again in every later process. A cache that cannot be read or written for
    other reasons is warned about once; `shown` remembers that.
    """
    if (match := _DAMAGED.match(str(message))) is None:
        show(message, *details, **options)
        return
    kind, program = match.groups()
    is_mended = kind == "writing" and "-atime" in str(message)  # a killed process has not written that file
    for entry in Path(os.environ["JAX_COMPILATION_CACHE_DIR"]).glob("*-cache"):
        used = entry.with_name(entry.name.removesuffix("cache") + "atime")
        if not used.exists() or (kind == "reading" and entry.name.startswith(f"{program}-")):
            with suppress(OSError):
                entry.unlink(missing_ok=True)
                used.unlink(missing_ok=True)
                is_mended |= kind == "reading"
    if not is_mended and not shown:
        shown.add(kind)
        show(message, *details, **options)
