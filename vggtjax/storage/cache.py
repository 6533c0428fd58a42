"""The user's cache folder: converted weights, what jax traces and compiles, passes for fits. Does not import jax."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

COMPILED_BYTES = 2 * 2**30  # of compiled programs that are kept; the ones that were not used for longest go first
_DAMAGED = re.compile(r"Error (?:reading|writing) persistent compilation cache entry for '([^']+)'")
_SHORTEST = 0.05  # seconds of compilation from which a program is kept


def cache_folder() -> Path:
    """Return the folder that VGGTJAX_CACHE names, or else the user's cache of this library; it need not be there."""
    if folder := os.environ.get("VGGTJAX_CACHE"):
        return Path(folder).expanduser()
    import platformdirs

    return platformdirs.user_cache_path("vggtjax")


def compiled_folder() -> Path:
    """Return the folder of what jax compiles."""
    return cache_folder() / "compiled"


def lowered_folder() -> Path:
    """Return the folder of programs before they are compiled."""
    return cache_folder() / "lowered"


def keep_compilations() -> bool:
    """Tell jax to keep what it compiles in the user's cache, so that the next process need not compile it again.

    A setting of the whole process, by jax's own environment variables, which win where they are set already: commands
    make it before they import jax, the library never does. Returns False where jax was imported before, and nothing
    is changed.
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
    warnings.showwarning = partial(_show_warning, warnings.showwarning)
    return True


def _show_warning(show: Callable[..., object], message: Warning | str, *details: Any, **options: Any) -> None:
    """Remove damaged entries of jax's cache instead of showing jax's warning: jax then compiles and keeps a new one.

    jax itself would read the damaged entry again in every later process.
    """
    if (match := _DAMAGED.match(str(message))) is None:
        show(message, *details, **options)
        return
    folder = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    for entry in folder.glob("*-cache"):
        used = entry.with_name(entry.name.removesuffix("cache") + "atime")  # a killed process has not written it
        if entry.name.startswith(f"{match[1]}-") or not used.exists():
            for path in (entry, used):
                path.unlink(missing_ok=True)
