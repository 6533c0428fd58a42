"""A function in a process of its own that is killed at a change of a file, within a write, or at a moment."""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax

LONGEST = 900.0  # seconds of one run
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
# Processes fork from one that has imported all and started nothing: no run imports it again.
_FORKS = multiprocessing.get_context("forkserver")
_MODULES = ["vggtjax.pipeline.batch.many", "vggtjax.interface.commands.main", "tests.proofs.test_kills"]
_FORKS.set_forkserver_preload(_MODULES)


class Ended(NamedTuple):
    """How a run ended: its exit code, negative for a signal, and the end of what it said."""

    code: int
    said: str

    @property
    def killed(self) -> bool:
        return self.code in (-signal.SIGKILL, -signal.SIGXFSZ)


class Run:
    """A function of no arguments that runs, with its temporary files, its cache and its log in a place of their own.

    With `change` the process kills itself just before that change of a file below `out`: a file opened for writing, a
    rename, a removal, a folder made or removed, an fsync. With `size` the system kills it within the write that makes
    a file larger than so many bytes, in whatever language.
    """

    def __init__(
        self,
        function: Callable[[], int],
        place: Path,
        out: Path,
        *,
        change: int | None = None,
        size: int | None = None,
        log: str = "log",
    ) -> None:
        for folder in (out, place / "tmp", place / "cache"):
            folder.mkdir(parents=True, exist_ok=True)
        self._log = place / log
        self._process = _FORKS.Process(target=_run, args=(function, place, out, change, size, self._log))
        self._process.start()

    def finish(self, seconds: float | None = None) -> Ended:
        """Wait for the end, or kill the process after so many seconds."""
        self._process.join(LONGEST if seconds is None else seconds)
        self._process.kill()
        self._process.join()
        assert self._process.exitcode is not None
        return Ended(self._process.exitcode, self._log.read_text(errors="replace")[-300:])


def changes_of(place: Path) -> int:
    """Return how many changes of files the last whole run made."""
    return int((place / "changes").read_text())


def _run(function: Callable[[], int], place: Path, out: Path, change: int | None, size: int | None, log: Path) -> None:
    with log.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    tempfile.tempdir = str(place / "tmp")  # of this process; TMPDIR of those that it starts
    os.environ |= {"TMPDIR": tempfile.tempdir, "VGGTJAX_CACHE": str(place / "cache")}
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)  # of all tests
    jax.config.update("jax_compilation_cache_dir", None)
    done = _count_changes(out, change)
    if size is not None:
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # Python ignores it
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    code = function()
    if size is None:
        (place / "changes").write_text(str(done[0]))
    sys.exit(code)


def _count_changes(folder: Path, fatal: int | None) -> list[int]:
    """Count changes of files below a folder in a list of one number, and kill the process just before one."""
    inside, done, sync = str(folder), [0], os.fsync

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
    return done


def _is_inside(folder: str, arguments: tuple, path: int, open_folder: int | None) -> bool:
    """Return whether an event's path lies below a folder; it may start from an open folder, as in `shutil.rmtree`."""
    if not isinstance(arguments[path], str | bytes | os.PathLike):
        return False  # an open file's number
    number = -1 if open_folder is None or len(arguments) <= open_folder else arguments[open_folder]
    start = Path.cwd() if number == -1 else Path(f"/proc/self/fd/{number}").readlink()
    return (start / os.fsdecode(arguments[path])).is_relative_to(folder)
