"""A command in a child of its own that is killed at a change of a file, within a write, or at a moment."""

from __future__ import annotations

import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

_LONGEST = 900.0  # seconds of one run
# events of Python -> positions of its paths, and of the open folders that relative paths start from
_PATHS = {
    "open": ((0, None),),
    "os.rename": ((0, 2), (1, 3)),
    "os.remove": ((0, 1),),
    "os.mkdir": ((0, 2),),
    "os.rmdir": ((0, 1),),
    "os.truncate": ((0, None),),
    "os.link": ((1, 3),),
    "os.symlink": ((1, 2),),
}
KILLED = (-signal.SIGKILL, -signal.SIGXFSZ)  # exit codes


def start(
    words: list[str],
    log: Path,
    watched: Path,
    *,
    count: Path | None = None,
    change: int | None = None,
    seconds: float | None = None,
    size: int | None = None,
) -> tuple[int, float | None]:
    """Start a command in a child; it kills itself at a change of a file, or notes the number of changes.

    With `size`, the system kills it within the write that makes a file larger than so many bytes, in whatever language.
    """

    def run() -> int:
        from vggtjax.commands.main import main
        from vggtjax.storage.cache import enable_compilation_cache

        enable_compilation_cache()  # a command does it before jax is imported
        changes = watch(watched, change)
        if size is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # Python ignores it
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
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
        if event == "open" and not (isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)):
            return
        if any(_is_inside(inside, arguments, *at) for at in _PATHS.get(event, ())):
            changed()

    def fsync(file: Any) -> None:
        changed()
        sync(file)

    sys.addaudithook(hook)
    os.fsync = fsync

    def counts() -> Iterator[int]:
        yield done[0]

    return counts()


def _is_inside(folder: str, arguments: tuple, path: int, open_folder: int | None) -> bool:
    """Return whether an event's path lies below a folder; it may start from an open folder, as in `shutil.rmtree`."""
    if not isinstance(arguments[path], str | bytes | os.PathLike):
        return False  # an open file's number
    number = -1 if open_folder is None or len(arguments) <= open_folder else arguments[open_folder]
    start = Path.cwd() if number == -1 else Path(f"/proc/self/fd/{number}").readlink()
    return (start / os.fsdecode(arguments[path])).is_relative_to(folder)


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
