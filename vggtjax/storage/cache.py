"""The user's cache folder: converted weights, compiled programs, passes for fits. Does not import jax."""

from __future__ import annotations

import logging
import os
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

from vggtjax.storage.writing import write_errors

COMPILED_BYTES = 2 * 2**30  # of kept compiled programs; the least recently used go first
CONVERTED = "converted weights"
TRIALS = "trials"  # of what this computer does fast
_KINDS = {  # the commits and digests of hub ids, in hub/, are a record and stay
    "compiled programs": "compiled",
    "digests and shapes": "texts",
    "programs of earlier versions": "lowered",
    "passes for fits": "passes",
    "trials of the processor": TRIALS,
}
_CONVERTED = re.compile(r"-[0-9a-f]{16}\.safetensors$")  # weights that were converted for `load_model`
_DAMAGED = re.compile(r"Error (reading|writing) persistent compilation cache entry for '([^']+)'")
_FOLDER = "jax_compilation_cache_dir"
_SHORTEST = 0.05  # seconds; programs that compile faster are not kept
_WORTH_KEEPING = 5.0  # seconds of compiling, after which it is said once how to keep it

logger = logging.getLogger(__name__)


def cache_folder() -> Path:
    """Return the folder that VGGTJAX_CACHE names, else the user's cache of this library; the folder may be missing."""
    if folder := os.environ.get("VGGTJAX_CACHE"):
        return Path(folder).expanduser()
    import platformdirs

    return platformdirs.user_cache_path("vggtjax")


def compiled_folder() -> Path:
    """Return the folder of compiled programs."""
    return cache_folder() / "compiled"


def cache_parts() -> dict[str, list[Path]]:
    """Return what this library keeps in its cache folder, by kind; files of others there are not named."""
    folder = cache_folder()
    parts = {kind: [folder / name] for kind, name in _KINDS.items()}
    models = sorted(path for path in folder.glob("*.safetensors") if _CONVERTED.search(path.name))
    return {kind: [path for path in paths if path.exists()] for kind, paths in (parts | {CONVERTED: models}).items()}


def size_of(paths: Iterable[Path]) -> int:
    """Return the bytes of files, and of the files in folders; those that another process removes count as 0."""
    total = 0
    for path in paths:
        for file in path.rglob("*") if path.is_dir() else [path]:
            with suppress(OSError):
                total += file.lstat().st_size if file.is_file() else 0
    return total


def clear_cache() -> int:
    """Remove what `cache_parts` names; return how many bytes that were.

    Raises OutputError where it cannot be removed.
    """
    paths = [path for part in cache_parts().values() for path in part]
    before = size_of(paths)
    for path in paths:
        with write_errors(path), suppress(FileNotFoundError):  # another process clears it, too
            if path.is_symlink() or not path.is_dir():
                path.unlink()
            else:
                shutil.rmtree(path)
    return before


def enable_compilation_cache() -> Path:
    """Let jax keep compiled programs on the disk, so that the next process need not compile them again; as commands do.

    Call it at the start of a script; the library itself never does. It sets jax's options for the whole process. The
    folder is `compiled/` in the user's cache of this library, which VGGTJAX_CACHE moves; it holds at most
    `COMPILED_BYTES`, and the least recently used programs go first. A folder of your own, by JAX_COMPILATION_CACHE_DIR
    or `jax.config`, is used as it is, without a limit; JAX_ENABLE_COMPILATION_CACHE=false turns all of it off.

    Returns:
        The folder of the compiled programs, which may be missing until the first one is kept.
    """
    jax = sys.modules.get("jax")
    folder = os.environ.get(_FOLDER.upper()) if jax is None else jax.config.values[_FOLDER]
    settings: dict[str, Any] = {"jax_persistent_cache_min_compile_time_secs": _SHORTEST}
    if folder is None:
        folder = str(compiled_folder())
        settings |= {_FOLDER: folder, "jax_compilation_cache_max_size": COMPILED_BYTES}
    for name, value in settings.items():
        if jax is None:
            os.environ.setdefault(name.upper(), str(value))
        elif name.upper() not in os.environ:
            jax.config.update(name, value)
    if jax is not None:  # it may have looked for a cache already, and found none
        from jax.experimental.compilation_cache import compilation_cache

        compilation_cache.reset_cache()
    if getattr(warnings.showwarning, "func", None) is not _show_warning:
        warnings.showwarning = partial(_show_warning, Path(folder), warnings.showwarning, set())
    return Path(folder)


def hint_compilation_cache(seconds: float) -> None:
    """Say once how later processes save these seconds of compiling, unless compiled programs are kept."""
    if seconds >= _WORTH_KEEPING and sys.modules["jax"].config.values[_FOLDER] is None:
        _say_how_to_keep()


@cache  # once in a process
def _say_how_to_keep() -> None:
    logger.warning(
        "what was compiled is lost with this process; call vggtjax.enable_compilation_cache() at the start of the "
        "script, and later runs start sooner"
    )


def _show_warning(
    folder: Path, show: Callable[..., object], shown: set[str], message: Warning | str, *details: Any, **options: Any
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
    for entry in folder.glob("*-cache"):
        used = entry.with_name(entry.name.removesuffix("cache") + "atime")
        if not used.exists() or (kind == "reading" and entry.name.startswith(f"{program}-")):
            with suppress(OSError):
                entry.unlink(missing_ok=True)
                used.unlink(missing_ok=True)
                is_mended |= kind == "reading"
    if not is_mended and not shown:
        shown.add(kind)
        show(message, *details, **options)
