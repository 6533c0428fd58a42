"""A command in a child of its own that is killed at a change of a file, or at a moment."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

_LONGEST = 900.0  # seconds of one run
_EVENTS = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link"}


def start(
    words: list[str],
    log: Path,
    watched: Path,
    *,
    count: Path | None = None,
    change: int | None = None,
    seconds: float | None = None,
) -> tuple[int, float | None]:
    """Start a command in a child; it kills itself at a change of a file, or notes the number of changes."""

    def run() -> int:
        from vggtjax.commands.main import main
        from vggtjax.storage.cache import enable_compilation_cache

        enable_compilation_cache()  # a command does it before jax is imported
        changes = watch(watched, change)
        code = main(words)
        if count is not None:
            count.write_text(str(next(changes)))
        return code

    return fork(run, log, seconds)


def watch(folder: Path, fatal: int | None) -> Iterator[int]:
    """Count changes of files below a folder, and kill the process just before one; yields how many there were."""
    inside, done = str(folder), [0]
    sync = os.fsync

    def changed() -> None:
        done[0] += 1
        if done[0] == fatal:
            os.kill(os.getpid(), signal.SIGKILL)

    def hook(event: str, arguments: tuple) -> None:
        if event == "open":
            path, _, flags = arguments
            is_change = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR)
        else:
            path, is_change = arguments[0] if arguments else None, event in _EVENTS
        if is_change and isinstance(path, str | os.PathLike) and os.fspath(path).startswith(inside):
            changed()

    def fsync(file: Any) -> None:
        changed()
        sync(file)

    sys.addaudithook(hook)
    os.fsync = fsync

    def counts() -> Iterator[int]:
        yield done[0]

    return counts()


def fork(run: Callable[[], int], log: Path, seconds: float | None = None) -> tuple[int, float | None]:
    """Run a function in a child whose output goes to a file; return its process, and when it is to be killed."""
    import jax  # noqa: F401  imported before the fork, and with nothing started: no child imports it again

    import vggtjax.pipeline.batch  # noqa: F401

    log.parent.mkdir(parents=True, exist_ok=True)
    process = os.fork()
    if process:
        return process, seconds
    code = 70
    try:
        with log.open("wb") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
            code = run()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def finish(process: int, seconds: float | None, log: Path) -> tuple[int, str]:
    """Wait for a child, or kill it after so many seconds; return its exit code and the end of what it said."""
    end = time.perf_counter() + (_LONGEST if seconds is None else seconds)
    while True:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status), log.read_text(errors="replace")[-300:]
        if time.perf_counter() > end:
            os.kill(process, signal.SIGKILL)
        time.sleep(0.005)
